"""Compare pictures and vertices of exported avatars in three.js, Blender and trimesh with ours.

CHROMIUM=... BLENDER_PYTHON=... python -m tests.bench.compare_pictures RUN...

A row a run: dB against our rasteriser, of the whole picture on white and of the pixels of the body, unlit and with the
same camera; greatest distance of the .obj's vertices. Pictures are written to RUN/compare-pictures/.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from jaxtyping import UInt8
from scipy.spatial import cKDTree

from pipeline.avatar.finished_run import load_textured_avatar
from pipeline.avatar.textured_avatar import TexturedAvatar
from pipeline.body.body import canonical_to_world
from pipeline.geometry.camera import Camera
from pipeline.geometry.texture_rendering import render_textured, turntable_camera
from pipeline.io.image import to_uint8, write_rgb
from stages.export import STAGE, Config, load_scene
from tests.tools.browser import open_browser
from tests.tools.pictures import open_in_three, render_in_three, render_obj_in_blender

WIDTH_PX, HEIGHT_PX = 540, 720
SUPERSAMPLING = 8
THREE_SUPERSAMPLING = 4
"""three.js samples a texture once a pixel, from mip maps. A picture of 4 times the side, averaged, has our filter."""

CLIP_FRACTION = 0.4
"""Of the frames of the clip `capture`: the pose that is compared besides the rest pose."""


def main(argv: Sequence[str]) -> None:
    """Print one row for each run."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.compare_pictures")
    parser.add_argument("runs", type=Path, nargs="+", help="run folders with a finished export")
    for run in parser.parse_args(argv).runs:
        out = run / "compare-pictures"
        out.mkdir(exist_ok=True)
        for compare in (compare_in_three, compare_obj):
            try:
                print(f"{run.name}: {compare(run, out)}", flush=True)
            except pytest.skip.Exception as reason:  # no browser, no Blender
                print(f"{run.name}: skipped: {reason}", flush=True)


def compare_in_three(run: Path, out: Path) -> str:
    """Compare the .glb in the rest pose and in a pose of the clip `capture`."""
    avatar, scene = load_textured_avatar(run / "mesh", run / "texture"), _scene(run)
    row = int(CLIP_FRACTION * len(scene.motion.time_s))
    pose = canonical_to_world(scene.body, scene.motion.select(np.array([row])))[0]
    poses = {
        "rest": (avatar.vertices, -1, 0.0),
        "capture": (avatar.pose_vertices(pose), 0, float(scene.motion.time_s[row])),
    }
    parts = []
    with open_browser() as page:
        open_in_three(page, run / "export" / "avatar.glb", out)
        for name, (vertices, clip, time_s) in poses.items():
            camera = camera_for(vertices)
            direct = render_in_three(page, camera, clip, time_s)
            fine = render_in_three(page, camera.scaled(THREE_SUPERSAMPLING), clip, time_s)
            averaged = cv2.resize(fine, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_AREA)
            parts.append(f"three.js {name} {_compare(avatar, vertices, camera, direct, out / f'three_{name}')}")
            parts.append(f"averaged {_compare(avatar, vertices, camera, averaged, out / f'three_{name}_averaged')}")
        assert page.problems == [], page.problems
    return ", ".join(parts)


def compare_obj(run: Path, out: Path) -> str:
    """Compare the .obj in trimesh and Blender."""
    obj, avatar = run / "export" / "avatar.obj", load_textured_avatar(run / "mesh", run / "texture")
    camera = camera_for(avatar.vertices)
    loaded = trimesh.load(obj, process=False)
    uv, colours = loaded.visual.uv, np.asarray(loaded.visual.material.image.convert("RGB"), np.float32) / 255.0
    vertices, faces = torch.from_numpy(loaded.vertices).float(), torch.from_numpy(loaded.faces.copy()).int()
    image = render_textured(
        vertices, faces, faces, torch.from_numpy(uv).float(), torch.from_numpy(colours), camera, SUPERSAMPLING
    ).numpy()
    picture = to_uint8(image[..., :3] + 1.0 - image[..., 3:])
    scores = _compare(avatar, avatar.vertices, camera, picture, out / "trimesh")
    parts = [f"trimesh {scores} {_offset_mm(avatar, loaded.vertices)}"]
    picture, found = render_obj_in_blender(obj.resolve(), camera, out.resolve())
    named = sorted(set(found["images"].tolist()))
    parts.append(
        f"Blender {_compare(avatar, avatar.vertices, camera, picture, out / 'blender_obj')} "
        f"{_offset_mm(avatar, found['vertices_m'])} maps {named}"
    )
    return ", ".join(parts)


def camera_for(vertices: torch.Tensor) -> Camera:
    """Return a camera that sees the whole person from 25 degrees to the left."""
    low, high = vertices.numpy().min(axis=0), vertices.numpy().max(axis=0)
    return turntable_camera(low, high, 0.44, WIDTH_PX, HEIGHT_PX)


def picture_psnr_db(
    avatar: TexturedAvatar, vertices: torch.Tensor, camera: Camera, picture: UInt8[np.ndarray, "h w 3"]
) -> tuple[float, float, UInt8[np.ndarray, "h w 3"]]:
    """Return dB of the whole picture and of body pixels against our rasteriser, and our picture."""
    ours = avatar.render(vertices, camera, SUPERSAMPLING)
    on_white = to_uint8(ours[..., :3] + 1.0 - ours[..., 3:])
    squared = (on_white.astype(np.float64) - picture) ** 2
    body = squared[ours[..., 3] > 0.0]
    return *(float(10.0 * np.log10(255.0**2 / max(values.mean(), 1e-9))) for values in (squared, body)), on_white


def _compare(avatar: TexturedAvatar, vertices: torch.Tensor, camera: Camera, picture: np.ndarray, stem: Path) -> str:
    full_db, body_db, ours = picture_psnr_db(avatar, vertices, camera, picture)
    difference = np.clip(128 + 4 * (picture.astype(int) - ours), 0, 255).astype(np.uint8)
    write_rgb(stem.with_suffix(".png"), np.concatenate([ours, picture, difference], axis=1))
    return f"{full_db:.1f} / {body_db:.1f} dB"


def _offset_mm(avatar: TexturedAvatar, vertices_m: np.ndarray) -> str:
    """Return the greatest distance to our vertices; the .obj may have duplicates, and in another order."""
    distance_m = cKDTree(avatar.vertices.numpy()).query(vertices_m)[0].max()
    back_m = cKDTree(vertices_m).query(avatar.vertices.numpy())[0].max()
    return f"{1e3 * max(distance_m, back_m):.4f} mm"


def _scene(run: Path):
    return load_scene({name: run / name for name in STAGE.needs}, Config())


if __name__ == "__main__":
    main(sys.argv[1:])
