"""The command pose on a run with known mesh and motion."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from data_tools import pose
from data_tools.film import film_motion
from data_tools.pose import export_config, main, planted_motion, read_pose
from pipeline.avatar.motion.feet import joint_positions_m, lowest_foot_offset_m
from pipeline.avatar.skinned_avatar import lowest_vertex_y_m
from pipeline.body.body import canonical_to_world
from pipeline.core.errors import UserError
from pipeline.core.manifest import MANIFEST_FILE, Manifest, digest_files, write_manifest
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import linear_blend_skinning
from pipeline.io.bvh import read_bvh
from pipeline.io.glb import GlbFile
from pipeline.mesh.files import load_mesh, save_mesh
from stages.export import STAGE, Config, load_scene
from tests.field.scene import PaintedScene
from tests.tools.khronos import validator_issues


def load(run: Path, **options: str):
    return load_scene({name: run / name for name in STAGE.needs}, Config(**options))


def test_a_run_with_formats_of_a_missing_package_is_read(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    manifest = json.loads((run / "export" / "manifest.json").read_text())
    manifest["config"]["formats"] = ["usdz"]
    (run / "export" / "manifest.json").write_text(json.dumps(manifest))
    monkeypatch.setattr("stages.export.missing_package", lambda formats: "without usdz" if formats else None)
    config = export_config(run)
    assert config.formats == ()
    assert config.rig == "mixamo"


def test_a_run_whose_stages_do_not_belong_together_is_refused(run: Path) -> None:
    """As after a mesh stage alone, or a command stopped after it: the texture has the faces of the old mesh."""
    stages = {name: Manifest(name, 1, "", {}, {}, {"result": "0a"}, {}, 0.0, 0.0) for name in ("mesh", "texture")}
    made_from = {"mesh": stages["mesh"].outputs_digest}
    stages["texture"] = replace(stages["texture"], inputs=made_from)
    for name, manifest in stages.items():
        write_manifest(manifest, run / name / MANIFEST_FILE)
    assert export_config(run).rig == "mixamo"
    write_manifest(replace(stages["mesh"], outputs={"result": "0b"}), run / "mesh" / MANIFEST_FILE)
    with pytest.raises(UserError, match="texture was made from another result of mesh than .* --run "):
        export_config(run)


@pytest.fixture
def clip(run: Path, tmp_path: Path) -> Path:
    """The motion of the video as a clip."""
    main([str(run)])
    return (run / "pose" / "capture" / "capture.bvh").rename(tmp_path / "wave.bvh")


def test_the_motion_of_the_video_as_bvh_is_that_of_the_avatar(run: Path) -> None:
    main([str(run)])
    scene = load(run, rig="mixamo")
    bvh = read_bvh(run / "pose" / "capture" / "capture.bvh")
    _, positions = bvh.forward_kinematics(bvh.rotations)
    names = [bvh.joint_names.index(name) for name in scene.rig.joint_names]
    joints_m = 0.01 * (positions + bvh.root_positions[:, None])[:, names]
    np.testing.assert_allclose(joints_m, joint_positions_m(scene.body, planted_motion(scene)), atol=2e-5)
    assert bvh.fps == pytest.approx(scene.fps, rel=1e-5)


def test_clips_become_animations_and_the_export_keeps_its_bytes(run: Path, clip: Path, tmp_path: Path) -> None:
    before = digest_files(run / "export")
    other = tmp_path / "again.bvh"
    other.write_bytes(clip.read_bytes())
    main([str(run), "--bvh", str(clip), "--bvh", str(other)])
    glb = GlbFile(run / "pose" / "wave" / "avatar.glb")
    assert [animation["name"] for animation in glb.gltf["animations"]] == ["capture", "idle", "wave", "again"]
    assert glb.gltf["nodes"][1]["name"] == "mixamorig:Hips"
    assert validator_issues(run / "pose" / "wave" / "avatar.glb") == []
    assert digest_files(run / "export") == before


def test_a_frame_is_the_posed_mesh_of_that_frame(run: Path, scene: PaintedScene) -> None:
    main([str(run), "--frame", "3"])
    loaded = load(run)
    motion = loaded.motion.select(loaded.motion.frame_index == 3)
    weights = loaded.skinned.dense_skin_weights(len(scene.body.joint_names))
    vertices = torch.from_numpy(loaded.skinned.mesh.vertices)
    expected = linear_blend_skinning(vertices, weights, canonical_to_world(scene.body, motion))[0].numpy()
    written = trimesh.load(run / "pose" / "frame-3" / "avatar.obj", process=False, maintain_order=True)
    np.testing.assert_allclose(np.sort(written.vertices, axis=0), np.sort(expected, axis=0), atol=2e-6)
    assert (run / "pose" / "frame-3" / "avatar.mtl").is_file()


def test_poses_by_name_and_by_file(run: Path, tmp_path: Path) -> None:
    (tmp_path / "bow.json").write_text(json.dumps({"Spine": [0.9, 0.4358899, 0, 0]}))
    for chosen in ("a", "t", str(tmp_path / "bow.json")):
        main([str(run), "--pose", chosen])
    heights, widths = {}, {}
    for name in ("a", "t", "bow"):
        size = np.ptp(trimesh.load(run / "pose" / name / "avatar.obj").vertices, axis=0)
        widths[name], heights[name] = size[0], size[1]
    assert widths["t"] > widths["a"] + 0.2
    assert heights["bow"] < heights["a"] - 0.05


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--bvh", "none.bvh"], "none.bvh does not exist"),
        (["--bvh", "/"], "motion / is a folder; choose a .bvh file in it"),
        (["--pose", "/"], "pose / is a folder; choose a, t or a .json file"),
        (["--frame", "99"], "frame 99 has no pose; choose one of 0 to"),
        (["--pose", "none.json"], "there is no pose none.json; choose a, t or a .json file"),
        (["--name", "../export"], "is not the name of a folder"),
    ],
)
def test_bad_input_is_one_sentence_and_writes_nothing(
    arguments: list[str], words: str, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The scene, which takes seconds, is not loaded for it."""
    monkeypatch.setattr(pose, "load_scene", lambda inputs, config: pytest.fail("the scene was loaded"))
    before = sorted(path.name for path in run.rglob("*"))
    with pytest.raises(UserError, match=words):
        main([str(run), *arguments])
    assert sorted(path.name for path in run.rglob("*")) == before


def test_a_clip_without_hips_or_of_one_frame_is_named(run: Path, clip: Path, tmp_path: Path) -> None:
    text = clip.read_text()
    lines = text.splitlines()
    start = next(row for row, line in enumerate(lines) if line.startswith("Frames:"))
    (tmp_path / "legs.bvh").write_text(text.replace("mixamorig:Hips", "Tail"))
    (tmp_path / "one.bvh").write_text("\n".join([*lines[:start], "Frames: 1", lines[start + 1], lines[start + 2]]))
    for name, words in (("legs", "no joint for Hips"), ("one", "one frame")):
        with pytest.raises(UserError, match=rf"{name}\.bvh.*{words}"):
            main([str(run), "--bvh", str(tmp_path / f"{name}.bvh")])
    with pytest.raises(UserError, match="several clips with the name wave"):
        main([str(run), "--bvh", str(clip), "--bvh", str(clip)])
    assert not (run / "pose" / "legs").exists()


def test_clips_and_poses_stand_on_the_soles_of_the_shoes(run: Path, clip: Path) -> None:
    """They are 2 cm below the feet of the body model, by whose joints these motions are placed."""
    whole = load_mesh(run / "mesh")
    vertices = whole.mesh.vertices.copy()
    vertices[:, 1] -= 0.02 * (vertices[:, 1] < vertices[:, 1].min() + 0.05)
    save_mesh(run / "mesh", replace(whole, mesh=Mesh(vertices, whole.mesh.faces)))
    scene = load_scene({name: run / name for name in STAGE.needs}, Config(face=False))
    assert scene.floor_y_m == pytest.approx(0.02 - whole.mesh.vertices[:, 1].min(), abs=1e-6)
    for motion in (scene.clips()["idle"], film_motion("idle", scene), film_motion(None, scene)):
        np.testing.assert_allclose(lowest_vertex_y_m(scene.skinned, scene.body, motion), 0.0, atol=1e-4)
    for motion in (film_motion(str(clip), scene), planted_motion(scene)):
        assert lowest_foot_offset_m(scene.body, motion).min() == pytest.approx(scene.floor_y_m, abs=2e-3)
    main([str(run), "--pose", "t"])
    lowest_m = trimesh.load(run / "pose" / "t" / "avatar.obj").vertices[:, 1].min()
    assert lowest_m == pytest.approx(0.0, abs=1e-4)


def test_poses_of_unknown_joints_or_without_four_numbers_are_errors(scene: PaintedScene, tmp_path: Path) -> None:
    wrong = (({"Tail": [1, 0, 0, 0]}, "no joint Tail"), ({"Spine": [0, 0, 0, 0]}, "not all 0"), ([], "pose.json"))
    for content, words in wrong:
        (tmp_path / "pose.json").write_text(json.dumps(content))
        with pytest.raises(UserError, match=words):
            read_pose(tmp_path / "pose.json", scene.body)


def test_a_run_that_does_not_exist_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="none is not a folder; name the folder of a finished run"):
        main([str(tmp_path / "none")])


def test_without_an_export_the_next_command_is_named(run: Path) -> None:
    (run / "export" / "manifest.json").unlink()
    with pytest.raises(UserError, match=r"no finished export; run .*python -m stages --run"):
        main([str(run)])


def test_an_uneven_motion_is_sampled_evenly(run: Path) -> None:
    loaded = load(run)
    uneven = loaded.motion.select(np.array([0, 1, 4, 5]))
    motion = planted_motion(replace(loaded, motion=uneven))
    np.testing.assert_allclose(np.diff(motion.time_s), 1.0 / loaded.fps, rtol=1e-9)
    assert motion.time_s[-1] == pytest.approx(uneven.time_s[-1], abs=0.5 / loaded.fps)
