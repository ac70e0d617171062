"""Compare pictures and vertices of exported avatars in three.js, Blender and trimesh with ours.

CHROMIUM=... BLENDER_PYTHON=... python -m tests.bench.compare_pictures RUN...

A row a run: dB against our rasteriser, of the whole picture on white and of the pixels of the body, unlit and with the
same camera; greatest distance of the .obj's vertices. Pictures are written to RUN/compare-pictures/.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from jaxtyping import Float, UInt8
from scipy.spatial import cKDTree

from pipeline.avatar.finished_run import load_textured_avatar, vertex_values
from pipeline.avatar.textured_avatar import TexturedAvatar
from pipeline.body.body import canonical_to_world
from pipeline.geometry.atlas import rasterize_texels
from pipeline.geometry.camera import Camera
from pipeline.geometry.texture_rendering import render_textured, turntable_camera
from pipeline.io.image import to_uint8, write_rgb
from pipeline.texture.files import TextureArtifact
from pipeline.texture.light import Highlights, directional_light, exponent_of_roughness, roughness_of_exponent
from pipeline.texture.vertex_texels import vertex_map
from stages.export import STAGE, Config, Scene, encode_scene, load_scene
from tests.tools.browser import open_browser
from tests.tools.pictures import (
    LampAndSky,
    open_in_three,
    render_glb_in_blender,
    render_in_three,
    render_obj_in_blender,
)

WIDTH_PX, HEIGHT_PX = 540, 720
SUPERSAMPLING = 8
THREE_SUPERSAMPLING = 4
"""three.js samples a texture once a pixel, from mip maps. A picture of 4 times the side, averaged, has our filter."""

LAMP = LampAndSky((0.48, 0.6, 0.64), 0.7, 0.3)
"""Light of the lit pictures: a lamp from the front, above and the person's left."""

PAINTED_STRENGTH, PAINTED_EXPONENT = 0.08, 24.0
"""Highlights of the shiny picture: of satin; glTF's specular factor is then 0.6 and its roughness 0.53."""

PAINTED_EXPONENTS = (64.0, 16.0)
"""Above and below the middle of the person, where there is a roughness map: factors 0.24 and 0.89."""

CLIP_FRACTION = 0.4
"""Of the frames of the clip `capture`: the pose that is compared besides the rest pose."""


def main(argv: Sequence[str]) -> None:
    """Print one row for each run."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.compare_pictures")
    parser.add_argument("runs", type=Path, nargs="+", help="run folders with a finished export")
    for run in parser.parse_args(argv).runs:
        out = run / "compare-pictures"
        out.mkdir(exist_ok=True)
        for compare in (compare_in_three, compare_lit, compare_obj):
            try:
                print(f"{run.name}: {compare(run, out)}", flush=True)
            except pytest.skip.Exception as reason:  # no browser, no Blender
                print(f"{run.name}: skipped: {reason}", flush=True)


def compare_in_three(run: Path, out: Path) -> str:
    """Compare the .glb in the rest pose and in a pose of the clip `capture`."""
    avatar, scene = load_textured_avatar(run / "mesh", run / "texture"), _scene(run)
    standing = _on_floor(avatar)
    row = int(CLIP_FRACTION * len(scene.motion.time_s))
    pose = canonical_to_world(scene.body, scene.motion.select(np.array([row])))[0]
    poses = {
        "rest": (standing.vertices, -1, 0.0),
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


def compare_lit(run: Path, out: Path) -> str:
    """Compare the captured surface under a lamp and a uniform sky: as it is, and with painted highlights.

    "two shines" has a roughness map of `PAINTED_EXPONENTS`.
    """
    inputs = {name: run / name for name in STAGE.needs}
    config = Config(face=False)
    scene = load_scene(inputs, config)
    plain = _on_floor(load_textured_avatar(run / "mesh", run / "texture"))
    matte = replace(scene.texture, specular=np.zeros_like(scene.texture.specular))
    shiny = replace(
        scene.texture,
        specular=np.full_like(scene.texture.specular, PAINTED_STRENGTH),
        highlights=Highlights(np.array(LAMP.direction, np.float32), PAINTED_EXPONENT),
        light=directional_light(LAMP.direction, LAMP.ambient),
    )
    two_shines = replace(shiny, roughness=_painted_roughness(scene))
    parts, camera = [], camera_for(plain.vertices)
    for name, texture in (("matte", matte), ("shiny", shiny), ("two shines", two_shines)):
        stem = name.replace(" ", "_")
        file = out / f"lit_{stem}.glb"
        file.write_bytes(encode_scene(replace(scene, texture=texture), config, {"capture": scene.motion}))
        ours = _render_lit(plain, texture, camera, scene.skinned.vertex_normals())
        blender = render_glb_in_blender(file.resolve(), camera, LAMP, out.resolve())
        parts.append(f"Blender lit, {name} {_compare_to(ours, blender, out / f'blender_lit_{stem}')}")
        with open_browser() as page:
            open_in_three(page, file, out)
            fine = render_in_three(page, camera.scaled(THREE_SUPERSAMPLING), light=LAMP)
            assert page.problems == [], page.problems
        picture = cv2.resize(fine, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_AREA)
        parts.append(f"three.js lit, {name} {_compare_to(ours, picture, out / f'three_lit_{stem}')}")
    return ", ".join(parts)


def _painted_roughness(scene: Scene) -> Float[np.ndarray, "s s"]:
    """Return a roughness map with the lobes of `PAINTED_EXPONENTS`."""
    mesh, texture = scene.skinned.mesh, scene.texture
    height = mesh.vertices[:, 1]
    is_high = height > 0.5 * (height.min() + height.max())
    exponent = np.where(is_high, *PAINTED_EXPONENTS)
    texels = rasterize_texels(texture.atlas, texture.specular.shape[0])
    return vertex_map(roughness_of_exponent(exponent), mesh, texels)


def _render_lit(
    avatar: TexturedAvatar, texture: TextureArtifact, camera: Camera, normals: Float[np.ndarray, "v 3"]
) -> Float[np.ndarray, "h w 4"]:
    """Render with our rasteriser: Lambert's law, and the lobe of the highlights, at the vertices."""
    towards = torch.tensor(LAMP.direction)
    irradiance = LAMP.ambient + LAMP.key * (torch.from_numpy(normals).float() @ towards).clamp(min=0.0)
    to_camera = torch.nn.functional.normalize(torch.from_numpy(camera.centre_m()).float() - avatar.vertices, dim=1)
    strength, exponent = vertex_values(texture.specular, texture.atlas, len(normals)).numpy(), None
    if texture.roughness is not None:
        exponent = exponent_of_roughness(vertex_values(texture.roughness, texture.atlas, len(normals)).numpy())
    lobe = texture.highlights.lobe(normals, to_camera.numpy(), np.ones(len(normals)), exponent)
    lamp = texture.light.lamp_irradiance(texture.highlights.direction)
    added = torch.from_numpy(strength * lobe * LAMP.key / lamp).float()
    shading = torch.cat([irradiance[:, None].expand(-1, 3), added[:, None]], dim=1).float()
    surface = (avatar.faces, avatar.faces_uv, avatar.uv, avatar.diffuse)
    return render_textured(avatar.vertices, *surface, camera, SUPERSAMPLING, shading).numpy()


def compare_obj(run: Path, out: Path) -> str:
    """Compare the .obj in trimesh and Blender."""
    obj, avatar = run / "export" / "avatar.obj", _on_floor(load_textured_avatar(run / "mesh", run / "texture"))
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
    return _psnr_db(avatar.render(vertices, camera, SUPERSAMPLING), picture)


def _psnr_db(
    ours: Float[np.ndarray, "h w 4"], picture: UInt8[np.ndarray, "h w 3"]
) -> tuple[float, float, UInt8[np.ndarray, "h w 3"]]:
    on_white = to_uint8(ours[..., :3] + 1.0 - ours[..., 3:])
    squared = (on_white.astype(np.float64) - picture) ** 2
    body = squared[ours[..., 3] > 0.0]
    return *(float(10.0 * np.log10(255.0**2 / max(values.mean(), 1e-9))) for values in (squared, body)), on_white


def _compare(avatar: TexturedAvatar, vertices: torch.Tensor, camera: Camera, picture: np.ndarray, stem: Path) -> str:
    return _compare_to(avatar.render(vertices, camera, SUPERSAMPLING), picture, stem)


def _compare_to(ours: Float[np.ndarray, "h w 4"], picture: np.ndarray, stem: Path) -> str:
    full_db, body_db, on_white = _psnr_db(ours, picture)
    difference = np.clip(128 + 4 * (picture.astype(int) - on_white), 0, 255).astype(np.uint8)
    write_rgb(stem.with_suffix(".png"), np.concatenate([on_white, picture, difference], axis=1))
    return f"{full_db:.1f} / {body_db:.1f} dB"


def _offset_mm(avatar: TexturedAvatar, vertices_m: np.ndarray) -> str:
    """Return the greatest distance to our vertices; the .obj may have duplicates, and in another order."""
    distance_m = cKDTree(avatar.vertices.numpy()).query(vertices_m)[0].max()
    back_m = cKDTree(vertices_m).query(avatar.vertices.numpy())[0].max()
    return f"{1e3 * max(distance_m, back_m):.4f} mm"


def _on_floor(avatar: TexturedAvatar) -> TexturedAvatar:
    """Return the avatar with its lowest vertex at y = 0, as the exported files have it in the rest pose."""
    vertices = avatar.vertices.clone()
    vertices[:, 1] -= vertices[:, 1].min()
    return replace(avatar, vertices=vertices)


def _scene(run: Path) -> Scene:
    return load_scene({name: run / name for name in STAGE.needs}, Config())


if __name__ == "__main__":
    main(sys.argv[1:])
