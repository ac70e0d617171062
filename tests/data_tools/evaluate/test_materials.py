"""The comparison of materials on a small capture: its run is the true person, and its figures are consistent."""

from pathlib import Path

import numpy as np
import pytest

from data_tools.evaluate.materials import main, reduced_mesh, write_true_run
from data_tools.evaluate.truth import load_ground_truth
from pipeline.body.files import load_motion
from pipeline.capture.capture import load_capture
from pipeline.metrics.surfaces import chamfer_distance_mm


@pytest.mark.slow
def test_the_run_is_the_true_person(sample: Path, tmp_path: Path) -> None:
    truth = load_ground_truth(sample)
    gains = write_true_run(truth, tmp_path, 3, flicker=0.2)
    capture, motion = load_capture(tmp_path / "frames"), load_motion(tmp_path / "mesh" / "motion.npz")
    assert np.all(np.abs(gains - 1.0) <= 0.2)
    assert len(capture) == len(motion.time_s) == 3
    bright = [capture.image(position)[capture.mask(position) > 0.5].mean() for position in range(3)]
    assert np.argmax(bright) == np.argmax(gains)


@pytest.mark.slow
def test_the_reduced_mesh_is_the_true_surface(sample: Path) -> None:
    body = load_ground_truth(sample).subject.body
    reduced = reduced_mesh(body)
    assert len(reduced.mesh.faces) <= 22_000
    assert chamfer_distance_mm(reduced.mesh, body.mesh(), 5_000) < 2.0


@pytest.mark.slow
def test_the_table_has_all_rows(sample: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main([str(sample), "--frames", "6"])
    rows = capsys.readouterr().out
    for mode in ("kept", "auto", "removed"):
        for name in ("albedo_error", "relit_left_db", "heldout_psnr_body_db", "gain_error_largest"):
            assert f"{mode:8} {name} " in rows
