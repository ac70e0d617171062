"""Weights of LPIPS are found where other programs leave them, and nowhere else."""

from pathlib import Path

import pytest
import torch

from pipeline.report.lpips_weights import ALEXNET_FILE, LPIPS_LAYERS_FILE, find_lpips_weights


@pytest.fixture
def weight_paths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """Where the two files would lie: torch's hub folder and a folder of packages."""
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    monkeypatch.syspath_prepend(tmp_path / "packages")
    for path in (tmp_path / "hub" / "checkpoints" / ALEXNET_FILE, tmp_path / "packages" / LPIPS_LAYERS_FILE):
        path.parent.mkdir(parents=True)
    return tmp_path / "hub" / "checkpoints" / ALEXNET_FILE, tmp_path / "packages" / LPIPS_LAYERS_FILE


def test_both_files_are_needed(weight_paths: tuple[Path, Path]):
    assert find_lpips_weights() is None
    torch.save({"features.0.weight": torch.ones(2)}, weight_paths[0])
    assert find_lpips_weights() is None
    torch.save({"lin0.model.1.weight": torch.zeros(3)}, weight_paths[1])
    found = find_lpips_weights()
    assert found is not None
    assert set(found) == {"features.0.weight", "lin0.model.1.weight"}
    weight_paths[0].unlink()
    assert find_lpips_weights() is None
