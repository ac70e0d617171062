"""Measures against closed forms: volumes, stretch, gain-free PSNR, noise of poses, files with nan."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from safetensors.torch import save_file

from data_tools.stress.measures import (
    LIMB_MIDDLE,
    edge_stretch,
    files_with_nonfinite_values,
    gained_psnr_db,
    limb_volumes_m3,
)
from data_tools.stress.procedures import noisy_motion
from pipeline.body.body import Body, Motion
from pipeline.geometry.colour import linear_to_srgb, srgb_to_linear
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.rotation import quaternion_conjugate, quaternion_multiply, quaternion_to_axis_angle
from pipeline.io.image import to_uint8
from pipeline.io.npz import save_npz


def limb_body(radius_m: float, length_m: float) -> Body:
    """A body whose left upper arm is an oblique cylinder about its bone."""
    start, axis = np.array([0.2, 1.4, 0.1]), np.array([0.6, -0.64, 0.48])
    segment = np.stack([start, start + length_m * axis])
    cylinder = trimesh.creation.cylinder(radius_m, segment=segment, sections=64).subdivide_to_size(0.02)
    names = (
        "Hips",
        *(f"{side}{part}" for side in ("Left", "Right") for part in ("Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot")),
    )
    joints = np.random.default_rng(0).uniform(2.0, 3.0, (len(names), 3)).astype(np.float32)
    joints[names.index("LeftArm")], joints[names.index("LeftForeArm")] = segment
    weights = np.zeros((len(cylinder.vertices), len(names)), np.float32)
    weights[:, names.index("LeftArm")] = 1.0
    vertices, faces = np.asarray(cylinder.vertices, np.float32), np.asarray(cylinder.faces, np.int32)
    return Body(names, np.zeros(len(names), np.int32), joints, vertices, faces, weights, {})


def test_the_volume_of_a_cylinder() -> None:
    volumes = limb_volumes_m3(limb_body(0.05, 0.3))
    expected = np.pi * 0.05**2 * 0.3 * (LIMB_MIDDLE[1] - LIMB_MIDDLE[0])
    assert volumes["LeftArm"] == pytest.approx(expected, rel=0.05)
    assert volumes["RightLeg"] == 0.0
    ratio = limb_volumes_m3(limb_body(0.06, 0.3))["LeftArm"] / volumes["LeftArm"]
    assert ratio == pytest.approx(1.44, rel=0.02)


def test_stretch_of_edges() -> None:
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    mesh = Mesh(np.asarray(box.vertices, np.float32), np.asarray(box.faces, np.int32))
    assert np.allclose(edge_stretch(mesh, 1.5 * mesh.vertices), 1.5)
    longer = edge_stretch(mesh, mesh.vertices * [3.0, 1.0, 1.0])
    assert longer.max() == pytest.approx(3.0)
    assert longer.min() == pytest.approx(1.0)
    assert len(edge_stretch(Mesh(0.001 * mesh.vertices, mesh.faces), mesh.vertices)) == 0


def test_a_gain_costs_no_psnr_and_an_error_does() -> None:
    random = np.random.default_rng(0)
    colour = random.uniform(0.2, 0.6, (20, 20, 3))
    truth = np.dstack([to_uint8(colour), np.full((20, 20), 255, np.uint8)])
    darker = linear_to_srgb(0.5 * srgb_to_linear(colour))
    same, wrong = (np.dstack([image, np.ones((20, 20))]).astype(np.float32) for image in (darker, darker[::-1]))
    assert gained_psnr_db(truth, same) > 50.0
    assert gained_psnr_db(truth, wrong) < 25.0


def test_noise_of_poses_has_its_standard_deviation() -> None:
    count, joints = 400, 20
    rotations = np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (count, joints, 1))
    motion = Motion(
        np.arange(count, dtype=np.int32), np.arange(count) / 24.0, rotations, np.zeros((count, 3), np.float32)
    )
    noisy = noisy_motion(motion, 2.0, 0.01, seed=1)
    change = quaternion_multiply(
        quaternion_conjugate(torch.from_numpy(rotations)), torch.from_numpy(noisy.rotations_wxyz)
    )
    angle_deg = np.degrees(np.linalg.norm(quaternion_to_axis_angle(change).numpy(), axis=2))
    assert np.sqrt((angle_deg**2).mean()) == pytest.approx(2.0, rel=0.05)
    assert noisy.root_translation_m.std() == pytest.approx(0.01, rel=0.1)
    assert np.array_equal(noisy.rotations_wxyz, noisy_motion(motion, 2.0, 0.01, seed=1).rotations_wxyz)
    assert np.allclose(noisy_motion(motion, 0.0, 0.0, seed=1).rotations_wxyz, rotations, atol=1e-6)


def test_files_with_nan_are_found(tmp_path: Path) -> None:
    for name in ("frames", "body", "field"):
        (tmp_path / name).mkdir()
    bad, good = np.array([1.0, np.nan]), np.array([1, 2])
    save_npz(tmp_path / "frames" / "frames.npz", {"landmarks_px": bad})  # nan means unknown here
    save_npz(tmp_path / "body" / "body.npz", {"vertices": bad, "faces": good})
    save_npz(tmp_path / "body" / "motion.npz", {"rotations": np.ones(3)})
    save_file({"table": torch.tensor([1.0, float("inf")])}, tmp_path / "field" / "field.safetensors")
    (tmp_path / "bad.json").write_text('{"a": NaN}')
    (tmp_path / "good.json").write_text(json.dumps({"name": "NaN", "a": None}))
    assert files_with_nonfinite_values(tmp_path) == ["bad.json", "body/body.npz", "field/field.safetensors"]
