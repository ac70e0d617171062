"""The mesh stage on a small capture rendered from a known solid: its files, its metrics, and resuming."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from torch import Tensor

from pipeline.body.body import Body, Motion
from pipeline.body.files import load_motion, save_body, save_camera, save_motion
from pipeline.capture.capture import Capture, image_path, mask_path, save_capture
from pipeline.capture.usable_frames import SCORES_NPZ
from pipeline.core.errors import UserError
from pipeline.core.progress import take_warnings
from pipeline.field.field import FieldColours, RadianceField, hash_grid_layout
from pipeline.geometry.camera import Camera
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.rotation import axis_angle_to_quaternion
from pipeline.geometry.surface import OpenSurfaceError, isosurface
from pipeline.io.image import read_rgb, write_gray, write_rgb
from pipeline.io.npz import load_npz, save_npz
from pipeline.kernels.hashgrid import FeatureGradients
from pipeline.mesh.files import load_mesh
from pipeline.mesh.pose_alignment import AlignedSurface
from pipeline.mesh.settings import MeshSettings
from pipeline.mesh.skin_transfer import build_skinned_topology, transfer_skin
from pipeline.mesh.soles import LevelSoles
from pipeline.mesh.vertex_optimisation import RefinementInputs
from pipeline.mesh.views import PosedView, render_posed_view
from stages import mesh as mesh_stage
from stages.mesh import Config, run

SIZE_PX, FRAMES = 96, 12
CAMERA = Camera(190.0, 190.0, SIZE_PX / 2, SIZE_PX / 2, SIZE_PX, SIZE_PX)
CONFIG = Config(
    voxel_size_m=0.012,
    rounds=2,
    steps=6,
    min_edge_m=0.03,
    max_edge_m=0.04,
    max_person_px=80,
)
SETTINGS = MeshSettings(solid_core_depth_m=0.06)


def capsule(points: np.ndarray, radius: float) -> np.ndarray:
    """Radius minus the distance to a vertical segment from 0.2 m to 0.6 m above the ground."""
    offset = points - np.stack(
        [np.zeros_like(points[..., 1]), np.clip(points[..., 1], 0.2, 0.6), points[..., 2] * 0], -1
    )
    return radius - np.linalg.norm(offset, axis=-1)


def capsule_mesh(radius: float) -> Mesh:
    axis = np.arange(-0.3, 0.3001, 0.03)
    points = np.stack(np.meshgrid(axis, np.arange(-0.1, 0.9001, 0.03), axis, indexing="ij"), axis=-1)
    return isosurface(capsule(points, radius), 0.0, points[0, 0, 0], 0.03)


class CapsuleField(RadianceField):
    """Density and colour of a capsule that is 3 cm thicker than the body; its mean brightness is a parameter."""

    def __init__(self) -> None:
        bounds_m = np.array([[-1.0] * 3, [1.0] * 3])
        super().__init__(bounds_m, hash_grid_layout(bounds_m, 1.0, 1, 1, 4))
        self.mean = torch.nn.Parameter(torch.tensor(0.5))

    def radiance(self, points: Tensor, feature_gradients: FeatureGradients | None = None) -> tuple[Tensor, Tensor]:
        return self.mean + 0.4 * torch.sin(points * 20.0), self.density(points)

    def density(self, points: Tensor) -> Tensor:
        return torch.from_numpy(600.0 * (capsule(points.detach().numpy(), 0.18) > 0)).float()


class FullOccupancy:
    def occupied_bounds_m(self) -> np.ndarray:
        return np.array([[-0.35, -0.15, -0.35], [0.35, 0.95, 0.35]])

    def contains(self, points: Tensor) -> Tensor:
        return torch.ones(len(points), dtype=torch.bool)


@pytest.fixture
def inputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Path]:
    """Folders of the preceding stages: a body that turns around once, and frames of the thicker capsule."""
    monkeypatch.setattr(mesh_stage, "load_field", lambda path: CapsuleField())
    monkeypatch.setattr(mesh_stage, "load_occupancy", lambda path: FullOccupancy())
    monkeypatch.setattr(mesh_stage, "align_outlines", align_to(lambda motion: motion))
    folders = {name: tmp_path / name for name in ("frames", "body", "field")}
    for folder in (*folders.values(), folders["frames"] / "images", folders["frames"] / "masks"):
        folder.mkdir()
    thin, thick = capsule_mesh(0.15), capsule_mesh(0.18)
    one = np.ones((len(thin.vertices), 1), dtype=np.float32)
    zero = np.zeros((1, 3), dtype=np.float32)
    body = Body(("Hips",), np.array([-1], dtype=np.int32), zero, thin.vertices, thin.faces, one, {})
    turns = torch.stack([torch.tensor([0.0, 2 * np.pi * k / FRAMES, 0.0], dtype=torch.float32) for k in range(FRAMES)])
    index = np.arange(FRAMES, dtype=np.int32)
    root_translation_m = np.tile(np.array([0.0, -0.4, -2.0], dtype=np.float32), (FRAMES, 1))
    motion = Motion(index, index / 30.0, axis_angle_to_quaternion(turns)[:, None].numpy(), root_translation_m)
    for name in ("body.npz", "bare.npz"):
        save_body(folders["body"] / name, body)
    save_camera(folders["body"] / "camera.npz", CAMERA)
    save_npz(folders["body"] / SCORES_NPZ, {"usable": np.ones(FRAMES, dtype=bool)})
    for name in ("body", "field"):
        save_motion(folders[name] / "motion.npz", motion)
    save_capture(capture_in(folders["frames"]))
    render_frames(folders["frames"], thick, body, motion)
    return folders


def align_to(change: Callable[[Motion], Motion]) -> Callable[..., Motion]:
    """An alignment with a known result; tests/mesh/test_outline_alignment.py aligns a capsule with a hand."""

    def align(
        surface: AlignedSurface,
        body: Body,
        motions: tuple[Motion, Motion],
        is_known: np.ndarray,
        views: Sequence[PosedView],
    ) -> Motion:
        assert surface.shader is None
        assert len(views) == (~is_known).sum()
        return change(motions[1])

    return align


def shifted(motion: Motion, rows: Sequence[int], shift_m: float) -> Motion:
    root_m = motion.root_translation_m.copy()
    root_m[list(rows), 0] += shift_m
    return motion.with_pose(motion.rotations_wxyz, root_m)


def capture_in(folder: Path) -> Capture:
    index = np.arange(FRAMES, dtype=np.int32)
    missing = np.full((FRAMES, 33, 3), np.nan, dtype=np.float32)
    split = np.where(index % 8 == 0, 2, np.where(index % 8 == 4, 1, 0)).astype(np.uint8)
    return Capture(
        folder, index, index / 30.0, split, 30.0, SIZE_PX, SIZE_PX, missing[..., :2], missing[..., 0], missing, None,
        "supplied", FRAMES, 1.0,
    )  # fmt: skip


def render_frames(folder: Path, mesh: Mesh, body: Body, motion: Motion) -> None:
    skin = transfer_skin(mesh, body)
    blank = torch.zeros(SIZE_PX, SIZE_PX, dtype=torch.uint8)
    for k, transforms in enumerate(mesh_stage.canonical_to_world(body, motion)):
        view = PosedView(blank[..., None].expand(-1, -1, 3), blank, CAMERA, transforms)
        with torch.no_grad():
            image, alpha, _ = render_posed_view(
                torch.from_numpy(mesh.vertices), skin, view, lambda p: CapsuleField()(p)[0]
            )
        pixels = (255 * (image + 1 - alpha[..., None])).clamp(0, 255).round().byte().numpy()
        write_rgb(image_path(folder, k), pixels)
        write_gray(mask_path(folder, k), (255 * alpha).clamp(0, 255).round().byte().numpy())


def test_writes_a_closed_manifold_with_skin_and_colours(inputs: dict[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    metrics = run(inputs, out, CONFIG, SETTINGS)
    written = load_mesh(out)
    vertices = written.mesh.vertices
    assert metrics["watertight"] == metrics["manifold"] == metrics["components"] == 1.0
    assert metrics["vertices"] == len(vertices)
    assert metrics["silhouette_iou"] > 0.95
    assert metrics["refined_validation_psnr_db"] >= metrics["initial_validation_psnr_db"] > 20.0
    np.testing.assert_allclose(capsule(vertices.astype(np.float64), 0.18), 0.0, atol=0.02)
    assert written.mesh.faces.dtype == np.int32
    np.testing.assert_allclose(written.joint_weights.sum(axis=1), 1.0, atol=1e-5)
    assert written.joint_indices.shape == written.joint_weights.shape
    expected = 0.5 + 0.4 * np.sin(vertices * 20.0)
    np.testing.assert_allclose(written.vertex_colours, expected, atol=0.02)
    preview = read_rgb(out / "preview.png")
    assert (preview < 250).any(axis=2).mean() > 0.1


@pytest.mark.slow
def test_a_run_killed_after_a_round_resumes_to_the_same_bytes(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    whole.mkdir()
    killed.mkdir()
    metrics = run(inputs, whole, CONFIG, SETTINGS)
    save, calls = mesh_stage.save_checkpoint, []

    def stop_after_the_first_round(path: Path, state: object) -> None:
        save(path, state)
        calls.append(state)
        raise KeyboardInterrupt

    monkeypatch.setattr(mesh_stage, "save_checkpoint", stop_after_the_first_round)
    with pytest.raises(KeyboardInterrupt):
        run(inputs, killed, CONFIG, SETTINGS)
    assert len(calls) == 1
    monkeypatch.setattr(mesh_stage, "save_checkpoint", save)
    monkeypatch.setattr(mesh_stage, "sample_canonical_grid", None)  # the extraction must not run again
    assert run(inputs, killed, CONFIG, SETTINGS) == metrics
    assert (whole / "mesh.npz").read_bytes() == (killed / "mesh.npz").read_bytes()


@pytest.mark.slow
def test_renders_of_the_field_are_training_views_only(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nine of the twelve frames are learnt from; the renders join them and never the validation views."""
    seen: list[tuple[int, int]] = []
    refine = mesh_stage.refine_mesh

    def count_views(start: object, refinement_inputs: RefinementInputs, on_round_end: object) -> object:
        seen.append((len(refinement_inputs.train), len(refinement_inputs.validation)))
        return refine(start, refinement_inputs, on_round_end)

    monkeypatch.setattr(mesh_stage, "refine_mesh", count_views)
    monkeypatch.setattr(mesh_stage, "render_field_views", lambda field, _, body, views, count: list(views[:count]))
    config = CONFIG.model_copy(update={"rounds": 0})
    for name, count in (("without", 0), ("with", 4)):
        (tmp_path / name).mkdir()
        run(inputs, tmp_path / name, config, replace(SETTINGS, field_views=count))
    assert seen == [(9, 1), (13, 1)]


def test_the_number_of_final_faces_is_reached(inputs: dict[str, Path], tmp_path: Path) -> None:
    config = CONFIG.model_copy(update={"rounds": 0})
    for name, settings in (("free", SETTINGS), ("fixed", replace(SETTINGS, final_faces=300))):
        (tmp_path / name).mkdir()
        metrics = run(inputs, tmp_path / name, config, settings)
        assert metrics["faces_before_reduction"] > 400
    assert metrics["faces"] == pytest.approx(300, abs=2)


def test_the_limit_of_faces_holds(inputs: dict[str, Path], tmp_path: Path) -> None:
    config = CONFIG.model_copy(update={"rounds": 0, "max_final_faces": 300})
    metrics = run(inputs, tmp_path, config, SETTINGS)
    assert metrics["faces_before_reduction"] > 400
    assert 290 <= metrics["faces"] <= 300


@pytest.mark.parametrize(("shift_m", "kept_m"), [(-0.05, 0.0), (0.05, 0.05)])
def test_validation_frames_decide_on_the_aligned_motion(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shift_m: float, kept_m: float
) -> None:
    """Frames 0, 4, 8 are 5 cm off; the alignment moves them to the truth, or farther away."""
    path, free = inputs["field"] / "motion.npz", (0, 4, 8)
    truth = load_motion(path)
    save_motion(path, shifted(truth, free, 0.05))
    monkeypatch.setattr(mesh_stage, "align_outlines", align_to(lambda motion: shifted(motion, free, shift_m)))
    take_warnings()
    metrics = run(inputs, tmp_path, CONFIG.model_copy(update={"rounds": 0}), SETTINGS)
    np.testing.assert_array_equal(
        load_motion(tmp_path / "motion.npz").root_translation_m, shifted(truth, free, kept_m).root_translation_m
    )
    assert metrics["aligned_frames"] == (3.0 if kept_m == 0.0 else 0.0)
    assert len(take_warnings()) == (0 if kept_m == 0.0 else 1)


@pytest.mark.parametrize(("shift_m", "kept_m"), [(-0.05, 0.0), (0.05, 0.05)])
def test_frames_far_from_training_frames_follow_their_own_outline(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shift_m: float, kept_m: float
) -> None:
    """From frame 9 on nothing is learnt, and poses are 5 cm off; validation frame 4 is right and rejects the change."""
    arrays = load_npz(inputs["frames"] / "frames.npz")
    split = np.where(np.arange(FRAMES) < 8, arrays["split"], 2).astype(np.uint8)
    np.savez(inputs["frames"] / "frames.npz", **(arrays | {"split": split}))
    truth, late = load_motion(inputs["field"] / "motion.npz"), range(9, FRAMES)
    after_a_gap = replace(truth, time_s=truth.time_s + 9.0 * (np.arange(FRAMES) >= 9))
    save_motion(inputs["field"] / "motion.npz", shifted(after_a_gap, late, 0.05))
    monkeypatch.setattr(mesh_stage, "align_outlines", align_to(lambda old: shifted(old, range(FRAMES), shift_m)))
    run(inputs, tmp_path, CONFIG.model_copy(update={"rounds": 0}), SETTINGS)
    off_m = load_motion(tmp_path / "motion.npz").root_translation_m - truth.root_translation_m
    np.testing.assert_allclose(off_m[:, 0], np.where(np.arange(FRAMES) >= 9, kept_m, 0.0), atol=1e-6)


def test_frames_without_a_usable_fit_keep_their_poses(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames 8 (held out) and 3 (training) show someone else; the alignment brings the others to the truth."""
    usable = ~np.isin(np.arange(FRAMES), (3, 8))
    save_npz(inputs["body"] / SCORES_NPZ, {"usable": usable})
    path = inputs["field"] / "motion.npz"
    truth = load_motion(path)
    save_motion(path, shifted(truth, (0, 3, 4, 8), 0.05))
    rows = np.flatnonzero(np.isin(np.flatnonzero(usable), (0, 4)))
    monkeypatch.setattr(mesh_stage, "align_outlines", align_to(lambda motion: shifted(motion, rows, -0.05)))
    metrics = run(inputs, tmp_path, CONFIG.model_copy(update={"rounds": 0}), SETTINGS)
    off_m = load_motion(tmp_path / "motion.npz").root_translation_m - truth.root_translation_m
    np.testing.assert_allclose(off_m[:, 0], np.where(usable, 0.0, 0.05), atol=1e-6)
    assert metrics["aligned_frames"] == 2.0


def test_without_validation_frames_nothing_is_said_in_their_name(inputs: dict[str, Path], tmp_path: Path) -> None:
    arrays = load_npz(inputs["frames"] / "frames.npz")
    split = np.where(arrays["split"] == 1, 2, arrays["split"])
    np.savez(inputs["frames"] / "frames.npz", **(arrays | {"split": split}))
    take_warnings()
    metrics = run(inputs, tmp_path, CONFIG.model_copy(update={"rounds": 0}), SETTINGS)
    assert np.isnan(metrics["silhouette_iou"])
    assert not [warning for warning in take_warnings() if "validation frames prefer" in warning]


def test_the_exported_skin_weights_are_those_of_the_refinement(tmp_path: Path) -> None:
    mesh = capsule_mesh(0.18)
    share = torch.linspace(0.0, 1.0, len(mesh.vertices))
    skin = build_skinned_topology(mesh, torch.stack([1 - share, share], dim=1))
    mesh_stage.write_results(tmp_path, mesh, (mesh, LevelSoles()), skin, FieldColours(CapsuleField()), None)
    exported = load_mesh(tmp_path).dense_skin_weights(2)
    np.testing.assert_allclose(exported[:, 1], share, atol=1e-6)


def test_a_skirt_that_cannot_be_made_hollow_stays_closed_with_a_warning(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:

    def fail(*arguments: object) -> Mesh:
        raise OpenSurfaceError("a surface still has holes")

    monkeypatch.setattr(mesh_stage, "find_cavity", lambda *arguments: capsule_mesh(0.05))
    monkeypatch.setattr(mesh_stage, "cut_out", fail)
    run(inputs, tmp_path, CONFIG.model_copy(update={"rounds": 0}), SETTINGS)
    assert load_mesh(tmp_path).is_inside is None
    assert any("the inside of the skirt stays closed" in warning for warning in take_warnings())


def test_the_psnr_of_the_manifest_is_that_of_the_written_mesh(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Self-intersections are resolved before the final score, not after it."""
    scored: list[Mesh] = []
    score = mesh_stage.mesh_psnr_db

    def shrink(mesh: Mesh) -> Mesh:
        return Mesh(mesh.vertices * np.float32([0.9, 1.0, 0.9]), mesh.faces)

    def record(mesh: Mesh, *args: object) -> float:
        scored.append(mesh)
        return score(mesh, *args)

    monkeypatch.setattr(mesh_stage, "resolve_self_intersections", shrink)
    monkeypatch.setattr(mesh_stage, "mesh_psnr_db", record)
    metrics = run(inputs, tmp_path, CONFIG.model_copy(update={"rounds": 0}), SETTINGS)
    np.testing.assert_array_equal(load_mesh(tmp_path).mesh.vertices, scored[-1].vertices)
    assert metrics["refined_validation_psnr_db"] < metrics["initial_validation_psnr_db"] - 1.0


def test_the_isovalue_is_selected_on_the_configured_number_of_frames(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Scored(Exception):
        pass

    def count(mesh: object, skin: object, views: list[PosedView]) -> None:
        raise Scored(len(views))

    split = np.where(np.arange(FRAMES) < 5, 0, 1).astype(np.uint8)  # seven validation frames
    arrays = load_npz(inputs["frames"] / "frames.npz")
    np.savez(inputs["frames"] / "frames.npz", **(arrays | {"split": split}))
    monkeypatch.setattr(mesh_stage, "silhouette_iou", count)
    with pytest.raises(Scored, match="^4$"):
        run(inputs, tmp_path, CONFIG, replace(SETTINGS, isovalue_frames=4))


def test_a_smallest_edge_above_the_largest_is_refused_with_both_names() -> None:
    with pytest.raises(ValidationError, match=r"max_edge_m\n.*at least min_edge_m, which is 0\.02"):
        Config(min_edge_m=0.02, max_edge_m=0.01)


def test_without_training_frames_the_error_names_the_command(inputs: dict[str, Path], tmp_path: Path) -> None:
    arrays = load_npz(inputs["frames"] / "frames.npz")
    np.savez(inputs["frames"] / "frames.npz", **(arrays | {"split": np.full(FRAMES, 2, dtype=np.uint8)}))
    with pytest.raises(UserError, match="no training frames"):
        run(inputs, tmp_path, CONFIG, SETTINGS)
