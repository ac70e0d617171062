"""Expressions of VRM: every preset refers to morph targets that exist, by the right index."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.avatar.formats.vrm import VrmMeta, encode_vrm0, encode_vrm1
from pipeline.avatar.formats.vrm_expressions import EXPRESSIONS
from pipeline.io.glb import GlbFile
from pipeline.io.glb_writer import GlbWriter
from pipeline.template.face.units import VISEMES, load_face_units
from pipeline.template.reshape import SHAPE_KEYS
from tests.avatar.formats.anny_avatar import anny_body, anny_glb

META = VrmMeta("avatar", "A. Person", "")


@pytest.fixture(scope="module")
def names() -> list[str]:
    return [*load_face_units().names, *VISEMES]


def vrm_files(names: list[str], folder: Path) -> dict[str, GlbFile]:
    """VRM files of an avatar with one sparse morph target for each name."""
    document = GlbWriter.from_file(anny_glb(folder))
    (mesh,) = document.json["meshes"]
    count = document.json["accessors"][mesh["primitives"][0]["attributes"]["POSITION"]]["count"]
    offsets = np.zeros((count, 3), np.float32)
    offsets[0, 2] = 0.01
    mesh["primitives"][0]["targets"] = [{"POSITION": document.add_sparse_array(offsets, bounds=True)} for _ in names]
    mesh["extras"] = {"targetNames": names}
    (folder / "morphs.glb").write_bytes(document.to_bytes())
    glb, joints = GlbFile(folder / "morphs.glb"), anny_body().joint_names
    (folder / "one.vrm").write_bytes(encode_vrm1(glb, joints, META))
    (folder / "zero.vrm").write_bytes(encode_vrm0(glb, joints, META))
    return {"1.0": GlbFile(folder / "one.vrm"), "0.x": GlbFile(folder / "zero.vrm")}


@pytest.fixture(scope="module")
def files(names: list[str], tmp_path_factory: pytest.TempPathFactory) -> dict[str, GlbFile]:
    return vrm_files(names, tmp_path_factory.mktemp("vrm"))


def test_presets_of_vrm_1_bind_the_named_targets(files: dict[str, GlbFile], names: list[str]) -> None:
    vrm = files["1.0"].gltf["extensions"]["VRMC_vrm"]
    presets = vrm["expressions"]["preset"]
    assert {"aa", "ih", "ou", "ee", "oh", "blink", "lookLeft", "happy", "angry", "sad", "relaxed"} <= set(presets)
    for preset, expression in presets.items():
        bound = {names[bind["index"]]: bind["weight"] for bind in expression["morphTargetBinds"]}
        assert bound == EXPRESSIONS[preset][1]
        assert all("mesh" in files["1.0"].gltf["nodes"][bind["node"]] for bind in expression["morphTargetBinds"])
    assert vrm["lookAt"]["type"] == "expression"


def test_groups_of_vrm_0_have_weights_in_percent(files: dict[str, GlbFile], names: list[str]) -> None:
    vrm = files["0.x"].gltf["extensions"]["VRM"]
    groups = {group["presetName"]: group for group in vrm["blendShapeMaster"]["blendShapeGroups"]}
    assert {"a", "i", "u", "e", "o", "blink", "blink_l", "lookup", "joy", "sorrow"} <= set(groups)
    (bind,) = groups["blink_l"]["binds"]
    assert (names[bind["index"]], bind["weight"], bind["mesh"]) == ("eyeBlinkLeft", 100.0, 0)
    assert vrm["firstPerson"]["lookAtTypeName"] == "BlendShape"


def test_an_avatar_without_morph_targets_has_no_expressions(tmp_path: Path) -> None:
    (tmp_path / "one.vrm").write_bytes(encode_vrm1(anny_glb(tmp_path), anny_body().joint_names, META))
    vrm = GlbFile(tmp_path / "one.vrm").gltf["extensions"]["VRMC_vrm"]
    assert vrm["expressions"]["preset"] == {}
    assert vrm["lookAt"]["type"] == "bone"


def test_an_avatar_with_morph_targets_of_its_shape_only_has_no_expressions(tmp_path: Path) -> None:
    """As the export with shape keys writes it where the face does not move."""
    files = vrm_files(list(SHAPE_KEYS), tmp_path)
    one, zero = files["1.0"].gltf["extensions"]["VRMC_vrm"], files["0.x"].gltf["extensions"]["VRM"]
    assert (one["expressions"]["preset"], one["lookAt"]["type"]) == ({}, "bone")
    assert (zero["blendShapeMaster"]["blendShapeGroups"], zero["firstPerson"]["lookAtTypeName"]) == ([], "Bone")
    for file in files.values():
        (mesh,) = file.gltf["meshes"]
        assert mesh["extras"]["targetNames"] == list(SHAPE_KEYS)
