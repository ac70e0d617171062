"""A fit that was interrupted continues from its checkpoint with the same result."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.body.body import load_anny
from pipeline.body.fit import fit as fit_module
from pipeline.body.fit.checkpoint import FitProgress, load_progress, save_progress
from pipeline.body.fit.fit import fit_body
from pipeline.body.fit.options import FitOptions
from pipeline.body.fit.prior.posture import Posture
from pipeline.body.fit.result import FitResult
from pipeline.body.fit.state import FitState
from tests.body.acting import SyntheticRecording, synthetic_recording

FRAMES = 8


class Killed(BaseException):
    """Ends a fit like a signal: no code of it handles it."""


@pytest.fixture(scope="module")
def scene() -> SyntheticRecording:
    return synthetic_recording(load_anny(), FRAMES, noise_m=0.008)


def fit(scene: SyntheticRecording, checkpoint: Path | None = None) -> FitResult:
    options = FitOptions(focal_relative_std=0.2, shared_frames=6, rounds=3, vertical_is_known=False)
    return fit_body(load_anny(), scene.observations(scene.camera), scene.windows(), options, checkpoint=checkpoint)


def assert_equal(found: FitResult, expected: FitResult) -> None:
    """Every number has the same bits."""
    for field in fields(FitResult):
        value, wanted = getattr(found, field.name), getattr(expected, field.name)
        if isinstance(wanted, np.ndarray | torch.Tensor | float):
            assert np.array_equal(np.asarray(value), np.asarray(wanted), equal_nan=True), field.name
    for name, wanted in vars(expected.camera).items():
        assert np.array_equal(getattr(found.camera, name), wanted), name
    assert np.array_equal(found.body.vertices, expected.body.vertices)


def test_an_interrupted_fit_continues_with_the_same_result(
    scene: SyntheticRecording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed after the shared parameters, again after the first round of the poses; neither is computed again."""
    expected, path = fit(scene), tmp_path / "checkpoint.safetensors"
    rounds_left: list[int] = []

    def save_and_die(path: Path, progress: FitProgress) -> None:
        save_progress(path, progress)
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(fit_module, "save_progress", save_and_die)
        for rounds_done in (0, 1):
            with pytest.raises(Killed):
                fit(scene, path)
            progress = load_progress(path)
            assert progress is not None
            assert progress.rounds_done == rounds_done
            patch.setattr(fit_module, "_fit_shared", None)
    with monkeypatch.context() as patch:
        patch.setattr(fit_module, "_fit_shared", None)
        patch.setattr(fit_module, "_fit_landmarks", None)
        patch.setattr(fit_module, "save_progress", lambda _, progress: rounds_left.append(progress.rounds_done))
        assert_equal(fit(scene, path), expected)
    assert rounds_left == [2, 3]


def test_a_checkpoint_returns_what_was_saved(tmp_path: Path) -> None:
    state = FitState(*(torch.rand(shape, dtype=torch.float64) for shape in ((2, 3, 3, 3), (2, 3), (4,), (5,), (3,))))
    posture, path = Posture(torch.rand(7), torch.rand(7)), tmp_path / "checkpoint.safetensors"
    for progress in (FitProgress(state), FitProgress(state, posture, 0.1, 1 / 3, 2, torch.rand(9))):
        save_progress(path, progress)
        found = load_progress(path)
        assert found is not None
        assert (found.posture is None, found.motion_std is None) == (
            progress.posture is None,
            progress.motion_std is None,
        )
        assert (found.focal_relative_std, found.height_std_m) == (progress.focal_relative_std, progress.height_std_m)
        assert all(torch.equal(value, vars(state)[name]) for name, value in vars(found.state).items())
    assert load_progress(None) is None
    assert load_progress(tmp_path / "none") is None
