"""A batch on a real Slurm: one controller and two nodes on this machine, for this test alone.

    apt-get install slurmctld slurmd slurm-client
    pip install snakemake-executor-plugin-slurm
    python -m pytest -m slow -s tests/cli/test_batch_slurm.py

SLURM_ROOT names a folder that the packages were unpacked into, where they are not installed. The
services of Debian's packages need not run: the test starts its own, on ports of its own.
"""

import getpass
import os
import shutil
import signal
import socket
import subprocess
import time
from collections import Counter
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest
from batches import BatchShell, needs_snakemake

ROOT = Path(os.environ.get("SLURM_ROOT", "/"))
LIB = ROOT / "usr" / "lib" / "x86_64-linux-gnu"
CLIENTS = (
    "sacct",
    "sacctmgr",
    "sbatch",
    "scancel",
    "scontrol",
    "sinfo",
    "squeue",
    "srun",
    "sshare",
)
COUNT = 50
CONFIG = """\
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/none
CredType=cred/none
SlurmctldPort={ports[0]}
PluginDir={lib}/slurm-wlm
StateSaveLocation={root}/state
SlurmdSpoolDir={root}/spool-%n
SlurmctldPidFile={root}/ctld.pid
SlurmdPidFile={root}/%n.pid
SlurmctldLogFile={root}/ctld.log
SlurmdLogFile={root}/%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
MpiDefault=none
ReturnToService=2
SlurmdParameters=config_overrides
MinJobAge=300
JobRequeue=1
NodeName=n1 NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[1]} CPUs=2 RealMemory=64000
NodeName=n2 NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[2]} CPUs=2 RealMemory=64000
PartitionName=main Nodes=n1,n2 Default=YES MaxTime=INFINITE State=UP
"""


def program(name: str) -> Path | None:
    """A program of Slurm's, with or without Debian's suffix."""
    places = [
        ROOT / "usr" / folder / f"{name}{end}" for folder in ("sbin", "bin") for end in ("", "-wlm")
    ]
    return next((place for place in places if place.is_file()), None)


pytestmark = [
    needs_snakemake,
    pytest.mark.slow,
    pytest.mark.timeout(3000),
    pytest.mark.skipif(
        any(program(name) is None for name in ("slurmctld", "slurmd", "slurmstepd", *CLIENTS)),
        reason="Slurm is not installed: apt-get install slurmctld slurmd slurm-client",
    ),
    pytest.mark.skipif(
        find_spec("snakemake_executor_plugin_slurm") is None,
        reason="pip install snakemake-executor-plugin-slurm",
    ),
]


def free_ports(count: int) -> list[int]:
    """Ports that nobody listens on."""
    sockets = [socket.socket() for _ in range(count)]
    for one in sockets:
        one.bind(("127.0.0.1", 0))
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return ports


class Cluster:
    """A controller, two nodes, and clients in a folder for PATH."""

    def __init__(self, root: Path) -> None:
        self.root, self.clients = root, root / "bin"
        for name in ("state", "spool-n1", "spool-n2", "bin"):
            (root / name).mkdir(parents=True)
        host, user = socket.gethostname().partition(".")[0], getpass.getuser()
        text = CONFIG.format(host=host, user=user, ports=free_ports(3), lib=LIB, root=root)
        (root / "slurm.conf").write_text(text)
        libraries = f"{LIB}:{LIB}/slurm-wlm:{ROOT / 'lib' / 'x86_64-linux-gnu'}"
        given = {"SLURM_CONF": str(root / "slurm.conf")}
        given |= {} if Path("/") == ROOT else {"LD_LIBRARY_PATH": libraries}
        self.environment = os.environ | given
        for name in CLIENTS:  # a job's environment lacks what names the configuration
            exports = "".join(f"export {key}={value}\n" for key, value in given.items())
            (self.clients / name).write_text(f'#!/bin/sh\n{exports}exec {program(name)} "$@"\n')
            (self.clients / name).chmod(0o755)
        self.processes = [self._start("slurmctld", "-D", "-c")]
        for node in ("n1", "n2"):
            self.processes.append(
                self._start("slurmd", "-D", "-N", node, "-d", str(program("slurmstepd")))
            )
        self.wait_until("idle", 2)

    def _start(self, name: str, *arguments: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [str(program(name)), *arguments],
            env=self.environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def __call__(self, name: str, *arguments: str) -> str:
        """What a client prints."""
        done = subprocess.run(
            [str(self.clients / name), *arguments], capture_output=True, text=True, check=False
        )
        return done.stdout

    def wait_until(self, state: str, nodes: int) -> None:
        """Wait until so many nodes are in a state."""
        deadline = time.monotonic() + 60
        while self("sinfo", "-h", "-N", "-o", "%T").split().count(state) < nodes:
            assert time.monotonic() < deadline, self("sinfo", "-N")
            time.sleep(0.2)

    def running(self) -> list[str]:
        """The jobs that run."""
        return self("squeue", "-h", "-t", "R", "-o", "%i").split()

    def stop(self) -> None:
        """End it, jobs first."""
        self("scancel", "-u", getpass.getuser())
        time.sleep(1)
        for process in self.processes:
            process.send_signal(signal.SIGTERM)
        for process in self.processes:
            process.wait(timeout=30)


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    found = Cluster(tmp_path / "slurm")
    yield found
    found.stop()


def prepare(shell: BatchShell) -> dict[str, str]:
    """A batch of captures, a tenth of them unusable, and how each must end."""
    texts = {f"c{i:02}": "unusable" if i % 10 == 3 else f"hello {i}" for i in range(COUNT)}
    shell.init(**texts)
    path = shell.batch / "profiles" / "slurm" / "config.yaml"
    lines = path.read_text().replace("YOUR_PARTITION", "main").replace("YOUR_GPU_PARTITION", "main")
    kept = [line for line in lines.splitlines() if "slurm_account" not in line]
    kept += ["slurm-status-command: squeue", "slurm-init-seconds-before-status-checks: 2"]
    path.write_text("\n".join([*kept, "seconds-between-status-checks: 2"]) + "\n")
    return {name: "failed" if text == "unusable" else "done" for name, text in texts.items()}


def test_a_drained_node_and_a_requeued_job_change_no_end(tmp_path: Path, cluster: Cluster) -> None:
    shell = BatchShell(tmp_path)
    shell.environment["PATH"] = f"{cluster.clients}:{os.environ['PATH']}"
    wanted = prepare(shell)
    start = time.monotonic()
    process = shell.start("batch", "run", "B", "--profile", "slurm", FAKE_STEP_S="0.1")
    requeued = 0
    while process.poll() is None and requeued < 3:
        time.sleep(2)
        done = len(list(shell.batch.glob("steps/*/finish.json")))
        if jobs := cluster.running() if done >= 2 else []:
            cluster("scontrol", "requeue", jobs[0])
            requeued += 1
            if requeued == 1:
                cluster("scontrol", "update", "nodename=n2", "state=drain", "reason=test")
    _, said = process.communicate(timeout=2500)
    took = time.monotonic() - start
    assert requeued == 3 and "drain" in cluster("sinfo", "-h", "-N", "-n", "n2", "-o", "%T")
    assert shell.states() == wanted, said[-3000:]
    for name, end in wanted.items():
        made = Counter(path.parts[-3] for path in shell.made() if f"{name}.refdgs" in str(path))
        assert end == "failed" or made == {"read": 1, "shout": 1, "export": 1}
    print(f"\n{COUNT} captures on Slurm, 3 jobs requeued, a node drained: {took:.0f} s")
    shutil.rmtree(shell.batch)
