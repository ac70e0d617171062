"""Choice of the torch build: the CPU build wherever it is available, the CUDA build on request."""

from pathlib import Path

import pytest

from scripts import install

LOCK = "# comment\nnumpy==1.26.4\ntorch==2.13.0\ntorchvision==0.1\n"


@pytest.fixture
def lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv("TORCH_INDEX", raising=False)
    (tmp_path / "requirements.lock").write_text(LOCK)
    return tmp_path / "requirements.lock"


def test_the_pin_is_read_from_the_lock() -> None:
    assert install.torch_pin(LOCK) == "torch==2.13.0"
    with pytest.raises(SystemExit, match="make lock"):
        install.torch_pin("numpy==1.26.4\n")


def test_a_local_cpu_build_needs_no_index(lock: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(install, "resolves_to_cpu_build", lambda pin: True)
    monkeypatch.setattr(install, "is_index_reachable", lambda index: pytest.fail("no network is needed"))
    assert install.torch_pip_arguments("torch==2", lock, use_cuda=False) == ["torch==2", "--no-deps"]


def test_else_the_cpu_index_is_added(lock: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(install, "resolves_to_cpu_build", lambda pin: False)
    monkeypatch.setattr(install, "is_index_reachable", lambda index: True)
    arguments = install.torch_pip_arguments("torch==2", lock, use_cuda=False)
    assert arguments[-2:] == ["--extra-index-url", install.TORCH_CPU_INDEX]


def test_without_the_index_pip_is_left_alone(
    lock: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(install, "resolves_to_cpu_build", lambda pin: False)
    monkeypatch.setattr(install, "is_index_reachable", lambda index: False)
    assert "--extra-index-url" not in install.torch_pip_arguments("torch==2", lock, use_cuda=False)
    assert "is not reachable" in capsys.readouterr().out


@pytest.mark.parametrize("use_cuda", [True, False])
def test_index_from_environment_is_used(lock: Path, monkeypatch: pytest.MonkeyPatch, use_cuda: bool) -> None:
    monkeypatch.setenv("TORCH_INDEX", "https://mirror.example/whl")
    arguments = install.torch_pip_arguments("torch==2", lock, use_cuda)
    assert arguments[-2:] == ["--extra-index-url", "https://mirror.example/whl"]


def test_cuda_never_uses_the_cpu_index(lock: Path) -> None:
    assert install.torch_pip_arguments("torch==2", lock, use_cuda=True) == ["torch==2", "--constraint", str(lock)]


def test_an_unreachable_index_is_noticed() -> None:
    assert not install.is_index_reachable("http://127.0.0.1:9")


def test_extras_come_from_the_project_file() -> None:
    assert install.extra_packages("cluster") == [
        "snakemake>=8",
        "snakemake-executor-plugin-kubernetes",
        "snakemake-executor-plugin-slurm>=2",
        "snakemake-storage-plugin-fs",
    ]
    with pytest.raises(SystemExit, match="cuda, cluster, usdz, web, dev"):
        install.extra_packages("gpu")
