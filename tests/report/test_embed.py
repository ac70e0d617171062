"""What goes into the page: round trips through WebP, and a lighter GLB that is still the same model."""

import base64
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.core.errors import UserError
from pipeline.io.glb import GlbFile
from pipeline.io.glb_writer import GlbWriter
from pipeline.report.embed import compress_glb_textures, webp_data_uri


def gradient(size: int, channels: int) -> np.ndarray:
    rows, columns = np.mgrid[0:size, 0:size] * (255.0 / size)
    planes = [rows, columns, 255.0 - rows, np.full_like(rows, 255.0)][:channels]
    return np.stack(planes, axis=2).astype(np.uint8)


def decoded(uri: str) -> np.ndarray:
    kind, _, data = uri.partition(";base64,")
    assert kind == "data:image/webp"
    return cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize("channels", [3, 4])
def test_webp_keeps_colours_in_their_channels(channels):
    pixels = gradient(64, channels)
    back = decoded(webp_data_uri(pixels))
    code = cv2.COLOR_BGRA2RGBA if channels == 4 else cv2.COLOR_BGR2RGB
    assert np.abs(cv2.cvtColor(back, code).astype(int) - pixels).mean() < 4


@pytest.fixture
def textured_glb() -> bytes:
    """Two textures, of which the second has alpha, between two arrays."""
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 4)).astype(np.uint8)
    smooth = cv2.GaussianBlur(noise[..., :3], (0, 0), 3)
    points = np.random.default_rng(1).normal(size=(20, 3)).astype(np.float32)
    document = GlbWriter({"asset": {"version": "2.0"}})
    attributes = {"POSITION": document.add_array(points, bounds=True)}
    for pixels in (smooth, noise):
        view = document.add_bytes(cv2.imencode(".png", pixels)[1].tobytes())
        document.add("images", {"mimeType": "image/png", "bufferView": view})
    attributes["NORMAL"] = document.add_array(points[::-1])
    document.add("meshes", {"primitives": [{"attributes": attributes}]})
    return document.to_bytes()


def test_light_glb_changes_opaque_textures_alone(textured_glb):
    light = compress_glb_textures(textured_glb, max_texture_px=32)
    before, after = (GlbFile(Path("model.glb"), contents) for contents in (textured_glb, light))
    for index in range(2):
        np.testing.assert_array_equal(after.accessor(index), before.accessor(index))
    assert after.image_bytes(1) == before.image_bytes(1)
    assert [image["mimeType"] for image in after.gltf["images"]] == ["image/jpeg", "image/png"]
    assert after.image_pixels(0).shape == (32, 32, 3)
    assert len(light) < len(textured_glb) - len(before.image_bytes(0)) + len(after.image_bytes(0)) + 100
    assert light[8:12] == len(light).to_bytes(4, "little")


def test_what_is_no_glb_is_refused():
    with pytest.raises(UserError, match="no binary glTF"):
        compress_glb_textures(b"PK\x03\x04 this is a zip archive")
