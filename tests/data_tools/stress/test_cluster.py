"""Batches of the toy pipeline on a real Slurm, where it is installed; what is missing is named where it is not."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from data_tools.stress import cluster, interruption, slurm
from data_tools.stress.cluster import cluster_scores, stage_times_ns
from data_tools.stress.row import CannotRunError
from data_tools.stress.slurm import NAMESPACE, SlurmCluster, daemon_commands, free_ports, slurm_config, write_private
from pipeline.core.manifest import MANIFEST_FILE
from pipeline.core.measure import REPOSITORY_DIR
from tests.core.toy_pipeline import Toy
from tests.test_resume import TOY_STAGES


def test_missing_programs_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None if name == "slurmd" else f"/bin/{name}")
    with pytest.raises(CannotRunError, match=r"without it slurmd: apt-get install slurmctld slurmd slurm-client munge"):
        slurm.require_slurm()


def test_another_user_than_root_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: f"/bin/{name}")
    monkeypatch.setattr(slurm, "CONFIG_DIR", tmp_path)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(CannotRunError, match="run it as root"):
        slurm.require_slurm()


def test_without_snakemake_the_command_that_installs_it_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    with pytest.raises(CannotRunError, match="make venv EXTRA=cluster"):
        cluster.require_snakemake()


def test_the_configuration_names_only_this_host(tmp_path: Path) -> None:
    lines = dict(line.split("=", 1) for line in slurm_config(tmp_path, "here", (1, 2, 3), 4).splitlines())
    assert lines["SlurmctldHost"] == "here(127.0.0.1)"
    assert lines["CommunicationParameters"] == "NoInAddrAny,NoCtldInAddrAny"
    assert lines["NodeName"] == "node2 NodeHostname=here NodeAddr=127.0.0.1 Port=3 CPUs=4 RealMemory=4500"
    paths = [word for line in lines.values() for word in line.split("socket=") if word.startswith("/")]
    assert len(paths) == 7
    assert all(path.startswith(str(tmp_path)) for path in paths)


def test_every_daemon_ends_with_the_trial(tmp_path: Path) -> None:
    commands = daemon_commands(tmp_path)
    assert list(commands) == ["munged", "slurmctld", "node1", "node2"]
    assert all(command[:3] == ["setpriv", "--pdeathsig", "KILL"] for command in commands.values())


def test_ports_are_free_and_distinct() -> None:
    assert len(set(free_ports(3))) == 3


def test_a_key_is_private_and_never_overwritten(tmp_path: Path) -> None:
    write_private(tmp_path / "key", b"1")
    assert (tmp_path / "key").stat().st_mode & 0o777 == 0o400
    with pytest.raises(FileExistsError):
        write_private(tmp_path / "key", b"2")


def test_a_stage_that_ran_again_has_another_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "STAGES", ("a", "b"))
    folder = tmp_path / cluster.GOOD[0] / "a"
    folder.mkdir(parents=True)
    before = stage_times_ns(tmp_path)
    assert list(before) == [str(folder)]
    assert cluster.count_left(tmp_path, cluster.GOOD) == len(cluster.GOOD)
    folder.rename(folder.with_name("a.part"))
    folder.with_name("a.part").rename(folder)
    assert stage_times_ns(tmp_path) != before
    for stage in ("a", "b"):
        (folder.with_name(stage)).mkdir(exist_ok=True)
        (folder.with_name(stage) / MANIFEST_FILE).touch()
    assert cluster.count_left(tmp_path, cluster.GOOD) == len(cluster.GOOD) - 1


@pytest.mark.slow
def test_a_lost_node_costs_no_video(toy: Toy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    try:
        slurm.require_slurm()
        cluster.require_snakemake()
    except CannotRunError as error:
        pytest.skip(str(error))

    def start(slurm_cluster: SlurmCluster, videos: Path, runs: Path) -> "subprocess.Popen[bytes]":
        folder = REPOSITORY_DIR / "configs" / "cluster"
        program = str(Path(sys.prefix) / "bin" / "snakemake")
        command = [*NAMESPACE, program, "--snakefile", str(folder / "Snakefile"), "--profile", str(folder / "slurm")]
        command += ["--slurm-init-seconds-before-status-checks", "2", "--set-threads", "avatar=1", "--config"]
        command += [f"videos={videos}", f"runs={runs}", "options=--preset quick"]
        command += [f"project={toy.folder}", f"python={sys.executable}"]
        variables = {"PYTHONPATH": str(REPOSITORY_DIR), "TOY_SLEEP_S": "8"}
        with runs.with_name("runs.log").open("ab") as log:
            environment = slurm_cluster.environment | variables
            return subprocess.Popen(command, cwd=toy.folder, env=environment, stdout=log, stderr=log)

    capture = tmp_path / "capture"
    (capture / "video").mkdir(parents=True)
    (capture / "video" / "video.mp4").write_text("1 2 3")
    monkeypatch.setattr(cluster, "make_capture", lambda *_: capture)
    monkeypatch.setattr(cluster, "start_batch", start)
    monkeypatch.setattr(cluster, "broken_video", lambda _: b"1 two")
    monkeypatch.setattr(cluster, "GOOD", ("person1", "person2", "person3"))
    monkeypatch.setattr(cluster, "KILLED_STAGE", "learn")
    monkeypatch.setattr(cluster, "DONE_BEFORE", 0)
    for module in (cluster, interruption):
        monkeypatch.setattr(module, "STAGES", TOY_STAGES)
    monkeypatch.setattr(interruption, "TIMELESS", TOY_STAGES)
    scores = cluster_scores(tmp_path / "captures", tmp_path / "trial", lost="node")
    log = (tmp_path / "trial" / "runs.log").read_text()
    assert set(scores.values()) == {0.0}, f"{scores}\n{log}"
    assert log.count("Error in rule avatar") >= 1
