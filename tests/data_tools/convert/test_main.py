"""The convert command: formats are detected, sources are unchanged, targets are atomic."""

import numpy as np
import pytest

from data_tools.command import run_command
from data_tools.convert.__main__ import main
from pipeline.capture.capture import load_capture
from pipeline.core.errors import UserError
from pipeline.io.npz import save_npz
from stages import frames
from tests.data_tools.convert import sample_data

MAKERS = {
    "peoplesnapshot": sample_data.people_snapshot,
    "instantavatar": sample_data.instant_avatar,
    "images": lambda folder: sample_data.write_image_folder(folder, "mask"),
}


def state(folder):
    return {path.relative_to(folder): path.stat().st_mtime_ns for path in folder.rglob("*")}


@pytest.mark.parametrize("name", sorted(MAKERS))
def test_format_is_detected_and_the_source_is_unchanged(tmp_path, capsys, name):
    MAKERS[name](tmp_path / "in")
    before = state(tmp_path / "in")
    main([str(tmp_path / "in"), str(tmp_path / "out")])
    assert f"out ({name}): 6 frames, masks" in capsys.readouterr().out
    assert state(tmp_path / "in") == before
    main([name, str(tmp_path / "in"), str(tmp_path / "named")])
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        path.name for path in (tmp_path / "named").iterdir()
    }


def test_user_errors(tmp_path, capsys):
    sample_data.write_image_folder(tmp_path / "in", "other")
    source, target = str(tmp_path / "in"), str(tmp_path / "out")
    for arguments, message in (
        ([source, target], "none of the formats peoplesnapshot, instantavatar, neuman, images"),
        (["nerf", source, target], "unknown format nerf; choose one of peoplesnapshot"),
        ([f"{source}/none", target], "is not a folder"),
        ([source, f"{source}/out"], "which is read only"),
        ([source, source], "already exists"),
    ):
        assert run_command(main, arguments) == 2
        assert message in capsys.readouterr().err


def test_failed_conversion_leaves_no_target(tmp_path):
    sample_data.write_image_folder(tmp_path / "in", "masks")
    broken = tmp_path / "in" / "masks" / "00003.png"
    whole = broken.read_bytes()
    broken.write_bytes(b"rubbish")
    with pytest.raises(UserError, match=r"00003\.png cannot be read"):
        main([str(tmp_path / "in"), str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()
    broken.write_bytes(whole)
    main([str(tmp_path / "in"), str(tmp_path / "out")])
    assert not (tmp_path / "out.part").exists()


def test_frames_stage_reads_the_target(tmp_path):
    """Landmarks are supplied, so no detector is needed: split, masks and camera of the source are used."""
    sample_data.instant_avatar(tmp_path / "in", 20)
    main([str(tmp_path / "in"), str(tmp_path / "out")])
    landmarks = {"landmarks_px": np.full((20, 33, 2), 5.0), "landmarks_world_m": np.zeros((20, 33, 3))}
    save_npz(tmp_path / "out" / "landmarks.npz", landmarks)
    (tmp_path / "out" / "split.json").write_text('{"train": [0, 1, 2, 3, 5, 9, 11, 12, 13, 14], "heldout": [4, 17]}')
    (tmp_path / "run").mkdir()
    frames.run({"video": tmp_path / "out"}, tmp_path / "run", frames.Config(workers=1, min_frames=5))
    capture = load_capture(tmp_path / "run")
    np.testing.assert_array_equal(capture.frame_index[capture.positions(2)], [4, 17])
    assert (capture.camera.fx, capture.mask_source) == (30, "masks/")
    np.testing.assert_array_equal(capture.mask(2), sample_data.masks(20)[2])
