"""Pictures of an exported avatar by other programs, with our camera and without lights, for comparison with ours."""

import base64
import json
import os
import subprocess
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from jaxtyping import Float, UInt8

from pipeline.geometry.camera import Camera
from pipeline.metrics.images import composite_on_white
from pipeline.report.templates import read_asset
from tests.tools.browser import BrowserPage

NEAR_M, FAR_M = 0.1, 100.0


@dataclass(frozen=True)
class LampAndSky:
    """A lamp that casts no shadows, and light from everywhere; an irradiance of 1 shows a surface's colour as it is.

    direction: towards the lamp, unit, world. key, ambient: irradiance of a surface that faces the lamp, and of all.
    """

    direction: tuple[float, float, float]
    key: float
    ambient: float


_PAGE = """<!doctype html><html lang="en"><body>
<div id="viewer" style="width:300px;height:300px"></div>
<script>{viewer}</script>
<script>
const root = document.getElementById("viewer");
AvatarViewer.mount(root, {{glb: "{glb}"}}).then((view) => {{ window.view = view; }});
</script></body></html>"""

_RENDER = """(() => {{
  const {{ avatar, renderer, camera, scene, floor }} = view;
  renderer.setAnimationLoop(null);
  renderer.setPixelRatio(1);
  renderer.setSize({width}, {height}, false);
  renderer.setClearColor(0xffffff, 1);
  floor.visible = false;
  const light = {light};
  avatar.setSurface(light ? "lit" : "unlit");
  if (light) {{
    const sky = scene.children.find((child) => child.isHemisphereLight);
    sky.groundColor.copy(sky.color);
    sky.intensity = Math.PI * light.ambient;
    view.key.castShadow = false;
    view.key.intensity = Math.PI * light.key;
    view.key.target.position.set(0, 0, 0);
    view.key.position.fromArray(light.direction);
  }}
  if (avatar.clipIndex !== {clip}) avatar.setClip({clip});
  avatar.seek({time_s});
  camera.matrixAutoUpdate = false;
  camera.matrix.fromArray({camera_to_world});
  camera.matrixWorldNeedsUpdate = true;
  camera.projectionMatrix.fromArray({projection});
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  renderer.render(scene, camera);
  renderer.render(scene, camera);  // the first one may still show the joints of the page's own last frame
  return renderer.domElement.toDataURL("image/png");
}})()"""


def open_in_three(page: BrowserPage, glb: Path, folder: Path) -> None:
    """Open a .glb in three.js, in a page that is written into `folder`."""
    text = base64.b64encode(glb.read_bytes()).decode()
    file = folder / "three.html"
    file.write_text(_PAGE.format(viewer=read_asset("viewer.min.js"), glb=text), encoding="utf-8")
    page.open(file)


def render_in_three(
    page: BrowserPage, camera: Camera, clip: int = -1, time_s: float = 0.0, light: LampAndSky | None = None
) -> UInt8[np.ndarray, "h w 3"]:
    """Return a picture on white by three.js; clip: index of the animation, -1 is the rest pose; light: None: unlit."""
    script = _RENDER.format(
        width=camera.width,
        height=camera.height,
        clip=clip,
        time_s=time_s,
        light="null" if light is None else json.dumps(asdict(light)),
        camera_to_world=json.dumps(_camera_to_world(camera).T.ravel().tolist()),
        projection=json.dumps(_projection(camera).T.ravel().tolist()),
    )
    return _decode(base64.b64decode(page.evaluate(script).split(",")[1]))


def render_obj_in_blender(obj: Path, camera: Camera, folder: Path) -> tuple[UInt8[np.ndarray, "h w 3"], dict[str, Any]]:
    """Return a picture on white by Blender, and what it found in the .obj: vertices (m, our axes) and images.

    BLENDER_PYTHON names a Python with bpy; skips the test without it.
    """
    _run_in_blender("blender_obj.py", obj, camera, folder)
    with np.load(folder / "found.npz") as found:
        return _decode((folder / "blender.png").read_bytes()), dict(found)


def render_glb_in_blender(glb: Path, camera: Camera, light: LampAndSky, folder: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Return a lit picture on white by Blender's Cycles, in the rest pose; see `render_obj_in_blender`."""
    (folder / "light.json").write_text(json.dumps(asdict(light)))
    _run_in_blender("blender_lit.py", glb, camera, folder)
    rgba = cv2.imread(str(folder / "blender.png"), cv2.IMREAD_UNCHANGED)
    return composite_on_white(np.ascontiguousarray(rgba[..., 2::-1]), np.ascontiguousarray(rgba[..., 3]))


def _run_in_blender(script: str, file: Path, camera: Camera, folder: Path) -> None:
    python = os.environ.get("BLENDER_PYTHON", "")
    if not Path(python).is_file():
        pytest.skip("BLENDER_PYTHON does not name a Python with bpy")
    picture = folder / "blender.png"
    picture.unlink(missing_ok=True)
    intrinsics = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    (folder / "camera.json").write_text(json.dumps(intrinsics | {"camera_to_world": _camera_to_world(camera).tolist()}))
    command = [python, Path(__file__).with_name(script), file, folder]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    assert picture.is_file(), done.stderr[-2000:]


def _camera_to_world(camera: Camera) -> Float[np.ndarray, "4 4"]:
    """Return the pose of a camera that looks along -Z with +Y up."""
    return np.linalg.inv(camera.world_to_camera.astype(np.float64)) @ np.diag([1.0, -1.0, -1.0, 1.0])


def _projection(camera: Camera) -> Float[np.ndarray, "4 4"]:
    """Return OpenGL's clip matrix."""
    w, h = camera.width, camera.height
    return np.array(
        [
            [2.0 * camera.fx / w, 0.0, 1.0 - 2.0 * camera.cx / w, 0.0],
            [0.0, 2.0 * camera.fy / h, 2.0 * camera.cy / h - 1.0, 0.0],
            [0.0, 0.0, -(FAR_M + NEAR_M) / (FAR_M - NEAR_M), -2.0 * FAR_M * NEAR_M / (FAR_M - NEAR_M)],
            [0.0, 0.0, -1.0, 0.0],
        ]
    )


def _decode(png: bytes) -> UInt8[np.ndarray, "h w 3"]:
    return cv2.cvtColor(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
