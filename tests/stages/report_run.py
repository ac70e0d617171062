"""A small finished run with known errors: six stage folders whose artifacts are written by hand."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from pipeline.avatar.gltf import encode_glb
from pipeline.avatar.rig import build_rig
from pipeline.avatar.textured_avatar import TexturedAvatar
from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.body.files import save_body, save_camera, save_motion
from pipeline.capture.capture import Capture, image_path, mask_path, save_capture
from pipeline.capture.frame_selection import HELDOUT, TRAIN, VALIDATION
from pipeline.core.manifest import MANIFEST_FILE, Manifest, write_manifest
from pipeline.field.field import RadianceField, hash_grid_layout
from pipeline.field.files import save_field, save_occupancy
from pipeline.field.occupancy import RESOLUTION, BinaryOccupancy
from pipeline.geometry.atlas import Atlas
from pipeline.geometry.camera import Camera
from pipeline.geometry.skinning import top_k_weights
from pipeline.io.image import to_float, to_uint8, write_gray, write_rgb
from pipeline.mesh.files import MeshArtifact, save_mesh
from pipeline.texture.files import TextureArtifact, save_texture
from pipeline.texture.light import Highlights, VideoLight
from tests.avatar.avatar_sample import FRAME_RATE, sample_body, sample_maps, sample_motion, sample_skinned_mesh

FRAME_INDEX = np.array([0, 3, 4, 8, 11, 16], dtype=np.int32)
CAMERA = Camera(110.0, 110.0, 36.0, 48.0, 72, 96)
COLOUR_ERROR = 16
"""How much brighter, in steps of 255, the frames are than the mesh's texture."""


def make_run(folder: Path) -> dict[str, Path]:
    """Write the folders of all stages before the report; returns them by name."""
    inputs = {name: folder / name for name in ("frames", "body", "field", "mesh", "texture", "export")}
    for path in inputs.values():
        path.mkdir(parents=True)
    body, motion = sample_body(), sample_motion(FRAME_INDEX)
    avatar = make_avatar(body)
    _write_frames(inputs["frames"], avatar, canonical_to_world(body, motion))
    _write_body(inputs["body"], body, motion)
    _write_field(inputs["field"], body, motion)
    _write_mesh_and_texture(inputs["mesh"], inputs["texture"], avatar, motion)
    glb = encode_glb(sample_skinned_mesh(body)[0], build_rig(body), {"capture": motion}, sample_maps())
    (inputs["export"] / "avatar.glb").write_bytes(glb)
    metrics = {"body": {"landmark_error_px": 3.5, "silhouette_iou": 0.9}}
    for number, (name, path) in enumerate(inputs.items(), start=1):
        write_manifest(
            Manifest(name, 1, "", {}, {}, {}, metrics.get(name, {}), number, 50.0 * number), path / MANIFEST_FILE
        )
    return inputs


def make_avatar(body: Body) -> TexturedAvatar:
    """The body itself, its texture a smooth pattern of colours between 40 and 160."""
    rows, columns = np.mgrid[0:64, 0:64] / 64.0
    pattern = np.stack([rows, columns, 0.5 + 0.0 * rows], axis=2) * 120 + 40
    uv = np.stack([body.vertices[:, 0] + 0.5, body.vertices[:, 1] / 1.8], axis=1)
    indices, weights = top_k_weights(body.skin_weights)
    pad = ((0, 0), (0, 4 - indices.shape[1]))
    return TexturedAvatar(
        vertices=torch.from_numpy(body.vertices),
        faces=torch.from_numpy(body.faces),
        joint_indices=torch.from_numpy(np.pad(indices, pad).astype(np.int64)),
        joint_weights=torch.from_numpy(np.pad(weights, pad)),
        uv=torch.from_numpy(uv.astype(np.float32)),
        faces_uv=torch.from_numpy(body.faces),
        diffuse=torch.from_numpy(np.rint(pattern).astype(np.float32) / 255.0),
    )


def _write_frames(folder: Path, avatar: TexturedAvatar, poses: torch.Tensor) -> None:
    """The avatar in its poses before a grey wall, COLOUR_ERROR too bright."""
    count = len(FRAME_INDEX)
    for path in (image_path(folder, 0).parent, mask_path(folder, 0).parent):
        path.mkdir()
    for index, pose in zip(FRAME_INDEX, poses, strict=True):
        rgba = avatar.render(avatar.pose_vertices(pose), CAMERA, supersampling=3)
        alpha = rgba[..., 3:]
        brighter = rgba[..., :3] + alpha * (COLOUR_ERROR / 255.0)
        straight = np.where(alpha > 0, brighter / np.maximum(alpha, 1e-6), 0.5)
        write_rgb(image_path(folder, int(index)), to_uint8(straight))
        write_gray(mask_path(folder, int(index)), to_uint8(alpha[..., 0]))
    capture = Capture(
        folder=folder,
        frame_index=FRAME_INDEX,
        time_s=FRAME_INDEX / FRAME_RATE,
        split=np.select([FRAME_INDEX % 8 == 0, FRAME_INDEX == 4], [HELDOUT, VALIDATION], TRAIN).astype(np.uint8),
        fps=FRAME_RATE,
        width=CAMERA.width,
        height=CAMERA.height,
        landmarks_px=np.zeros((count, 33, 2), dtype=np.float32),
        landmarks_visibility=np.zeros((count, 33), dtype=np.float32),
        landmarks_world_m=np.zeros((count, 33, 3), dtype=np.float32),
        camera=None,
        mask_source="supplied",
        n_video_frames=20,
        scale=1.0,
    )
    save_capture(capture)
    write_rgb(folder / "contact.jpg", np.full((20, 30, 3), 90, dtype=np.uint8))


def _write_body(folder: Path, body: Body, motion: Motion) -> None:
    """The fitted poses are 3 cm to the side of the true ones, which the field found."""
    save_body(folder / "body.npz", body)
    shifted = replace(motion, root_translation_m=motion.root_translation_m + np.array([0.03, 0, 0], dtype=np.float32))
    save_motion(folder / "motion.npz", shifted)
    save_camera(folder / "camera.npz", CAMERA)
    write_rgb(folder / "overlay.png", np.full((20, 30, 3), 120, dtype=np.uint8))


def _write_field(folder: Path, body: Body, motion: Motion) -> None:
    """An untrained field: grey fog in the body's box."""
    bounds_m = np.stack([body.vertices.min(axis=0) - 0.05, body.vertices.max(axis=0) + 0.05]).astype(np.float32)
    save_field(
        folder / "field.safetensors",
        RadianceField(bounds_m, hash_grid_layout(bounds_m, 0.05, 2, 2, 10), hidden_width=16),
    )
    occupied = torch.ones(RESOLUTION, RESOLUTION, RESOLUTION, dtype=torch.uint8)
    save_occupancy(folder / "occupancy.npz", BinaryOccupancy(occupied, torch.from_numpy(bounds_m)))
    save_motion(folder / "motion.npz", motion)


def _write_mesh_and_texture(mesh_dir: Path, texture_dir: Path, avatar: TexturedAvatar, motion: Motion) -> None:
    indices, weights = avatar.joint_indices.numpy(), avatar.joint_weights.numpy()
    save_motion(mesh_dir / "motion.npz", motion)
    save_mesh(mesh_dir, MeshArtifact(avatar.mesh(), indices, weights, np.full((len(weights), 3), 0.5)))
    cv2.imwrite(str(mesh_dir / "preview.png"), np.full((20, 30, 3), 60, dtype=np.uint8))
    side_px = len(avatar.diffuse)
    atlas = Atlas(avatar.uv.numpy(), avatar.faces_uv.numpy(), np.arange(len(avatar.uv), dtype=np.int32))
    blank = np.zeros((side_px, side_px), dtype=np.uint8)
    light = VideoLight.uniform(len(motion.frame_index))
    save_texture(
        texture_dir, TextureArtifact(atlas, avatar.diffuse.numpy(), to_float(blank), blank, light, Highlights.none())
    )
