"""mesh: a watertight, manifold mesh of the canonical field, refined on the video frames; poses fitted through it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Int
from pydantic import Field, ValidationInfo, field_validator
from torch import Tensor

from pipeline.avatar.turntable import turntable_sheet
from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.body.files import load_body, load_camera, load_motion, save_motion
from pipeline.capture.capture import Capture, load_capture
from pipeline.capture.frame_selection import TRAIN, VALIDATION, evenly_spaced
from pipeline.capture.usable_frames import usable_frames, usable_positions
from pipeline.core.cli import main
from pipeline.core.command import rerun_command
from pipeline.core.config import Config as BaseConfig
from pipeline.core.errors import UserError
from pipeline.core.progress import track, warn
from pipeline.core.stage import Stage
from pipeline.field.field import FieldColours, RadianceField
from pipeline.field.files import load_field, load_occupancy
from pipeline.field.occupancy import BinaryOccupancy
from pipeline.geometry.camera import pixel_footprint_m
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import top_k_weights
from pipeline.geometry.surface import OpenSurfaceError, resolve_self_intersections
from pipeline.io.image import write_rgb
from pipeline.kernels.common.determinism import deterministic_sums
from pipeline.kernels.common.heap import trim_heap
from pipeline.kernels.common.opencv_threads import single_threaded_opencv
from pipeline.kernels.common.thread_pool import shared_thread_pool
from pipeline.mesh.extraction.evidence import Evidence, gather_evidence, with_emptiness
from pipeline.mesh.extraction.fairing import fair_surface
from pipeline.mesh.extraction.isosurface import CanonicalGrid, extract_mesh, sample_canonical_grid, select_isovalue
from pipeline.mesh.face_reduction import reduce_faces
from pipeline.mesh.field_views import render_field_views
from pipeline.mesh.files import (
    DENSE_NPZ,
    MESH_NPZ,
    MeshArtifact,
    load_checkpoint,
    save_checkpoint,
    save_dense_mesh,
    save_mesh,
)
from pipeline.mesh.outline_alignment import align_outlines
from pipeline.mesh.pose_alignment import MAX_PERSON_PX, AlignedSurface
from pipeline.mesh.pose_selection import in_other_poses, is_far_from, merge_poses, score_motion
from pipeline.mesh.refinement import RefinementState, refine_mesh, with_offsets
from pipeline.mesh.remeshing import faces_by_part, remesh_to_edge_length
from pipeline.mesh.settings import MeshSettings
from pipeline.mesh.skin_relaxation import move_along, relax_skin
from pipeline.mesh.skin_transfer import SkinnedTopology, transfer_skin
from pipeline.mesh.soles import LevelSoles
from pipeline.mesh.vertex_optimisation import RefinementInputs
from pipeline.mesh.views import PosedView, crop_posed_view, mesh_psnr_db, silhouette_iou
from pipeline.metrics.health import mesh_quality_metrics
from pipeline.template.face.filmed_head import move_face_to_frames
from pipeline.template.face.filmed_landmarks import FilmedFaces
from pipeline.template.hollow_skirt import cut_out, find_cavity, hollow_skin, vertices_inside
from pipeline.template.regions import outer_surface

CHECKPOINT = "checkpoint_round.safetensors"
DEFAULT_SETTINGS = MeshSettings()
MOTIONS = ("interpolated", "aligned")
EVIDENCE_FRAMES = 40
"""Training frames that tell how well the surface is seen."""
MAX_INSIDE_SHARE = 0.2
"""Share of the faces that the inside of a skirt may have: nothing shows its details."""
JUDGED_FRAMES = 12
"""Validation frames that decide; without any, training frames on which the reduction of faces is judged."""


class Config(BaseConfig):
    """Options of the mesh stage; `pipeline.mesh.settings` has the parameters that no preset varies."""

    rounds: int = Field(2, ge=0, le=10, description="rounds of refinement; 0 keeps the extracted mesh")
    steps: int = Field(
        90,
        ge=1,
        le=5000,
        description="optimiser steps of the last round; the others have twice as many, at half of the size",
    )
    max_frames: int = Field(80, ge=1, description="training frames used, evenly spaced over the recording")
    max_person_px: int = Field(
        480, ge=64, le=4096, description="frames are downsampled until the person is at most this high, px"
    )
    voxel_size_m: float = Field(0.005, gt=0.001, le=0.012, description="spacing of the density samples, m")
    edge_px: float = Field(3.0, gt=0.5, le=20.0, description="target edge length, in pixels of the downsampled frames")
    min_edge_m: float = Field(0.008, gt=0.001, description="lower limit of the target edge length, m")
    max_edge_m: float = Field(0.014, gt=0.001, description="upper limit of the target edge length, m")
    max_faces: int = Field(60000, ge=100, description="no face is subdivided beyond this number of faces")
    max_final_faces: int = Field(
        14500,
        ge=100,
        description="upper limit of faces of the finished mesh, whatever it costs; in the .glb the template's layout "
        "(texture.atlas) adds up to 30 %, and the face that moves (export.face) up to 6000",
    )

    @field_validator("max_edge_m")
    @classmethod
    def _at_least_min_edge(cls, max_edge_m: float, checked: ValidationInfo) -> float:
        min_edge_m = checked.data.get("min_edge_m", max_edge_m)
        if max_edge_m < min_edge_m:
            raise ValueError(f"at least min_edge_m, which is {min_edge_m}")
        return max_edge_m


@deterministic_sums()
def run(
    inputs: Mapping[str, Path], out: Path, config: Config, settings: MeshSettings = DEFAULT_SETTINGS
) -> Mapping[str, float]:
    """Extract and refine the mesh, and refit the motion through it; write the files of `STAGE.makes`.

    Args:
        inputs: folders of the stages frames, body and field.
        out: folder of this stage.
        config: options of the stage.
        settings: parameters that only sweeps and ablations vary.

    Returns:
        The metrics of the manifest. Those of the mesh are of the written one, in the poses aligned to it, except
        `initial_validation_psnr_db`.
    """
    body = load_body(inputs["body"] / "body.npz")
    capture = load_capture(inputs["frames"])
    motion = load_motion(inputs["field"] / "motion.npz")
    parts = usable_positions(capture, inputs["body"]), usable_positions(capture, inputs["body"], VALIDATION)
    limits = config.max_frames, min(config.max_frames, JUDGED_FRAMES)
    chosen = [part[evenly_spaced(len(part), limit)] for part, limit in zip(parts, limits, strict=True)]
    train, validation = (load_views(capture, part, motion, inputs, body, config.max_person_px) for part in chosen)
    if not train:
        again = rerun_command("frames", inputs["frames"])
        raise UserError(f"{inputs['frames']} has no training frames; run {again}")
    if not validation:
        warn(f"{inputs['frames']} has no validation frames: the isovalue and the rounds are not validated")

    target_edge_m = select_target_edge_m(body, train, config)
    field = load_field(inputs["field"] / "field.safetensors")
    occupancy = load_occupancy(inputs["field"] / "occupancy.npz")
    if settings.field_views:
        train += render_field_views(field, occupancy, body, train, settings.field_views)
    field = field.requires_grad_(settings.appearance_learning_rate > 0.0)
    refinement_inputs = RefinementInputs(
        body=body,
        train=train,
        validation=validation,
        shader=FieldColours(field),
        target_edge_m=target_edge_m,
        rounds=config.rounds,
        steps=config.steps,
        max_faces=config.max_faces,
        train_motion=motion.select(chosen[0]),
        validation_motion=motion.select(chosen[1]),
        settings=settings,
    )
    camera = load_camera(inputs["body"] / "camera.npz")
    faces = FilmedFaces.of_capture(capture, parts[0], canonical_to_world(body, motion), camera)
    start_inputs = replace(refinement_inputs, body=move_face_to_frames(body, faces))
    start = load_checkpoint(out / CHECKPOINT) or starting_mesh(field, occupancy, start_inputs, config.voxel_size_m)
    state = refine_mesh(start, refinement_inputs, lambda state: save_checkpoint(out / CHECKPOINT, state))
    aligned = with_offsets(refinement_inputs, state.pose_offsets)
    if state.pose_offsets:
        motion = state.pose_offsets.of(body, motion.select(chosen[0])).apply(motion)
    shader, psnr_db = aligned.shader, state.validation_psnr_db
    finished = finish_mesh(state, aligned, load_body(inputs["body"] / "bare.npz"), config.max_final_faces)
    relaxed = relax_skin(finished.mesh, finished.skin, body, aligned.train)
    mesh, skin = relaxed.mesh, relaxed.skin
    final_motion, motion_metrics = align_other_frames(
        capture, inputs, (body, motion), (mesh, skin, shader), aligned.validation
    )
    soles = LevelSoles.of(mesh, skin.weights, body, motion.select(parts[0]))
    level = soles.turn_mesh(mesh, skin.weights, body)
    save_dense_mesh(out, move_along(finished.dense, finished.mesh, level))
    write_results(out, mesh, (level, soles), skin, shader, finished.is_inside)
    save_motion(out / "motion.npz", soles.turn_motion_back(final_motion, body))
    return {
        **{key: float(value) for key, value in mesh_quality_metrics(mesh).items()},
        "initial_validation_psnr_db": psnr_db[0],
        "refined_validation_psnr_db": mesh_psnr_db(mesh, skin, aligned.validation, shader),
        "silhouette_iou": silhouette_iou(mesh, skin, aligned.validation),
        "target_edge_m": target_edge_m,
        "accepted_rounds": len(psnr_db) - 1.0,
        "faces_before_reduction": float(len(state.mesh.faces)),
        "stretch_p999": relaxed.stretch_after,
        "stretch_p999_before": relaxed.stretch_before,
        "relaxation_shown_p99_mm": relaxed.shown_change_mm,
        **motion_metrics,
    }


def starting_mesh(
    field: RadianceField, occupancy: BinaryOccupancy, inputs: RefinementInputs, voxel_size_m: float
) -> Mesh:
    """Extract the surface of the field, its face at that of `inputs.body`, and remesh it to the target edge length."""

    def density_fn(points_m: Tensor) -> Tensor:
        occupied, density = occupancy.contains(points_m), torch.zeros(len(points_m))
        density[occupied] = field.density(points_m[occupied])
        return density

    body, train, settings = inputs.body, inputs.train, inputs.settings
    samples = sample_canonical_grid(density_fn, occupancy.occupied_bounds_m(), body, voxel_size_m, settings)
    witnesses = [train[k] for k in evenly_spaced(len(train), EVIDENCE_FRAMES)]
    samples = with_emptiness(samples, body, witnesses)
    evidence = gather_evidence(body, witnesses, samples.ambiguous_m)
    extracted = extract_initial_mesh(samples, body, evidence, inputs.validation or train, settings)
    return remesh_to_edge_length(extracted, inputs.target_edge_m, body)


@dataclass(frozen=True)
class FinishedMesh:
    """The mesh with few faces and a hollow skirt, if the person wears one.

    mesh, skin: of the export. dense: before the reduction of its faces. is_inside: vertices of the mesh inside of a
    skirt or coat; None without one.
    """

    mesh: Mesh
    skin: SkinnedTopology
    dense: Mesh
    is_inside: Bool[np.ndarray, "v"] | None = None


def finish_mesh(state: RefinementState, inputs: RefinementInputs, bare: Body, face_limit: int) -> FinishedMesh:
    """Reduce the faces of the refined mesh, untangle it, and make its skirt hollow.

    bare: the body below the clothes. face_limit: see `reduce_faces`.
    """
    try:
        cavity = find_cavity(
            state.mesh,
            state.skin.weights.numpy(),
            inputs.body,
            bare,
            inputs.target_edge_m,
            int(MAX_INSIDE_SHARE * face_limit),
        )
        if cavity is not None:
            dense = cut_out(state.mesh, cavity)
            solid, skin = reduce_refined_mesh(state, inputs, face_limit - len(cavity.faces))
            mesh = cut_out(solid, cavity, face_limit)
            is_inside = vertices_inside(mesh, cavity)
            return FinishedMesh(mesh, hollow_skin(mesh, solid, skin, inputs.body, is_inside), dense, is_inside)
    except OpenSurfaceError as error:
        warn(f"{error}; the inside of the skirt stays closed")
    return FinishedMesh(*reduce_refined_mesh(state, inputs, face_limit), state.mesh)


def reduce_refined_mesh(
    state: RefinementState, inputs: RefinementInputs, face_limit: int
) -> tuple[Mesh, SkinnedTopology]:
    """Reduce the faces of the refined mesh, judged on validation views (else on training views); untangle it."""
    views = inputs.validation or [inputs.train[k] for k in evenly_spaced(len(inputs.train), JUDGED_FRAMES)]

    def psnr_db(trial: Mesh) -> float:
        return mesh_psnr_db(trial, transfer_skin(trial, inputs.body), views, inputs.shader)

    parts = faces_by_part(state.mesh, inputs.body)
    mesh = resolve_self_intersections(reduce_faces(state.mesh, parts, psnr_db, inputs.settings, face_limit))
    return mesh, state.skin if mesh is state.mesh else transfer_skin(mesh, inputs.body)


def select_target_edge_m(body: Body, views: Sequence[PosedView], config: Config) -> float:
    """Return the target edge length (m): `edge_px` pixels of the views, within the limits of the config."""
    vertices, weights = torch.from_numpy(body.vertices), torch.from_numpy(body.skin_weights)
    footprints_m = [pixel_footprint_m(view.pose_vertices(vertices, weights), view.camera) for view in views]
    return float(np.clip(config.edge_px * float(np.median(footprints_m)), config.min_edge_m, config.max_edge_m))


def extract_initial_mesh(
    samples: CanonicalGrid,
    body: Body,
    evidence: Evidence,
    views: Sequence[PosedView],
    settings: MeshSettings,
) -> Mesh:
    """Extract the surface of the density at the isovalue with the highest silhouette IoU.

    The IoU is computed on at most `settings.isovalue_frames` of the views. evidence: what the training views tell.
    """
    isovalue_views = [views[k] for k in evenly_spaced(len(views), settings.isovalue_frames)]

    def score(mesh: Mesh) -> float:
        return silhouette_iou(mesh, transfer_skin(mesh, body), isovalue_views)

    isovalue_per_m, _ = select_isovalue(samples, settings, score)
    trim_heap()
    extracted = extract_mesh(samples, isovalue_per_m, settings)
    trim_heap()
    return fair_surface(extracted, samples, body, outer_surface(body), evidence, settings)


def load_views(
    capture: Capture,
    positions: Int[np.ndarray, "k"],
    motion: Motion,
    inputs: Mapping[str, Path],
    body: Body,
    max_person_px: int,
) -> list[PosedView]:
    """Load crops of the frames at these positions, in their poses of the motion."""
    camera = load_camera(inputs["body"] / "camera.npz")
    poses = canonical_to_world(body, motion.select(positions))
    pool = shared_thread_pool(torch.get_num_threads())

    def load_view(row: int) -> PosedView:
        frame = capture.image(positions[row]), capture.mask(positions[row])
        return crop_posed_view(*frame, camera, poses[row], max_person_px)

    with single_threaded_opencv():
        return list(track(pool.imap(load_view, range(len(positions))), "reading frames", len(positions)))


def align_other_frames(
    capture: Capture,
    inputs: Mapping[str, Path],
    posed_body: tuple[Body, Motion],
    shaded_mesh: tuple[Mesh, SkinnedTopology, torch.nn.Module],
    validation: Sequence[PosedView],
) -> tuple[Motion, dict[str, float]]:
    """Align the frames that are not trained on to the outlines of their masks through the mesh; never to colours.

    Training frames keep their poses, and so do frames without a usable fit: their masks may show someone else. Frames
    near training frames keep the interpolated corrections, with a warning, unless the validation views prefer the new
    poses (`MotionScores.is_better_than`). Frames far from them have no corrections; they keep their poses unless the
    outlines of these frames fit better.

    validation: views of evenly spaced validation frames, from `load_views`.

    Returns:
        The motion, and metrics.
    """
    (body, motion), (mesh, skin, shader) = posed_body, shaded_mesh
    usable = usable_frames(capture, inputs["body"])
    is_trained = usable & (capture.split == TRAIN)
    views = load_views(capture, np.flatnonzero(usable & ~is_trained), motion, inputs, body, MAX_PERSON_PX)
    surface = AlignedSurface.without_colours(torch.from_numpy(mesh.vertices), skin)
    fitted = load_motion(inputs["body"] / "motion.npz")
    motions = fitted.select(usable), motion.select(usable)
    aligned = motion.with_poses_at(usable, align_outlines(surface, body, motions, is_trained[usable], views))

    is_far = is_far_from(motion.time_s, motion.time_s[is_trained]) & usable
    far_views = [view for view, far in zip(views, is_far[usable & ~is_trained], strict=True) if far]
    moved = in_other_poses(far_views, canonical_to_world(body, aligned.select(np.flatnonzero(is_far))))
    use_far = silhouette_iou(mesh, skin, moved) > silhouette_iou(mesh, skin, far_views)
    positions = usable_positions(capture, inputs["body"], VALIDATION)
    positions = positions[evenly_spaced(len(positions), len(validation))]
    scores = [
        score_motion(mesh, skin, shader, validation, canonical_to_world(body, poses.select(positions)))
        for poses in (motion, aligned)
    ]
    use_near = scores[1].is_better_than(scores[0])
    is_near = usable & ~is_trained & ~is_far
    if validation and is_near.any() and not use_near:
        warn("frames next to training frames keep interpolated poses: validation frames prefer them")
    use = (is_near & use_near) | (is_far & use_far)
    return merge_poses(use, aligned, motion), {
        **{f"{name}_motion_silhouette_iou": score.silhouette_iou for name, score in zip(MOTIONS, scores, strict=True)},
        **{f"{name}_motion_psnr_db": score.psnr_db for name, score in zip(MOTIONS, scores, strict=True)},
        "aligned_frames": float(use.sum()),
    }


def write_results(
    out: Path,
    mesh: Mesh,
    level: tuple[Mesh, LevelSoles],
    skin: SkinnedTopology,
    shader: torch.nn.Module,
    is_inside: Bool[np.ndarray, "v"] | None,
) -> None:
    """Write the mesh with its skin and vertex colours, and the turntable preview.

    mesh: as the shader knows it. level: it with level soles, and its rotations. is_inside: see `MeshArtifact`.
    """
    with torch.no_grad():
        vertex_colours = shader(torch.from_numpy(mesh.vertices)).numpy()
    weights = top_k_weights(skin.weights.numpy())
    save_mesh(out, MeshArtifact(level[0], *weights, vertex_colours, is_inside=is_inside, soles=level[1]))
    write_rgb(out / "preview.png", turntable_sheet(mesh, shader))


STAGE = Stage(
    "mesh",
    version=57,
    needs=("frames", "body", "field"),
    makes=(MESH_NPZ, DENSE_NPZ, "motion.npz", "preview.png"),
    config=Config,
    run=run,
)

if __name__ == "__main__":
    raise SystemExit(main(STAGE))
