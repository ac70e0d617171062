"""The mesh stage on a small capture drawn from a known solid: what it writes, its figures, and resuming."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from pipeline.body.body import Body, Motion
from pipeline.body.files import save_body, save_camera, save_motion
from pipeline.capture.capture import Capture, image_path, mask_path, save_capture
from pipeline.capture.usable_frames import SCORES_NPZ
from pipeline.core.errors import UserError
from pipeline.geometry.camera import Camera
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.rotation import axis_angle_to_quaternion
from pipeline.geometry.surface import isosurface
from pipeline.io.image import read_rgb, write_gray, write_rgb
from pipeline.io.npz import load_npz, save_npz
from pipeline.mesh.refinement import RefinementState
from pipeline.mesh.views import PosedView, build_skinned_topology, render_posed_view, transfer_skin
from stages import mesh as mesh_stage
from stages.mesh import Config, run

SIZE_PX, FRAMES = 96, 12
CAMERA = Camera(190.0, 190.0, SIZE_PX / 2, SIZE_PX / 2, SIZE_PX, SIZE_PX)
CONFIG = Config(
    voxel_size_m=0.02,
    max_body_distance_m=0.1,
    solid_core_depth_m=0.06,
    rounds=2,
    steps=6,
    min_edge_m=0.03,
    max_edge_m=0.04,
    max_person_px=80,
)


def capsule(points: np.ndarray, radius: float) -> np.ndarray:
    """Radius minus distance to a standing segment from 0.2 m to 0.6 m above the ground."""
    offset = points - np.stack(
        [np.zeros_like(points[..., 1]), np.clip(points[..., 1], 0.2, 0.6), points[..., 2] * 0], -1
    )
    return radius - np.linalg.norm(offset, axis=-1)


def capsule_mesh(radius: float) -> Mesh:
    axis = np.arange(-0.3, 0.3001, 0.03)
    points = np.stack(np.meshgrid(axis, np.arange(-0.1, 0.9001, 0.03), axis, indexing="ij"), axis=-1)
    return isosurface(capsule(points, radius), 0.0, points[0, 0, 0], 0.03)


class CapsuleField(torch.nn.Module):
    """Density and colour of a pill that is 3 cm thicker than the body; its mean brightness can be learnt."""

    def __init__(self) -> None:
        super().__init__()
        self.mean = torch.nn.Parameter(torch.tensor(0.5))

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        return self.mean + 0.4 * torch.sin(points * 20.0), self.density(points)

    def density(self, points: Tensor) -> Tensor:
        return torch.from_numpy(600.0 * (capsule(points.detach().numpy(), 0.18) > 0)).float()


class FullOccupancy:
    def contains(self, points: Tensor) -> Tensor:
        return torch.ones(len(points), dtype=torch.bool)


@pytest.fixture
def inputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Path]:
    """Folders of the stages before: a body that turns once around in front of the camera, and pictures of the pill."""
    monkeypatch.setattr(mesh_stage, "load_field", lambda path: CapsuleField())
    monkeypatch.setattr(mesh_stage, "load_occupancy", lambda path: FullOccupancy())
    folders = {name: tmp_path / name for name in ("frames", "body", "field")}
    for folder in (*folders.values(), folders["frames"] / "images", folders["frames"] / "masks"):
        folder.mkdir()
    thin, thick = capsule_mesh(0.15), capsule_mesh(0.18)
    one = np.ones((len(thin.vertices), 1), dtype=np.float32)
    zero = np.zeros((1, 3), dtype=np.float32)
    body = Body(("Hips",), np.array([-1], dtype=np.int32), zero, thin.vertices, thin.faces, one, {})
    turns = torch.stack([torch.tensor([0.0, 2 * np.pi * k / FRAMES, 0.0], dtype=torch.float32) for k in range(FRAMES)])
    index = np.arange(FRAMES, dtype=np.int32)
    place = np.tile(np.array([0.0, -0.4, -2.0], dtype=np.float32), (FRAMES, 1))
    motion = Motion(index, index / 30.0, axis_angle_to_quaternion(turns)[:, None].numpy(), place)
    save_body(folders["body"] / "body.npz", body)
    save_camera(folders["body"] / "camera.npz", CAMERA)
    save_npz(folders["body"] / SCORES_NPZ, {"usable": np.ones(FRAMES, dtype=bool)})
    save_motion(folders["field"] / "motion.npz", motion)
    save_capture(capture_in(folders["frames"]))
    draw_frames(folders["frames"], thick, body, motion)
    return folders


def capture_in(folder: Path) -> Capture:
    index = np.arange(FRAMES, dtype=np.int32)
    nowhere = np.full((FRAMES, 33, 3), np.nan, dtype=np.float32)
    split = np.where(index % 8 == 0, 2, np.where(index % 8 == 4, 1, 0)).astype(np.uint8)
    return Capture(
        folder, index, index / 30.0, split, 30.0, SIZE_PX, SIZE_PX, nowhere[..., :2], nowhere[..., 0], nowhere, None,
        "supplied", FRAMES, 1.0,
    )  # fmt: skip


def draw_frames(folder: Path, mesh: Mesh, body: Body, motion: Motion) -> None:
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


def test_writes_a_sound_mesh_with_skin_and_colours(inputs: dict[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    metrics = run(inputs, out, CONFIG)
    arrays = load_npz(out / "mesh.npz")
    assert metrics["watertight"] == metrics["manifold"] == metrics["components"] == 1.0
    assert metrics["vertices"] == len(arrays["vertices"])
    assert metrics["silhouette_iou"] > 0.95
    assert metrics["refined_validation_psnr_db"] >= metrics["initial_validation_psnr_db"] > 20.0
    np.testing.assert_allclose(capsule(arrays["vertices"].astype(np.float64), 0.18), 0.0, atol=0.02)
    assert arrays["faces"].dtype == np.int32
    np.testing.assert_allclose(arrays["joint_weights"].sum(axis=1), 1.0, atol=1e-5)
    assert arrays["joint_indices"].shape == arrays["joint_weights"].shape
    expected = 0.5 + 0.4 * np.sin(arrays["vertices"] * 20.0)
    np.testing.assert_allclose(arrays["vertex_colors"], expected, atol=0.02)
    preview = read_rgb(out / "preview.png")
    assert (preview < 250).any(axis=2).mean() > 0.1


def test_goes_on_from_a_killed_round_to_the_same_bytes(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    whole.mkdir()
    killed.mkdir()
    metrics = run(inputs, whole, CONFIG)
    save, calls = mesh_stage.save_checkpoint, []

    def dies_after_the_first_round(path: Path, state: object) -> None:
        save(path, state)
        calls.append(state)
        raise KeyboardInterrupt

    monkeypatch.setattr(mesh_stage, "save_checkpoint", dies_after_the_first_round)
    with pytest.raises(KeyboardInterrupt):
        run(inputs, killed, CONFIG)
    assert len(calls) == 1
    monkeypatch.setattr(mesh_stage, "save_checkpoint", save)
    monkeypatch.setattr(mesh_stage, "sample_canonical_grid", None)  # extraction must not happen again
    assert run(inputs, killed, CONFIG) == metrics
    assert (whole / "mesh.npz").read_bytes() == (killed / "mesh.npz").read_bytes()


def test_a_state_keeps_its_weights_and_they_are_what_is_exported(tmp_path: Path) -> None:
    mesh = capsule_mesh(0.18)
    share = torch.linspace(0.0, 1.0, len(mesh.vertices))
    kept = RefinementState(
        mesh, build_skinned_topology(mesh, torch.stack([1 - share, share], dim=1)), {}, 1, (20.0,), False
    )
    mesh_stage.save_checkpoint(tmp_path / "state.safetensors", kept)
    state = mesh_stage.load_checkpoint(tmp_path / "state.safetensors")
    assert state is not None
    mesh_stage.write_results(tmp_path, state, mesh_stage.FieldColourShader(CapsuleField()))
    arrays = load_npz(tmp_path / "mesh.npz")
    exported = np.zeros((len(share), 2), dtype=np.float32)
    np.add.at(exported, (np.arange(len(share))[:, None], arrays["joint_indices"]), arrays["joint_weights"])
    np.testing.assert_allclose(exported[:, 1], share, atol=1e-6)


def test_the_level_is_chosen_on_no_more_frames_than_asked_for(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Judged(Exception):
        pass

    def count(density: object, body: object, isovalue_views: list[PosedView], config: Config) -> None:
        raise Judged(len(isovalue_views))

    split = np.where(np.arange(FRAMES) < 5, 0, 1).astype(np.uint8)  # seven of them are for validation
    arrays = load_npz(inputs["frames"] / "frames.npz")
    np.savez(inputs["frames"] / "frames.npz", **(arrays | {"split": split}))
    monkeypatch.setattr(mesh_stage, "extract_initial_mesh", count)
    with pytest.raises(Judged, match="^4$"):
        run(inputs, tmp_path, CONFIG.model_copy(update={"isovalue_frames": 4}))


def test_without_training_frames_the_error_names_the_command(inputs: dict[str, Path], tmp_path: Path) -> None:
    arrays = load_npz(inputs["frames"] / "frames.npz")
    np.savez(inputs["frames"] / "frames.npz", **(arrays | {"split": np.full(FRAMES, 2, dtype=np.uint8)}))
    with pytest.raises(UserError, match="no training frames"):
        run(inputs, tmp_path, CONFIG)
