"""A Slurm cluster of two nodes on this host, for tests.

munged, slurmctld and two slurmd run with files in a temporary folder and listen on 127.0.0.1 only. Each
node is a process namespace of its own, so that a node with all its jobs can be stopped at once, and in which the folder
of the configuration stands at the place of Slurm: what Snakemake starts in a job does not inherit `SLURM_CONF`. All
processes end with this one.
"""

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from data_tools.stress.row import CannotRunError

NODES = ("node1", "node2")
PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "srun", "unshare", "setpriv", "mount")
INSTALL = "apt-get install slurmctld slurmd slurm-client munge"
CONFIG_DIR = Path("/etc/slurm")

NODE_MEMORY_MB = 4500
"""What Slurm believes that a node has; the jobs of `configs/cluster/Snakefile` ask for 4000."""

SLURMD_TIMEOUT_S = 15
"""Slurm takes a node for lost after this time without an answer; its default is 300 s."""

START_TIMEOUT_S = 60.0
MUNGE_KEY_BYTES = 128

ENDS_WITH_PARENT = ("setpriv", "--pdeathsig", "KILL")
NAMESPACE = (*ENDS_WITH_PARENT, "unshare", "--pid", "--fork", "--kill-child", "--mount-proc")
"""Runs a command with all that it starts in a process namespace that ends with this process."""


@dataclass
class SlurmCluster:
    """A running cluster.

    folder: configuration, state and logs. daemons: by name; of a node, the outer process of its namespace.
    """

    folder: Path
    daemons: dict[str, "subprocess.Popen[bytes]"]

    @property
    def environment(self) -> dict[str, str]:
        """Environment for Slurm's commands."""
        return {**os.environ, "SLURM_CONF": str(self.folder / "slurm.conf")}

    def call(self, *command: str) -> str:
        """Run a command of Slurm and return what it prints; CalledProcessError if it fails."""
        return subprocess.run(command, env=self.environment, check=True, capture_output=True, text=True).stdout

    def version(self) -> str:
        """Return the version, such as slurm-wlm 22.05.8."""
        return self.call("sinfo", "--version").strip()

    def running(self) -> dict[str, str]:
        """Return the comment of the running job of each node that has one."""
        lines = self.call("squeue", "--noheader", "--states=RUNNING", "--format=%N|%k").splitlines()
        return dict(line.strip().split("|", 1) for line in lines)

    def stop_node(self, name: str) -> None:
        """Kill a node with its slurmd and all its jobs, as when a machine loses power."""
        self.daemons[name].kill()
        self.daemons[name].wait()

    def kill_slurmd(self, name: str) -> None:
        """Kill only the slurmd of a node; its jobs go on."""
        (shell,) = _children(self.daemons[name].pid)
        (slurmd,) = [pid for pid in _children(shell) if _name(pid) == "slurmd"]
        os.kill(slurmd, signal.SIGKILL)


@contextmanager
def slurm_cluster() -> Iterator[SlurmCluster]:
    """Start a cluster; at the end, also after an error, all its daemons and jobs are killed.

    Raises:
        CannotRunError: Slurm is not installed, or this process is not root.
        RuntimeError: the nodes did not become idle in `START_TIMEOUT_S`.
    """
    require_slurm()
    with tempfile.TemporaryDirectory(prefix="slurm-", ignore_cleanup_errors=True) as name, ExitStack() as stack:
        folder = Path(name)
        folder.chmod(0o755)  # munged refuses a socket in a closed folder
        for part in ("state", *NODES):
            (folder / part).mkdir()
        write_private(folder / "munge.key", os.urandom(MUNGE_KEY_BYTES))
        ports = free_ports(1 + len(NODES))
        (folder / "slurm.conf").write_text(slurm_config(folder, socket.gethostname(), ports, node_cpus()), "utf-8")
        cluster = SlurmCluster(folder, {})
        for daemon, command in daemon_commands(folder).items():
            with (folder / f"{daemon}.out").open("wb") as log:
                process = subprocess.Popen(command, env=cluster.environment, stdout=log, stderr=log)
            cluster.daemons[daemon] = process
            stack.callback(_stop, process)
            if daemon == "munged":
                wait_until((folder / "munge.socket").exists, START_TIMEOUT_S, f"munged did not start: {INSTALL}")
        wait_until(lambda: _are_idle(cluster), START_TIMEOUT_S, "the nodes of the Slurm cluster did not become idle")
        yield cluster


def require_slurm() -> None:
    """Raise CannotRunError if this machine cannot start a cluster."""
    if sys.platform != "linux":
        raise CannotRunError("the trial starts Slurm, which needs Linux")
    missing = [name for name in PROGRAMS if shutil.which(name) is None]
    if missing or not CONFIG_DIR.is_dir():
        raise CannotRunError(f"the trial needs Slurm, without it {', '.join(missing) or CONFIG_DIR}: {INSTALL}")
    if os.geteuid() != 0:
        raise CannotRunError("the trial starts the daemons of Slurm in namespaces of their own: run it as root")


def slurm_config(folder: Path, host: str, ports: Sequence[int], cpus: int) -> str:
    """Return the text of slurm.conf: two nodes on this host, no cgroups, no accounting, only 127.0.0.1.

    ports: of slurmctld, then of each node.
    """
    nodes = [
        f"NodeName={name} NodeHostname={host} NodeAddr=127.0.0.1 Port={port} CPUs={cpus} RealMemory={NODE_MEMORY_MB}"
        for name, port in zip(NODES, ports[1:], strict=True)
    ]
    lines = (
        "ClusterName=stress",
        f"SlurmctldHost={host}(127.0.0.1)",
        f"SlurmctldPort={ports[0]}",
        "CommunicationParameters=NoInAddrAny,NoCtldInAddrAny",
        "SlurmUser=root",
        "AuthType=auth/munge",
        f"AuthInfo=socket={folder}/munge.socket",
        f"StateSaveLocation={folder}/state",
        f"SlurmctldPidFile={folder}/slurmctld.pid",
        f"SlurmctldLogFile={folder}/slurmctld.log",
        f"SlurmdSpoolDir={folder}/%n",
        f"SlurmdPidFile={folder}/%n.pid",
        f"SlurmdLogFile={folder}/%n.log",
        "ProctrackType=proctrack/linuxproc",
        "TaskPlugin=task/none",
        "JobAcctGatherType=jobacct_gather/none",
        "AccountingStorageType=accounting_storage/none",
        "MpiDefault=none",
        "SelectType=select/cons_tres",
        "SelectTypeParameters=CR_Core_Memory",
        "SlurmdParameters=config_overrides",
        f"SlurmdTimeout={SLURMD_TIMEOUT_S}",
        "ReturnToService=2",
        *nodes,
        f"PartitionName=main Nodes={','.join(NODES)} Default=YES MaxTime=INFINITE State=UP",
    )
    return "\n".join(lines) + "\n"


def daemon_commands(folder: Path) -> dict[str, list[str]]:
    """Return the commands of all daemons by name, in the order of their start."""
    munge = {"key-file": "munge.key", "socket": "munge.socket", "pid-file": "munged.pid", "log-file": "munged.log"}
    files = [f"--{option}={folder / name}" for option, name in (munge | {"seed-file": "munged.seed"}).items()]
    commands = {
        "munged": [*ENDS_WITH_PARENT, "munged", "--foreground", *files],
        "slurmctld": [*ENDS_WITH_PARENT, "slurmctld", "-D", "-c"],
    }
    for name in NODES:
        # The shell is the first process of the namespace, which lives on when slurmd is killed.
        script = f"mount --bind '{folder}' {CONFIG_DIR} && slurmd -D -N {name}; exec sleep infinity"
        commands[name] = [*NAMESPACE, "sh", "-c", script]
    return commands


def node_cpus() -> int:
    """Return the CPUs of a node: the nodes share those of this host."""
    return max(1, len(os.sched_getaffinity(0)) // len(NODES))


def free_ports(count: int) -> list[int]:
    """Return free ports of 127.0.0.1."""
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in sockets]


def write_private(path: Path, content: bytes) -> None:
    """Write a file that only its owner can read."""
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o400), "wb") as file:
        file.write(content)


def wait_until(condition: Callable[[], bool], timeout_s: float, failure: str) -> None:
    """Wait until a condition holds. RuntimeError with the message `failure` if it does not in time."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            raise RuntimeError(failure)
        time.sleep(0.5)


def _are_idle(cluster: SlurmCluster) -> bool:
    try:
        states = cluster.call("sinfo", "--noheader", "--Node", "--format=%T").split()
    except subprocess.CalledProcessError:  # slurmctld does not answer yet
        return False
    return states == ["idle"] * len(NODES)


def _stop(process: "subprocess.Popen[bytes]") -> None:
    process.kill()
    process.wait()


def _children(pid: int) -> list[int]:
    text = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="utf-8")
    return [int(word) for word in text.split()]


def _name(pid: int) -> str:
    return Path(f"/proc/{pid}/comm").read_text(encoding="utf-8").strip()
