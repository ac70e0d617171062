"""Score light and albedo of the texture stage on synthetic captures, with the true mesh, poses and masks.

python -m data_tools.evaluate.materials CAPTURE [--frames 48] [--flicker 0.3] [--out FOLDER]

Errors of the texture stage only: the mesh is the true one with as many faces as an exported avatar. The table compares
the diffuse map with and without the light of the video: its error against the true texture, PSNR of body pixels under
the video's light and under lights that were not filmed, and the error of the gains where the exposure flickers.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from data_tools.command import run_command
from data_tools.evaluate.highlights import highlight_scores, lamp_error_deg
from data_tools.evaluate.truth import load_ground_truth
from data_tools.synthetic.rig.subject import Subject
from data_tools.synthetic.scene.capture import SyntheticCapture
from data_tools.synthetic.scene.renderer import Light, pose_vertices, render_subject
from pipeline.avatar.finished_run import load_textured_avatar
from pipeline.body.body import Body
from pipeline.body.files import save_body, save_camera, save_motion
from pipeline.capture.capture import Capture, image_path, mask_path, save_capture
from pipeline.capture.frame_selection import HELDOUT, TRAIN, assign_splits, evenly_spaced
from pipeline.capture.usable_frames import SCORES_NPZ
from pipeline.geometry.alpha import unpremultiply_to_uint8
from pipeline.geometry.colour import linear_to_srgb, srgb_to_linear
from pipeline.geometry.creases import find_creases
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import dense_weights, top_k_weights
from pipeline.geometry.surface import closest_points_on_mesh, collapse_edges, weld_vertices
from pipeline.geometry.tangents import tangent_frames, vertex_tangents
from pipeline.geometry.texture_rendering import sample_texture
from pipeline.io.image import to_float, to_uint8, write_gray, write_rgb
from pipeline.io.npz import save_npz
from pipeline.mesh.files import MeshArtifact, load_mesh, save_dense_mesh, save_mesh
from pipeline.metrics.images import composite_on_white, composite_premultiplied_on_white, foreground_mask, psnr_db
from pipeline.metrics.surfaces import sample_surface
from pipeline.texture.files import TextureArtifact, load_texture
from pipeline.texture.normal_map import decode_normals
from stages.texture import STAGE as TEXTURE

FACES = 22_000
SURFACE_POINTS = 20_000
SAMPLES = 2
NEW_LIGHTS = {
    "left": Light(key_intensity=0.6, key_direction=(-0.9, 0.3, 0.5), ambient_intensity=0.4, diffuse_wrap=0.0),
    "top": Light(key_intensity=0.6, key_direction=(0.1, 1.0, 0.4), ambient_intensity=0.4, diffuse_wrap=0.0),
}
"""Lights that no capture is filmed under."""


def main(argv: Sequence[str]) -> None:
    """Print the table of one capture."""
    parser = argparse.ArgumentParser(
        prog="python -m data_tools.evaluate.materials", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("capture", type=Path, help="folder of the synthetic capture")
    parser.add_argument("--frames", type=int, default=48, help="frames used, evenly spaced (default 48)")
    parser.add_argument(
        "--flicker", type=float, default=0.0, help="largest relative change of the exposure (default 0)"
    )
    parser.add_argument("--out", type=Path, help="folder for the maps; a temporary one if absent")
    options = parser.parse_args(argv)
    truth = load_ground_truth(options.capture)
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.out or Path(temporary)
        gains = write_true_run(truth, folder, options.frames, options.flicker)
        inputs = {name: folder / name for name in ("frames", "body", "mesh")}
        for mode in ("kept", "auto", "removed"):
            out = folder / f"texture-{mode}"
            out.mkdir(parents=True, exist_ok=True)
            started = time.monotonic()
            metrics = TEXTURE.run(inputs, out, TEXTURE.config.model_validate({"light": mode}))
            seconds = time.monotonic() - started
            scores = score_maps(truth, out, folder, gains) | {"seconds": seconds}
            for name, value in {**metrics, **scores}.items():
                print(f"{mode:8} {name:32} {value:10.4f}")


def write_true_run(
    truth: SyntheticCapture, folder: Path, frames: int, flicker: float, seed: int = 0
) -> Float[np.ndarray, "n"]:
    """Write the folders `frames`, `body` and `mesh` of a run with the true person; return the gain of each frame.

    seed: of the gains.
    """
    motion = truth.motion.select(_used_frames(truth, frames))
    gains = 1.0 + flicker * np.random.default_rng(seed).uniform(-1.0, 1.0, len(motion.time_s))
    for name in ("frames/images", "frames/masks", "body", "mesh"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    for index, gain in zip(motion.frame_index.tolist(), gains, strict=True):
        image, mask = _exposed(truth, index, float(gain))
        write_rgb(image_path(folder / "frames", index), image)
        write_gray(mask_path(folder / "frames", index), mask)
    count = len(motion.time_s)
    unknown = np.full((count, 33, 3), np.nan, dtype=np.float32)
    save_capture(
        Capture(
            folder=folder / "frames",
            frame_index=motion.frame_index,
            time_s=motion.time_s,
            split=assign_splits(np.arange(count)),
            fps=truth.fps,
            width=truth.camera.width,
            height=truth.camera.height,
            landmarks_px=unknown[..., :2],
            landmarks_visibility=unknown[..., 0],
            landmarks_world_m=unknown,
            camera=truth.camera,
            mask_source="truth",
            n_video_frames=len(truth.motion.time_s),
            scale=1.0,
        )
    )
    save_body(folder / "body" / "body.npz", truth.subject.body)
    save_camera(folder / "body" / "camera.npz", truth.camera)
    save_npz(folder / "body" / SCORES_NPZ, {"usable": np.ones(count, dtype=bool)})
    save_motion(folder / "mesh" / "motion.npz", motion)
    save_mesh(folder / "mesh", reduced_mesh(truth.subject.body))
    save_dense_mesh(folder / "mesh", weld_vertices(truth.subject.body.mesh()))
    return gains


def _used_frames(truth: SyntheticCapture, count: int) -> Int[np.ndarray, "n"]:
    return evenly_spaced(len(truth.motion.time_s), count)


def reduced_mesh(body: Body) -> MeshArtifact:
    """Return the surface of a body with `FACES` faces; vertices have the skin weights of the nearest true ones.

    Scanned people have their vertices several times along the seams of their texture, where edge collapses would tear
    the surface.
    """
    mesh = body.mesh()
    welded = weld_vertices(mesh)
    reduced = collapse_edges(welded, np.ones(len(welded.faces), dtype=bool), FACES)
    _, faces, barycentric = closest_points_on_mesh(reduced.vertices, mesh)
    nearest = mesh.faces[faces, barycentric.argmax(axis=1)]
    reduced = Mesh(reduced.vertices.astype(np.float32), reduced.faces.astype(np.int32))
    grey = np.full_like(reduced.vertices, 0.5)
    return MeshArtifact(reduced, *top_k_weights(body.skin_weights[nearest]), grey)


def _exposed(
    truth: SyntheticCapture, frame: int, gain: float
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    person = unpremultiply_to_uint8(truth.render_person(frame))
    linear = srgb_to_linear(to_float(np.ascontiguousarray(person[..., :3])).astype(np.float64))
    image = to_uint8(np.clip(linear_to_srgb(gain * linear), 0.0, 1.0))
    return image, np.ascontiguousarray(person[..., 3])


def score_maps(
    truth: SyntheticCapture, texture_dir: Path, folder: Path, gains: Float[np.ndarray, "n"]
) -> dict[str, float]:
    """Return the error of the map against the true texture (of 255, one gain a channel), PSNR in dB, gain error."""
    avatar = load_textured_avatar(folder / "mesh", texture_dir)
    texture = load_texture(texture_dir)
    gain = albedo_gain(truth, texture, folder)
    balanced = replace(texture, diffuse=scale_linear(texture.diffuse, gain[0]))
    joint_count = len(truth.subject.body.joint_names)
    own_mesh_body = replace(
        truth.subject.body,
        vertices=avatar.vertices.numpy(),
        faces=avatar.faces.numpy(),
        skin_weights=dense_weights(avatar.joint_indices, avatar.joint_weights, joint_count).numpy(),
    )
    subject = Subject(own_mesh_body, avatar.uv.numpy(), avatar.faces_uv.numpy(), to_uint8(balanced.diffuse))
    motion = truth.motion.frame_index[_used_frames(truth, len(gains))]
    held_out = np.flatnonzero(assign_splits(np.arange(len(gains))) == HELDOUT)
    scores: dict[str, list[float]] = {"heldout_psnr_body_db": []}
    for position in held_out.tolist():
        pose = truth.canonical_to_world[int(motion[position])]
        vertices, true_vertices = pose_vertices(subject, pose), pose_vertices(truth.subject, pose)
        image, mask = _exposed(truth, int(motion[position]), float(gains[position]))
        render = avatar.render(vertices, truth.camera, SAMPLES, avatar.light, position)
        scores["heldout_psnr_body_db"].append(inner_psnr_db(render, image, mask))
        for name, value in relit_psnr_db(truth, subject, vertices, true_vertices).items():
            scores.setdefault(name, []).append(value)
    if truth.light.specular_strength > 0:
        scores |= {name: [value] for name, value in score_highlights(truth, texture, folder).items()}
    return {name: float(np.mean(values)) for name, values in scores.items()} | {
        "albedo_error": gain[1],
        "gain_error_largest": largest_gain_error(texture, gains),
    }


def relit_psnr_db(
    truth: SyntheticCapture, subject: Subject, vertices: Float[torch.Tensor, "v 3"], true_vertices: torch.Tensor
) -> dict[str, float]:
    """Return the PSNR of inner pixels of a posed subject against the true one under each of `NEW_LIGHTS`."""
    scores = {}
    for name, light in NEW_LIGHTS.items():
        drawn = render_subject(subject, vertices, truth.camera, light, SAMPLES)
        expected = unpremultiply_to_uint8(render_subject(truth.subject, true_vertices, truth.camera, light, SAMPLES))
        scores[f"relit_{name}_db"] = inner_psnr_db(drawn, expected[..., :3], expected[..., 3])
    return scores


def largest_gain_error(texture: TextureArtifact, gains: Float[np.ndarray, "n"]) -> float:
    """Return the largest relative error of the estimated gain of a training frame; their common scale is free."""
    train = assign_splits(np.arange(len(gains))) == TRAIN
    ratio = texture.light.gain[train] / gains[train]
    return float(np.abs(ratio / np.median(ratio) - 1.0).max())


def normal_map_angle_deg(mesh: Mesh, texture: TextureArtifact, dense: Mesh) -> float:
    """Return the mean angle at surface points from the normals that viewers shade with to those of the dense mesh.

    mesh: that the texture belongs to, cut; in the pose of `dense`.
    """
    points, _ = sample_surface(mesh, SURFACE_POINTS, 0)
    _, face, weights = closest_points_on_mesh(points, mesh)
    creases, true_creases = find_creases(mesh), find_creases(dense)
    shown, atlas = Mesh(mesh.vertices[creases.source], creases.faces), creases.split_atlas(texture.atlas)
    normals = shown.vertex_normals()[atlas.vertex_of_uv]
    tangents = vertex_tangents(shown.vertices[atlas.vertex_of_uv], normals, atlas.uv, atlas.faces_uv)
    normal, tangent, uv = (
        np.einsum("nk,nkc->nc", weights, each[atlas.faces_uv[face]]) for each in (normals, tangents, atlas.uv)
    )
    own = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    if texture.normal is not None:
        own = decode_normals(texture.normal, uv, tangent_frames(normal, tangent))
    _, face, weights = closest_points_on_mesh(points, dense)
    true_normals = Mesh(dense.vertices[true_creases.source], true_creases.faces).vertex_normals()
    true = np.einsum("nk,nkc->nc", weights, true_normals[true_creases.faces[face]])
    cosine = np.sum(own * true, axis=1) / np.linalg.norm(true, axis=1)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).mean())


def inner_psnr_db(render: np.ndarray, image: np.ndarray, mask: np.ndarray) -> float:
    """Return the PSNR of pixels inside the body, without its outline, which shows errors of the shape."""
    inside = cv2.erode(foreground_mask(mask).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return psnr_db(composite_premultiplied_on_white(render), composite_on_white(image, mask), inside)


def albedo_gain(
    truth: SyntheticCapture, texture: TextureArtifact, folder: Path
) -> tuple[Float[np.ndarray, "3"], float]:
    """Return `gain_to_truth` on the observed surface."""
    mesh, subject = load_mesh(folder / "mesh").cut(texture.cut).mesh, truth.subject
    points, _ = sample_surface(mesh, SURFACE_POINTS, 0)
    uv = _uv_at(points, mesh, texture.atlas.uv, texture.atlas.faces_uv)
    seen = sample_texture(torch.from_numpy(to_float(texture.coverage))[..., None], uv)[:, 0].numpy() > 0.5
    uv_true = _uv_at(points[seen], subject.body.mesh(), subject.uv, subject.faces_uv)
    own = sample_texture(torch.from_numpy(texture.diffuse), uv[seen]).numpy()
    return gain_to_truth(own, sample_texture(subject.texture_tensor(), uv_true).numpy())


def gain_to_truth(
    own: Float[np.ndarray, "n 3"], true: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "3"], float]:
    """Return the linear gain a channel from colours (sRGB) to the true ones, and the mean error after it, of 255."""
    linear = srgb_to_linear(own.astype(np.float64))
    gain = np.median(srgb_to_linear(true.astype(np.float64)) / np.maximum(linear, 1e-4), axis=0)
    return gain, 255.0 * float(np.abs(linear_to_srgb(np.clip(gain * linear, 0.0, 1.0)) - true).mean())


def score_highlights(truth: SyntheticCapture, texture: TextureArtifact, folder: Path) -> dict[str, float]:
    """Return `highlight_scores` on the observed surface, and `lamp_error_deg`: from the lamp to the key light."""
    mesh, subject = load_mesh(folder / "mesh").cut(texture.cut).mesh, truth.subject
    points, _ = sample_surface(mesh, SURFACE_POINTS, 0)
    uv = _uv_at(points, mesh, texture.atlas.uv, texture.atlas.faces_uv)
    seen = sample_texture(torch.from_numpy(to_float(texture.coverage))[..., None], uv)[:, 0].numpy() > 0.5
    strength = sample_texture(torch.from_numpy(texture.specular)[..., None], uv)[:, 0].numpy()[seen]
    roughness = np.full(len(strength), texture.highlights.roughness)
    if texture.roughness is not None:
        roughness = sample_texture(torch.from_numpy(texture.roughness)[..., None], uv)[:, 0].numpy()[seen]
    _, faces, _ = closest_points_on_mesh(points[seen], subject.body.mesh())
    scores = highlight_scores(strength, roughness, subject, truth.light, faces)
    if not strength.any():
        return scores
    return scores | {"lamp_error_deg": lamp_error_deg(texture.highlights.direction, truth.light)}


def _uv_at(points: np.ndarray, mesh: Mesh, uv: np.ndarray, faces_uv: np.ndarray) -> torch.Tensor:
    _, faces, barycentric = closest_points_on_mesh(points, mesh)
    return torch.from_numpy((uv[faces_uv[faces]] * barycentric[..., None]).sum(axis=1)).float()


def scale_linear(diffuse: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """Return sRGB colours whose linear values are multiplied by a gain a channel."""
    return linear_to_srgb(np.clip(srgb_to_linear(diffuse.astype(np.float64)) * gain, 0.0, 1.0)).astype(np.float32)


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
