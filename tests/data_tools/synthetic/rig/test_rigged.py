"""Rigged people from .glb files: a small one with known dimensions and colours, and real ones."""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from data_tools.evaluate.truth import verify_ground_truth
from data_tools.from_gltf import main
from data_tools.synthetic.rig.rigged import JOINT_NAMES, read_rigged_person
from pipeline.core.errors import UserError
from pipeline.io.glb import GlbFile
from tests.data_tools.synthetic.rig.glb_writer import (
    BOX_M,
    COLOUR,
    POSITION_RANGE_M,
    RIG,
    box_vertices,
    write_test_glb,
)

TINY = ["--frames", "2", "--fps", "2", "--size", "160", "--novel-views", "0", "--novel-poses", "1"]


@pytest.fixture(scope="module", params=["", "mixamorig:"])
def made_up(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("glb") / "person.glb"
    write_test_glb(path, prefix=request.param)
    return path


def test_accessors(made_up: Path) -> None:
    """Normalised integers with a stride become fractions; the colour factor halves the green light (120 to 86)."""
    glb = GlbFile(made_up)
    primitive = glb.skinned_primitives()[0]
    assert np.allclose(primitive.positions * POSITION_RANGE_M, box_vertices(), atol=POSITION_RANGE_M / 32767)
    assert np.allclose(primitive.weights.sum(axis=1), 1.0)
    assert glb.base_colour(0)[0, 0].tolist() == [COLOUR[0], 86, COLOUR[2]]


def test_metres_and_joints(made_up: Path) -> None:
    """Legs and head keep their T-pose positions relative to the ground, although the rig is in centimetres."""
    body = read_rigged_person(made_up).body
    lowest = min(place[1] for _, _, place in RIG) - BOX_M
    for name, _, place in RIG:
        if name in JOINT_NAMES and "Arm" not in name and "Hand" not in name:
            assert np.allclose(body.joints_m[body.joint(name)], np.array(place) - [0.0, lowest, 0.0], atol=1e-4)
    assert body.height_m() == pytest.approx(1.7 + BOX_M - lowest, abs=1e-3)
    assert body.vertices[:, 1].min() == pytest.approx(0.0, abs=1e-6)


def test_parents_precede_children_and_other_joints_are_merged(made_up: Path) -> None:
    body = read_rigged_person(made_up).body
    assert "HeadEnd" not in body.joint_names
    assert all(parent < joint for joint, parent in enumerate(body.parents))
    names = [name for name, _, _ in RIG]
    head_end = slice(8 * names.index("HeadEnd"), 8 * names.index("HeadEnd") + 8)
    assert np.allclose(body.skin_weights[head_end, body.joint("Head")], 1.0)
    parent_of = {name: parent for name, parent, _ in RIG}
    for joint, name in enumerate(body.joint_names[1:], start=1):
        assert body.joint_names[body.parents[joint]] == parent_of[name]


def test_arms_are_lowered_and_keep_their_length(made_up: Path) -> None:
    body = read_rigged_person(made_up).body
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        arm, forearm, hand = (body.joints_m[body.joint(f"{side}{part}")] for part in ("Arm", "ForeArm", "Hand"))
        assert np.linalg.norm(forearm - arm) == pytest.approx(0.25, abs=1e-5)
        assert np.linalg.norm(hand - forearm) == pytest.approx(0.25, abs=1e-5)
        assert (hand - arm)[0] * sign > 0.2
        assert (hand - arm)[1] < -0.2
        names = [name for name, _, _ in RIG]
        box = body.vertices[8 * names.index(f"{side}Hand") :][:8]
        assert np.allclose(box.mean(axis=0), hand, atol=1e-4)


def test_faces_are_labelled_by_body_part(made_up: Path) -> None:
    """Each face has the part of the joint with the largest weight at its corners."""
    subject = read_rigged_person(made_up)
    body, labels = subject.body, subject.labels
    assert labels is not None
    name_of_face = np.array(labels.names)[labels.of_face]
    joint = body.skin_weights[body.faces].sum(axis=1).argmax(axis=1)
    expected = {"Head": "head", "LeftFoot": "feet", "Hips": "trunk", "RightForeArm": "arms", "LeftLeg": "legs"}
    assert set(expected.values()) | {"hands"} >= set(labels.names)
    for name, part in expected.items():
        found = set(name_of_face[joint == body.joint(name)].tolist())
        assert found == {part}


def test_capture_of_a_small_rig_is_consistent(made_up: Path, tmp_path: Path) -> None:
    main([str(made_up), str(tmp_path / "out"), *TINY])
    assert verify_ground_truth(tmp_path / "out").passes()


def test_rig_without_an_arm_is_an_error(tmp_path: Path) -> None:
    write_test_glb(tmp_path / "person.glb", drop="LeftForeArm")
    with pytest.raises(UserError, match="no joint named LeftForeArm"):
        read_rigged_person(tmp_path / "person.glb")


@pytest.mark.parametrize("content", [b"", b"glTF", b"no glTF at all, though long enough to look into"])
def test_files_of_other_formats_are_errors(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "person.glb").write_bytes(content)
    with pytest.raises(UserError, match="is no binary glTF 2 file"):
        read_rigged_person(tmp_path / "person.glb")


def changed(path: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """Change the JSON of a .glb in place."""
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    gltf = json.loads(data[20 : 20 + length])
    change(gltf)
    text = json.dumps(gltf).encode()
    text += b" " * (-len(text) % 4)
    whole = data[:8] + struct.pack("<I", len(text) + len(data) - length) + struct.pack("<I", len(text)) + data[16:20]
    path.write_bytes(whole + text + data[20 + length :])
    return path


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda gltf: gltf.update(extensionsRequired=["KHR_draco_mesh_compression"]),
            "the extension KHR_draco",
        ),
        (lambda gltf: gltf["accessors"][0].update(sparse={"count": 1}), "accessor 0 are missing"),
        (lambda gltf: gltf["accessors"][0].pop("bufferView"), "accessor 0 are missing"),
        (lambda gltf: gltf["accessors"][0].update(count=10**6), "accessor 0 are missing"),
        (lambda gltf: gltf["accessors"][4].update(componentType=1), "accessor 4 are missing"),
        (lambda gltf: gltf["meshes"][0]["primitives"][0].update(indices=99), "accessor 99 are missing"),
        (lambda gltf: gltf.pop("nodes"), "no skinned triangles"),
        (lambda gltf: gltf["textures"][0].pop("source"), "neither PNG nor JPEG"),
        (lambda gltf: gltf["images"][0].pop("bufferView"), "image 0 is an external file"),
    ],
)
def test_unsupported_content_is_an_error(
    change: Callable[[dict[str, Any]], object], words: str, tmp_path: Path
) -> None:
    write_test_glb(tmp_path / "person.glb")
    read_rigged_person(
        changed(tmp_path / "person.glb", lambda gltf: gltf.update(extensionsRequired=["KHR_mesh_quantization"]))
    )
    with pytest.raises(UserError, match=rf"person\.glb.* {words}"):
        read_rigged_person(changed(tmp_path / "person.glb", change))


def test_damaged_json_is_an_error(tmp_path: Path) -> None:
    write_test_glb(tmp_path / "person.glb")
    whole = (tmp_path / "person.glb").read_bytes()
    for damaged in (whole[:12] + b"\0" * 8 + whole[20:], whole[:40] + b"#" + whole[41:], whole[:200]):
        (tmp_path / "person.glb").write_bytes(damaged)
        with pytest.raises(UserError, match=r"person\.glb is damaged: its JSON"):
            read_rigged_person(tmp_path / "person.glb")


@pytest.mark.parametrize("name", ["Asian_F_1_Casual", "Black_M_1_Casual"])
def test_real_people_have_human_dimensions(name: str, shared_data: Path) -> None:
    subject = read_rigged_person(shared_data / "subjects" / f"{name}.glb")
    body = subject.body
    assert set(body.joint_names) == JOINT_NAMES
    assert 1.5 < body.height_m() < 2.0
    assert np.allclose(body.skin_weights.sum(axis=1), 1.0, atol=1e-4)
    assert subject.texture.shape == (2048, 2048, 3)
    assert 0.0 <= subject.uv.min() <= subject.uv.max() <= 1.0
    for joint in ("Head", "LeftToeBase", "RightHand", "LeftLeg"):
        held = body.vertices[body.skin_weights[:, body.joint(joint)] > 0.5]
        low, high = held.min(axis=0) - 0.05, held.max(axis=0) + 0.05
        place = body.joints_m[body.joint(joint)]
        assert ((low < place) & (place < high)).all()
    nose = body.vertices[(body.vertices[:, 1] > 0.88 * body.height_m())]
    assert nose[:, 2].max() > body.joints_m[body.joint("Head"), 2] + 0.05  # faces +Z


def test_capture_driven_by_motion_capture_is_consistent(shared_data: Path, tmp_path: Path) -> None:
    person = shared_data / "subjects" / "Black_M_1_Casual.glb"
    motion = shared_data / "motions" / "cmu1_jumping_jacks.bvh"
    main([str(person), str(tmp_path / "out"), *TINY, "--bvh", str(motion), "--in-place", "--fill", "0.6"])
    assert verify_ground_truth(tmp_path / "out").passes()
