"""A run folder up to the mesh stage, made from a scene with known truth, for the stages that come after."""

from pathlib import Path

import numpy as np

from pipeline.body.body import Body, Motion
from pipeline.body.files import save_body, save_camera, save_motion
from pipeline.capture.capture import Capture, image_path, mask_path, save_capture
from pipeline.capture.frame_selection import assign_splits
from pipeline.capture.usable_frames import SCORES_NPZ
from pipeline.field.field import RadianceField, hash_grid_layout
from pipeline.field.files import save_field
from pipeline.geometry.camera import Camera
from pipeline.geometry.skinning import top_k_weights
from pipeline.io.image import write_gray, write_rgb
from pipeline.io.npz import save_npz
from pipeline.mesh.files import MeshArtifact, save_dense_mesh, save_mesh
from pipeline.template.correspondence import correspond
from pipeline.template.files import FittedTemplate, save_template
from pipeline.template.registration import Registration

FPS = 24.0


def known_registration(body: Body) -> Registration:
    """The template on a person whose surface is that of the built-in body; no face is found on it."""
    count = len(body.vertices)
    return Registration(body.vertices.astype(np.float64), np.zeros(count), np.ones(count, dtype=bool), 0, False)


def save_known_template(texture_dir: Path, body: Body) -> None:
    """Write template.npz for a person whose surface is that of the built-in body."""
    exact = known_registration(body)
    save_template(
        texture_dir, FittedTemplate(exact, correspond(body, exact, body.mesh(), np.full_like(body.vertices, 0.5)))
    )


def make_run(
    folder: Path, body: Body, motion: Motion, camera: Camera, images: list[np.ndarray], masks: list[np.ndarray]
) -> dict[str, Path]:
    """The folders `frames`, `body`, `field` (untrained: its colours mean nothing) and `mesh` (the body's surface)."""
    inputs = {name: folder / name for name in ("frames", "body", "field", "mesh")}
    for path in (*inputs.values(), inputs["frames"] / "images", inputs["frames"] / "masks"):
        path.mkdir(parents=True)
    unknown = np.full((len(images), 33, 3), np.nan, dtype=np.float32)
    save_capture(
        Capture(
            folder=inputs["frames"],
            frame_index=motion.frame_index,
            time_s=motion.frame_index / FPS,
            split=assign_splits(motion.frame_index),
            fps=FPS,
            width=camera.width,
            height=camera.height,
            landmarks_px=unknown[..., :2],
            landmarks_visibility=unknown[..., 0],
            landmarks_world_m=unknown,
            camera=camera,
            mask_source="truth",
            n_video_frames=int(motion.frame_index[-1]) + 1,
            scale=1.0,
        )
    )
    for index, image, mask in zip(motion.frame_index.tolist(), images, masks, strict=True):
        write_rgb(image_path(inputs["frames"], index), image)
        write_gray(mask_path(inputs["frames"], index), mask)
    save_body(inputs["body"] / "body.npz", body)
    save_camera(inputs["body"] / "camera.npz", camera)
    save_npz(inputs["body"] / SCORES_NPZ, {"usable": np.ones(len(images), dtype=bool)})
    for stage in ("field", "mesh"):
        save_motion(inputs[stage] / "motion.npz", motion)
    bounds_m = np.stack([body.vertices.min(axis=0) - 0.1, body.vertices.max(axis=0) + 0.1]).astype(np.float32)
    save_field(
        inputs["field"] / "field.safetensors", RadianceField(bounds_m, hash_grid_layout(bounds_m, 0.05, 2, 2, 10))
    )
    grey = np.full_like(body.vertices, 0.5)
    save_dense_mesh(inputs["mesh"], body.mesh())
    save_mesh(inputs["mesh"], MeshArtifact(body.mesh(), *top_k_weights(body.skin_weights), grey))
    return inputs
