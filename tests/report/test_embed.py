"""What goes into the page: round trips through WebP, and a lighter GLB that is still the same model."""

import base64

import cv2
import numpy as np
import pytest

from pipeline.report.embed import compress_glb_textures, pack_glb, unpack_glb, webp_data_uri


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


def test_glb_round_trip_and_refusals():
    document, binary = {"asset": {"version": "2.0"}, "name": "ä"}, bytes(range(7))
    back, chunk = unpack_glb(pack_glb(document, binary))
    assert back == document
    assert chunk[:7] == binary
    assert len(chunk) % 4 == 0
    with pytest.raises(ValueError, match="no binary glTF"):
        unpack_glb(b"PK\x03\x04 this is a zip archive")


@pytest.fixture
def textured_glb() -> bytes:
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 4)).astype(np.uint8)
    smooth = cv2.imencode(".png", cv2.GaussianBlur(noise[..., :3], (0, 0), 3))[1].tobytes()
    with_alpha = cv2.imencode(".png", noise)[1].tobytes()
    geometry = bytes(range(200))
    parts, views = [geometry, smooth, with_alpha, geometry[::-1]], []
    binary = b""
    for part in parts:
        binary += b"\0" * (-len(binary) % 4)
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(part)})
        binary += part
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": views,
        "images": [{"mimeType": "image/png", "bufferView": 1}, {"mimeType": "image/png", "bufferView": 2}],
    }
    return pack_glb(document, binary)


def test_light_glb_changes_opaque_textures_alone(textured_glb):
    before, before_binary = unpack_glb(textured_glb)
    after, after_binary = unpack_glb(compress_glb_textures(textured_glb, max_texture_px=32))

    def content(document: dict, binary: bytes, view: int) -> bytes:
        start = document["bufferViews"][view]["byteOffset"]
        return binary[start : start + document["bufferViews"][view]["byteLength"]]

    for view in (0, 2, 3):
        assert content(after, after_binary, view) == content(before, before_binary, view)
    assert [image["mimeType"] for image in after["images"]] == ["image/jpeg", "image/png"]
    texture = cv2.imdecode(np.frombuffer(content(after, after_binary, 1), np.uint8), cv2.IMREAD_COLOR)
    assert texture.shape == (32, 32, 3)
    assert after["buffers"][0]["byteLength"] <= len(after_binary) < len(before_binary)
