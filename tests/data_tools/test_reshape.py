"""The command reshape on a run with known mesh, motion and texture."""

import json
from pathlib import Path

import numpy as np
import pytest

from data_tools.edited_avatar import load_editable_avatar
from data_tools.reshape import main, reshape_scene
from pipeline.avatar.placement import FLOOR_PERCENTILE
from pipeline.avatar.skinned_avatar import lowest_vertex_y_m
from pipeline.core.errors import UserError
from pipeline.core.manifest import digest_files
from pipeline.core.progress import take_warnings
from pipeline.io.glb import GlbFile
from pipeline.template.files import save_template
from pipeline.template.reshape import SHAPE_KEYS
from stages.export import STAGE, encode_scene


def test_the_avatar_is_written_in_its_new_shape_and_stands_on_the_floor(run: Path) -> None:
    before = {stage: digest_files(run / stage) for stage in STAGE.needs[1:]}
    main([str(run), "--shape", "height=+0.3 weight=-0.2"])
    out = run / "reshape" / "height+0.3_weight-0.2"
    glb = GlbFile(out / "avatar.glb")
    assert [animation["name"] for animation in glb.gltf["animations"]] == ["capture", "idle"]
    heights = [
        float(line.split()[2]) for line in (out / "avatar.obj").read_text().splitlines() if line.startswith("v ")
    ]
    avatar = load_editable_avatar(run)
    assert np.ptp(heights) > np.ptp(avatar.scene.skinned.mesh.vertices[:, 1]) + 0.05
    taller = reshape_scene(avatar, {"height": 0.3}, run)
    assert taller.body.joints_m[taller.body.joint("Head"), 1] > avatar.scene.body.joints_m[taller.body.joint("Head"), 1]
    lowest_m = lowest_vertex_y_m(taller.skinned, taller.body, taller.motion)
    assert np.percentile(lowest_m, FLOOR_PERCENTILE) == pytest.approx(0.0, abs=1e-4)
    assert taller.motion.root_translation_m[:, 1].mean() > avatar.scene.motion.root_translation_m[:, 1].mean()
    assert {stage: digest_files(run / stage) for stage in before} == before


@pytest.mark.parametrize(("exported_targets", "is_warned"), [(67.0, True), (0.0, False)])
def test_a_face_that_is_lost_with_the_new_shape_is_a_warning(
    run: Path, exported_targets: float, is_warned: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("data_tools.reshape.make_face", lambda body, template, skinned, texture: None)
    path = run / "export" / "manifest.json"
    manifest = json.loads(path.read_text())
    path.write_text(json.dumps(manifest | {"metrics": {"morph_targets": exported_targets}}))
    main([str(run), "--shape", "age=-0.5"])
    assert any("a smaller change keeps the face" in text for text in take_warnings()) == is_warned
    assert (run / "reshape" / "age-0.5" / "avatar.glb").is_file()


def test_shape_keys_are_morph_targets(run: Path) -> None:
    avatar = load_editable_avatar(run)
    config = avatar.config.model_copy(update={"shape_keys": True})
    path = run / "keys.glb"
    path.write_bytes(encode_scene(avatar.scene, config, {}))
    mesh = GlbFile(path).gltf["meshes"][0]
    assert mesh["extras"]["targetNames"] == list(SHAPE_KEYS)
    assert len(mesh["primitives"][0]["targets"]) == len(SHAPE_KEYS)


def test_bad_changes_and_bodies_are_one_sentence_and_write_nothing(run: Path) -> None:
    with pytest.raises(UserError, match="use height, weight, muscle, age"):
        main([str(run), "--shape", "size=2"])
    with pytest.raises(UserError, match="empty"):
        main([str(run), "--shape", ""])
    save_template(run / "texture", None)
    with pytest.raises(UserError, match="only the built-in body"):
        main([str(run), "--shape", "weight=0.1"])
    avatar = load_editable_avatar(run)
    with pytest.raises(UserError, match="shape_keys=true needs the built-in body"):
        encode_scene(avatar.scene, avatar.config.model_copy(update={"shape_keys": True}), {})
    assert not (run / "reshape").exists()
