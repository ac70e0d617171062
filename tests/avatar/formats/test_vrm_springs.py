"""Spring bones of VRM on a generated person with a skirt: joints, weights, settings and colliders."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.avatar.formats.vrm import VrmMeta, encode_vrm0, encode_vrm1
from pipeline.avatar.formats.vrm_springs import FRAME_S
from pipeline.io.glb import GlbFile
from tests.avatar.formats.anny_avatar import anny_body, anny_glb
from tests.avatar.formats.skirt_avatar import SKIRT_VERTICES, clothed, skirt_glb
from tests.avatar.formats.test_vrm import RestPlayer
from tests.tools.khronos import validator_issues

pytestmark = pytest.mark.slow
META = VrmMeta("avatar", "A. Person", "")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """VRM files of the person with the skirt, with its loose parts and without."""
    folder = tmp_path_factory.mktemp("skirt")
    glb, body, loose = skirt_glb(folder)
    for version, encode in (("1.0", encode_vrm1), ("0.x", encode_vrm0)):
        (folder / f"{version}.vrm").write_bytes(encode(glb, body.joint_names, META, loose))
        (folder / f"{version}-stiff.vrm").write_bytes(encode(glb, body.joint_names, META))
    names = ("1.0", "0.x", "1.0-stiff", "0.x-stiff")
    return {name: folder / f"{name}.vrm" for name in names}


def chain_nodes(file: GlbFile) -> list[list[int]]:
    """The nodes of each chain, by the file's names."""
    names = {node["name"]: index for index, node in enumerate(file.gltf["nodes"])}
    return [[names[f"skirt_{chain}_{level}"] for level in range(3)] for chain in range(8)]


def test_the_chains_of_vrm_1_hang_from_the_hips(files: dict[str, Path]) -> None:
    file = GlbFile(files["1.0"])
    springs = file.gltf["extensions"]["VRMC_springBone"]
    assert "VRMC_springBone" in file.gltf["extensionsUsed"]
    assert [[joint["node"] for joint in spring["joints"]] for spring in springs["springs"]] == chain_nodes(file)
    hips = next(node for node in file.gltf["nodes"] if node["name"] == "Hips")
    for top, middle, tip in chain_nodes(file):
        assert top in hips["children"]
        assert file.gltf["nodes"][top]["children"] == [middle]
        assert file.gltf["nodes"][middle]["children"] == [tip]
        assert {top, middle, tip} <= set(file.gltf["skins"][0]["joints"])


def test_a_chain_swings_like_a_pendulum_of_four_times_gravity_half_critically_damped(files: dict[str, Path]) -> None:
    """A small swing by VRM's rule, one step after the other: its period, and how much is left after it."""
    file = GlbFile(files["1.0"])
    joint = file.gltf["extensions"]["VRMC_springBone"]["springs"][0]["joints"][0]
    player = RestPlayer(file.path)
    ends_m = [player.global_matrix(node, 0.0)[:3, 3] for node in chain_nodes(file)[0]]
    length_m = np.linalg.norm(np.diff(ends_m, axis=0), axis=1).sum()
    angle, previous, swing = 0.1, 0.1, []
    for _ in range(240):
        tail = np.array([np.sin(angle), -np.cos(angle)]) * length_m
        before = np.array([np.sin(previous), -np.cos(previous)]) * length_m
        moved = (
            tail + (1.0 - joint["dragForce"]) * (tail - before) + joint["stiffness"] * FRAME_S * np.array([0.0, -1.0])
        )
        previous, angle = angle, float(np.arctan2(moved[0], -moved[1]))
        swing.append(angle)
    crossings = np.flatnonzero(np.diff(np.sign(swing)))
    natural = np.sqrt(4.0 * 9.81 / length_m)
    half_period_s = np.pi / (natural * np.sqrt(1.0 - 0.5**2))
    assert (crossings[1] - crossings[0]) * FRAME_S == pytest.approx(half_period_s, rel=0.15)
    assert max(swing[crossings[1] :]) < 0.1 * np.exp(-0.5 * natural * half_period_s) * 1.2


@pytest.mark.parametrize("version", ["1.0", "0.x"])
def test_colliders_do_not_touch_a_chain_at_rest(files: dict[str, Path], version: str) -> None:
    file, player = GlbFile(files[version]), RestPlayer(files[version])
    tails_m = np.array([player.global_matrix(node, 0.0)[:3, 3] for chain in chain_nodes(file) for node in chain[1:]])
    spheres = []
    if version == "1.0":
        springs = file.gltf["extensions"]["VRMC_springBone"]
        hit_m = [joint["hitRadius"] for spring in springs["springs"] for joint in spring["joints"][:2]]
        for collider in springs["colliders"]:
            (shape,) = collider["shape"].values()
            start_m, end_m = np.array(shape["offset"]), np.array(shape.get("tail", shape["offset"]))
            at = player.global_matrix(collider["node"], 0.0)[:3, 3]
            spheres += [(at + start_m + t * (end_m - start_m), shape["radius"]) for t in np.linspace(0, 1, 101)]
    else:
        animation = file.gltf["extensions"]["VRM"]["secondaryAnimation"]
        hit_m = np.repeat([group["hitRadius"] for group in animation["boneGroups"]], 2)
        for group in animation["colliderGroups"]:
            at = player.global_matrix(group["node"], 0.0)[:3, 3]
            for ball in group["colliders"]:
                offset = np.array([ball["offset"]["x"], ball["offset"]["y"], -ball["offset"]["z"]])  # Unity's z
                spheres.append((at + offset, ball["radius"]))
    clearance = [np.linalg.norm(tails_m - at, axis=1) - radius - hit_m for at, radius in spheres]
    assert len(spheres) > 20
    assert np.min(clearance) > 0.0
    legs = [at for at, radius in spheres if abs(at[0]) > 0.05]
    assert min(np.abs(at[1] - 0.5) for at in legs) < 0.1  # along the legs, not only at joints


@pytest.mark.parametrize("version", ["1.0", "0.x"])
def test_at_rest_the_avatar_is_that_without_springs(files: dict[str, Path], version: str) -> None:
    """Cloth above the hem moves by the hips instead of the thighs, which the T-pose turns by some degrees."""
    swinging, stiff = RestPlayer(files[version]), RestPlayer(files[f"{version}-stiff"])
    moved_m = np.linalg.norm(swinging.posed_vertices(0.0) - stiff.posed_vertices(0.0), axis=1)
    assert np.median(moved_m) < 1e-6
    assert moved_m.max() < 0.06


def test_a_turned_chain_moves_the_cloth_below_it_and_nothing_else(files: dict[str, Path]) -> None:
    file = GlbFile(files["1.0"])
    lifted = Rotation.from_euler("x", -0.5).as_matrix()
    still, turned = RestPlayer(file.path), RestPlayer(file.path, {"skirt_0_0": lifted})
    before_m = still.posed_vertices(0.0)
    moved_m = np.linalg.norm(turned.posed_vertices(0.0) - before_m, axis=1)
    _, body = clothed(0, "skirt", 0.07)
    hem_m = GlbFile(file.path).accessor(file.gltf["meshes"][0]["primitives"][0]["attributes"]["POSITION"])
    at_front = (np.abs(before_m[:, 0]) < 0.02) & (before_m[:, 2] > 0.12) & (np.abs(before_m[:, 1] - 0.6) < 0.04)
    assert at_front.sum() > 10
    assert moved_m[at_front].min() > 0.08
    assert len(hem_m) > SKIRT_VERTICES
    assert not moved_m[before_m[:, 2] < 0.0].any()
    assert not moved_m[before_m[:, 1] > body.joints_m[body.joint("Spine"), 1] + 0.05].any()


def test_people_without_loose_parts_have_no_springs(tmp_path: Path) -> None:
    glb = anny_glb(tmp_path)
    (tmp_path / "one.vrm").write_bytes(encode_vrm1(glb, anny_body().joint_names, META))
    assert set(GlbFile(tmp_path / "one.vrm").gltf["extensions"]) == {"VRMC_vrm"}
    (tmp_path / "zero.vrm").write_bytes(encode_vrm0(glb, anny_body().joint_names, META))
    animation = GlbFile(tmp_path / "zero.vrm").gltf["extensions"]["VRM"]["secondaryAnimation"]
    assert animation == {"boneGroups": [], "colliderGroups": []}


def test_the_khronos_validator_finds_no_issue(files: dict[str, Path]) -> None:
    assert validator_issues(files["1.0"]) == []
    assert [issue["code"] for issue in validator_issues(files["0.x"])] == ["INVALID_EXTENSION_NAME_FORMAT"]
