"""Cells on Dask's workers: real schedulers and processes, which are killed, poisoned and refused."""

import itertools
import json
import os
import pickle
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Generator
from contextlib import contextmanager, suppress
from http.client import HTTPException
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import dask.config
import distributed
import psutil
import pytest
import xarray as xr
import yaml

from mjx_study import cli
from mjx_study.execution import cluster
from mjx_study.execution.cluster import TRIES, connected
from mjx_study.execution.run import run_study
from mjx_study.experiment.study import StudyError
from mjx_study.options.configuration import StudyConfig
from mjx_study.results.warnings import warnings_of
from mjx_study.storage.folder import Store, load_study
from tests.documents import same
from tests.poison import ACCOUNT, CRASH, RAISE, SLOW

STIFFNESSES = tuple(SLOW + index for index in range(8))
ARGUMENTS = ["tests.poison:poison", "--contact", "reference", "--stiffness", ",".join(map(str, STIFFNESSES)),
             "--samples", "4", "--seeds", "2", "--reference-samples", "6"]  # fmt: skip


def config(*stiffness: float, **changes: Any) -> StudyConfig:
    chosen: dict[str, Any] = {"tasks": ("tests.poison:poison",), "contact": ("reference",), "samples": (4,), "seeds": 2}
    return StudyConfig(**(chosen | {"stiffness": stiffness, "reference_samples": 6} | changes))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> xr.Dataset:
    """Computed in this process."""
    return run_study(config(*STIFFNESSES), tmp_path_factory.mktemp("study"))


@pytest.mark.parametrize(
    ("asked", "cells"),
    [
        pytest.param(config(*STIFFNESSES), len(STIFFNESSES), id="cells"),
        pytest.param(config(SLOW, samples=(96,), block_size=8), 1, id="blocks", marks=pytest.mark.slow),
    ],
)
def test_a_killed_worker_costs_its_unit_and_nothing_else(
    workers: Any, undisturbed: xr.Dataset, tmp_path: Path, asked: StudyConfig, cells: int
) -> None:
    """By SIGKILL, after the first unit; the numbers are those of a run in this process, to the bit."""
    killed: list[int] = []

    def kill(done: int, total: int, what: str) -> None:
        if done and not killed:
            killed.append(min(workers.run(os.getpid).values()))
            os.kill(killed[0], signal.SIGKILL)

    found, expected = run_study(asked, tmp_path, kill, cluster=workers), undisturbed if cells > 1 else run_study(asked)
    assert killed and killed[0] not in workers.run(os.getpid).values()
    assert found.attrs["computed_cells"] == cells and found.attrs["missing_cells"] == 0
    assert same(found, expected) and same(load_study(tmp_path), expected)
    assert not list(tmp_path.glob("cells/*.part.npz"))
    assert run_study(asked, tmp_path, cluster=workers).attrs["computed_cells"] == 0


def test_a_poisonous_cell_fails_and_the_rest_goes_on(workers: Any, tmp_path: Path) -> None:
    found = run_study(config(1.0, CRASH, 2.0, RAISE), tmp_path, cluster=workers)
    account = Path(workers.submit(os.environ.get, ACCOUNT, pure=False).result()).read_text().split()
    assert account.count(str(CRASH)) == account.count(str(RAISE)) == TRIES
    assert found.attrs["computed_cells"] == 2 == found.attrs["missing_cells"]
    told = [message for message in warnings_of(found) if "failed" in message]
    assert len(told) == 2 and all("; the same command tries again" in message for message in told)
    assert "K = 13 N/m" in told[0] and f"lost its worker {TRIES} times (killed, crashed or out of memory)" in told[0]
    assert "K = 17 N/m" in told[1] and "MemoryError: no memory for the batch;" in told[1]
    store = Store.open(tmp_path)
    assert store.missing == [1, 3]


def test_a_worker_of_other_versions_is_refused(workers: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ours = cluster.versions()
    monkeypatch.setattr(cluster, "versions", lambda: ours | {"jax": "0.0"})
    with pytest.raises(StudyError, match=r"^the worker tls://\S+ is refused: jax 0\.0 there and \S+ here"):
        run_study(config(1.0), tmp_path, cluster=workers)
    monkeypatch.setattr(cluster, "versions", lambda: ours)
    packed = cluster._packed
    other = {"precision": "float32"}
    monkeypatch.setattr(cluster, "_packed", lambda plan: pickle.dumps((*pickle.loads(packed(plan))[:-1], other)))
    with pytest.raises(StudyError, match="is refused: precision float32 there and float64 here"):
        run_study(config(1.0), tmp_path, cluster=workers)
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 1)
    with pytest.raises(ValueError, match="cannot reach the cluster tcp://127.0.0.1:1: "):
        run_study(config(1.0), tmp_path, cluster="tcp://127.0.0.1:1")


def test_nobody_else_can_connect_to_local_workers(workers: Any) -> None:
    """The scheduler's and the workers' ports answer only to this client's key; there is no dashboard."""
    workers.wait_for_workers(1, timeout=120)  # one that a test before this one killed may not have started again
    addresses = [workers.scheduler.address, *workers.nthreads()]
    assert len(addresses) > 1 and all(address.startswith("tls://127.0.0.1:") for address in addresses)
    stranger = distributed.Security.temporary()
    for address in addresses:
        for url, security in ((address.replace("tls", "tcp"), None), (address, stranger)):
            with pytest.raises(OSError), distributed.Client(url, timeout=3, security=security):
                pass
    family = [psutil.Process(), *psutil.Process().children(recursive=True)]
    ports = {each.laddr.port for one in family for each in one.net_connections() if each.status == "LISTEN"}
    assert {int(address.rpartition(":")[2]) for address in addresses} <= ports
    for port, page in itertools.product(ports, ("", "status", "info/main/workers.html", "health", "metrics")):
        with pytest.raises((OSError, HTTPException)):
            urlopen(f"http://127.0.0.1:{port}/{page}", timeout=3)


@pytest.mark.parametrize("ended_by", [None, signal.SIGTERM])
def test_a_local_cluster_leaves_nothing_behind(tmp_path: Path, ended_by: signal.Signals | None) -> None:
    scratch, folder = tmp_path / "scratch", tmp_path / "out"
    scratch.mkdir()
    cells = "100:1e4:60:log" if ended_by else str(SLOW)  # so many that the signal comes before the last
    with sweep(folder, "local:1", cells, TMPDIR=str(scratch)) as running:
        seen: set[int] = set()
        while running.poll() is None and not list(folder.glob("cells/*.npz")):
            seen |= {path.stat().st_mode & 0o777 for path in scratch.glob("mjx-study-*")}
            time.sleep(0.02)
        if ended_by is not None:
            running.send_signal(ended_by)
        running.communicate()
    assert running.returncode == (0 if ended_by is None else 128 + ended_by) and seen == {0o700}
    assert list(scratch.iterdir()) == []


@pytest.mark.parametrize(("visible", "gpu"), [(None, "1"), ("4,7", "7"), ("", None)])
def test_a_worker_has_a_gpu_of_its_own_unless_they_are_hidden(
    monkeypatch: pytest.MonkeyPatch, visible: str | None, gpu: str | None
) -> None:
    monkeypatch.setattr(cluster, "glob", lambda _: ["/dev/nvidia0", "/dev/nvidia1"])
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if visible is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    assert cluster._gpu("worker-3") == gpu


@pytest.mark.parametrize("address", ["local:0", "local:-1", "slurm:x"])
def test_a_cluster_has_workers(address: str) -> None:
    with pytest.raises(ValueError, match="^the cluster must be local:N, slurm:N or an address"), connected(address):
        pass


def test_a_cluster_needs_a_folder() -> None:
    with pytest.raises(ValueError, match="a cluster needs a folder"):
        run_study(config(1.0), cluster="local:1")


@pytest.mark.slow
def test_a_worker_simulates_the_same_bits(workers: Any, tmp_path: Path) -> None:
    """MJX on one device of a worker and on two here; descents as well as gradients."""
    descents = {"reference_samples": None, "iterations": 3, "learning_rate": 0.01, "evaluation_samples": 6}
    for name, changes in {"gradients": {}, "descents": descents}.items():
        asked = config(1.0, 2.0, 3.0, tasks=("tests.carts:walled_cart",), contact=("penalty",), chunk_size=4, **changes)
        here = run_study(asked, tmp_path / f"{name} here")
        assert same(run_study(asked, tmp_path / f"{name} there", cluster=workers), here)


def test_the_example_files_are_sound() -> None:
    """The shell parses, Dask's configuration makes a job's script, and what Kubernetes is asked for fits together."""
    files = Path(__file__).parents[1] / "docs" / "cluster"
    page = (files.parent / "scaling.md").read_text()
    shown = [line for line in page.splitlines() if line.startswith("mjx-study") and "--cluster" in line]
    asked = [cli.parser().parse_args(shlex.split(line, comments=True)[1:]).cluster for line in shown]
    assert asked == ["local:16", "slurm:32", "tcp://scheduler:8786"]
    assert sorted(path.name for path in files.iterdir()) == ["jobqueue.yaml", "kubernetes.yaml", "slurm.sh"]
    subprocess.run(["bash", "-n", str(files / "slurm.sh")], check=True)
    jobqueue = pytest.importorskip("dask_jobqueue")
    settings = yaml.safe_load((files / "jobqueue.yaml").read_text())["jobqueue"]["slurm"]
    known = set(dask.config.get("jobqueue.slurm"))
    assert set(settings) <= known
    with dask.config.set({f"jobqueue.slurm.{name}": value for name, value in settings.items()}):
        script = jobqueue.slurm.SLURMJob(scheduler="tcp://there:8786", name="mjx-study").job_script()
    assert "dask worker tcp://there:8786" in script.replace("python -m distributed.cli.dask_worker", "dask worker")
    assert "--nthreads 1 " in script and "--nworkers 4 " in script
    assert "source /shared/mjx-study/.venv/bin/activate" in script
    parts = yaml.safe_load_all((files / "kubernetes.yaml").read_text())
    objects = {(part["kind"], part["metadata"]["name"]): part["spec"] for part in parts}
    (client,) = objects["Job", "sweep"]["template"]["spec"]["containers"]
    options = cli.parser().parse_args(client["command"][1:])
    assert options.cluster == "tcp://scheduler:8786" and ("Service", "scheduler") in objects
    for name in ("scheduler", "worker"):
        deployment = objects["Deployment", name]
        assert deployment["selector"]["matchLabels"] == deployment["template"]["metadata"]["labels"]


def sweep(folder: Path, address: str = "local:2", cells: str = "", **variables: str) -> subprocess.Popen[str]:
    arguments = [cells or each if each == ARGUMENTS[4] else each for each in ARGUMENTS]
    command = [sys.executable, "-m", "mjx_study", "sweep", *arguments, "--cluster", address, "--output", str(folder)]
    environment = os.environ | {ACCOUNT: str(folder)} | variables
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


@contextmanager
def engine(folder: Path) -> Generator[tuple[str, dict[str, psutil.Process]]]:
    """A scheduler and a pair of workers that are restarted when they die, as processes; its address."""
    known = folder / "scheduler.json"
    known.unlink(missing_ok=True)
    dask = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard"]
    pair = [sys.executable, "-m", "distributed.cli.dask_worker", "--nworkers", "2", "--nthreads", "1", "--no-dashboard"]
    started = []
    try:
        for command in (dask, pair):
            file = ["--scheduler-file", str(known)]
            started.append(subprocess.Popen(command + file, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
            while not (known.exists() and known.read_text().rstrip().endswith("}")):  # it may be half written
                assert started[0].poll() is None, "the scheduler does not start"
                time.sleep(0.1)
        yield (
            json.loads(known.read_text())["address"],
            {name: psutil.Process(each.pid) for name, each in zip(("scheduler", "workers"), started, strict=True)},
        )
    finally:
        family = [child for each in started for child in psutil.Process(each.pid).children(recursive=True)]
        for process in [*started, *family]:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        for process in started:
            process.wait()


def _workers(pair: psutil.Process) -> list[psutil.Process]:
    """Workers that are alive, without the nannies that restart them and multiprocessing's helpers."""
    while True:
        found = [each for each in pair.children(recursive=True) if any("spawn_main" in part for part in each.cmdline())]
        if found:
            return found
        time.sleep(0.02)


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["worker", "scheduler", "client"])
def test_a_kill_changes_no_number(victim: str, undisturbed: xr.Dataset, tmp_path: Path) -> None:
    """A command survives workers; one that lost its scheduler says how to go on; no stored cell is computed again."""
    folder = tmp_path / "out"

    def there() -> dict[str, int]:
        return {path.name: path.stat().st_mtime_ns for path in folder.glob("cells/*.npz")}

    with engine(tmp_path) as (address, processes), sweep(folder, address) as running:
        while len(there()) < 3:
            assert running.poll() is None, running.communicate()[1]
            time.sleep(0.02)
        before = there()
        victims = {"client": running, "scheduler": processes["scheduler"]}
        (victims.get(victim) or _workers(processes["workers"])[0]).kill()
        errors = running.communicate(timeout=300)[1]
    assert running.returncode == {"worker": 0, "scheduler": 2, "client": -signal.SIGKILL}[victim], errors
    assert "Traceback" not in errors
    assert victim != "scheduler" or "the same command resumes" in errors.splitlines()[-1]
    with engine(tmp_path) as (address, _), sweep(folder, address) as last:
        errors = last.communicate()[1]
    assert last.returncode == 0, errors
    assert same(load_study(folder), undisturbed)
    assert before.items() <= there().items(), "a cell was computed again"
