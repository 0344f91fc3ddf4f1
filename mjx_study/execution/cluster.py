"""Compute a study's cells on several machines with Dask: workers return arrays, and only the client writes files.

A worker has one work unit at a time, and gets the next once the client has its arrays. A worker that dies thus loses a
single, known unit. Workers keep compiled programs by the content of the study, and a unit goes to a worker that has
compiled its program, if there is one.
"""

import dataclasses
import functools
import logging
import math
import os
import pickle
import queue
import re
import sys
import threading
import time
from collections import Counter, defaultdict, deque
from collections.abc import Generator, Hashable, Iterable, Mapping
from contextlib import ExitStack, contextmanager, suppress
from glob import glob
from typing import Any, Final

from mjx_study.disk import temporary_folder
from mjx_study.execution.cells import Cells
from mjx_study.experiment.plan import plan_study
from mjx_study.experiment.study import Arrays, Checkpoint, Computation, StudyError, StudyPlan
from mjx_study.identity import differences, versions
from mjx_study.options.parser import CLUSTER, COUNT
from mjx_study.runtime import available_cores, configure, precision
from mjx_study.watchdog import watch

TRIES: Final = 3
"""Attempts at a work unit before its cell counts as failed."""
CONNECT_SECONDS: Final = 30
"""Timeout for reaching a scheduler."""
POLL_SECONDS: Final = 1.0  # interval between polls of the workers
SELDOM: Final = {
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.worker.memory.monitor-interval": "1s",
    "distributed.worker.profile.enabled": False,
}
"""Intervals of Dask's housekeeping, which this process does for every local worker: with 100 workers, the defaults keep
a core busy."""
PRIVATE: Final = {"distributed.scheduler.http.routes": [], "distributed.worker.http.routes": []}
"""Pages of local workers, which anybody on the machine could read: none."""
GPUS: Final = "/dev/nvidia[0-9]*"
_ONE_AT_A_TIME, _SET_UP = threading.Lock(), threading.Event()
WorkUnit = tuple[int, int]
"""Index of a cell, and one of its work units."""


class WorkerRefusedError(Exception):
    """A worker's numbers would differ from the client's."""


@contextmanager
def connected(cluster: str) -> Generator[Any]:
    """Connect a `distributed.Client` to a scheduler's address, or to workers that live as long as the context.

    Args:
        cluster: "local:N", N local processes, which only this process can connect to; "slurm:N", N workers as
            configured in Dask's jobqueue.yaml; or an address such as "tcp://host:8786". Without N, one process per
            core, or one Slurm worker.

    Raises:
        ValueError: Dask is not installed, the number of workers is none, or the cluster cannot be reached.
    """
    kind, _, count = cluster.partition(":")
    if kind in ("local", "slurm") and not re.fullmatch(COUNT, cluster.removeprefix(kind)):
        raise ValueError(f"the cluster must be {CLUSTER}, got {cluster!r}")
    address: Any = cluster
    with ExitStack() as stack:  # closes the client and any workers started here
        try:
            import dask.config
            import distributed

            logging.getLogger("distributed").setLevel(logging.CRITICAL)  # this module reports on workers
            if kind == "local":
                scratch = {"temporary-directory": stack.enter_context(temporary_folder())}
                stack.enter_context(dask.config.set(SELDOM | PRIVATE | scratch))
                local = distributed.LocalCluster(
                    n_workers=int(count or available_cores()),
                    threads_per_worker=1,
                    processes=True,
                    dashboard_address="127.0.0.1:0",  # of the server of HTTP, which has nothing to serve
                    scheduler_kwargs={"dashboard": False},
                    silence_logs=logging.CRITICAL,
                    security=distributed.Security.temporary(),  # anybody on this machine may connect to a port
                )
                address = stack.enter_context(local)
            elif kind == "slurm":
                from dask_jobqueue.slurm import SLURMCluster

                address = stack.enter_context(SLURMCluster())
                address.scale(int(count or 1))
            client = stack.enter_context(distributed.Client(address, timeout=CONNECT_SECONDS, set_as_default=False))
        except ImportError as error:
            raise ValueError(f"a cluster needs Dask ({error}): pip install 'mjx-study[cluster]'") from error
        except OSError as error:
            raise ValueError(f"cannot reach the cluster {cluster}: {error}") from error
        yield client


def compute_there(client: Any, cells: Cells, indices: Iterable[int]) -> Generator[tuple[int, Arrays | str]]:
    """Compute cells on a cluster whose workers may come and go; an `execution.cells.Executor`.

    Yields:
        Index and arrays of each cell in order of completion, or the reason why one of its units failed `TRIES` times.

    Raises:
        StudyError: a worker has other versions, or the connection to the scheduler is lost.
    """
    plan, study = cells.plan, _packed(cells.plan)
    waiting: dict[Hashable, deque[WorkUnit]] = defaultdict(deque)
    has: dict[Hashable, set[str]] = defaultdict(set)  # workers that have compiled a program
    at: dict[Any, tuple[WorkUnit, str]] = {}  # unit and worker of each future
    ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
    tries: Counter[WorkUnit] = Counter()

    def program_of(index: int) -> Hashable:
        return plan.program_of(plan.cells[index])

    def begin(worker: str) -> None:
        for program in _program_for(worker, waiting, has):
            index, unit = waiting[program].popleft()
            has[program].add(worker)
            kept = cells.kept(index)
            future = client.submit(_compute, study, index, kept, unit, workers=[worker], pure=False)
            at[future] = (index, unit), worker
            future.add_done_callback(fetch)

    def fetch(future: Any) -> None:
        """Runs in a thread of Dask, which blocks here if the worker is lost before its arrays arrive."""
        try:
            outcome = future.result()
        except BaseException as error:  # any exception on the worker, or a cancellation
            outcome = error
        ended.put((future, outcome))

    def failed(index: int, unit: int, reason: str) -> Generator[tuple[int, str]]:
        """Count a failed attempt; yield the cell's failure if it was the last attempt at one of its units."""
        if not cells.running(index):
            return  # another of its units has exhausted its attempts
        tries[index, unit] += 1
        units = waiting[program_of(index)]
        if tries[index, unit] < TRIES:
            units.append((index, unit))
            return
        cells.drop(index)
        waiting[program_of(index)] = deque(other for other in units if other[0] != index)
        yield index, reason

    def look(count: int) -> Generator[tuple[int, str], None, int]:
        """Look for workers that are lost, and give units to those that are idle; return the number of workers."""
        workers = set(client.nthreads())
        for holders in has.values():
            holders &= workers
        for future, (unit, worker) in list(at.items()):
            if worker not in workers:
                del at[future]
                future.cancel()
                yield from failed(*unit, f"lost its worker {TRIES} times (killed, crashed or out of memory)")
        for worker in workers - {worker for _, worker in at.values()}:
            begin(worker)
        if len(workers) != count:
            cells.report(f"{len(workers)} workers" if workers else "waiting for workers")
        return len(workers)

    for index in indices:
        missing = cells.begin(index)
        waiting[program_of(index)].extend((index, unit) for unit in missing)
        if not missing:
            yield index, cells.end(index)
    looked, count = -math.inf, -1
    try:
        while at or any(waiting.values()):
            if time.monotonic() - looked >= POLL_SECONDS:
                looked = time.monotonic()
                count = yield from look(count)
            done = []
            for future, outcome in _all_of(ended):  # all idle workers get units before any arrays are written
                if future in at:
                    unit, worker = at.pop(future)
                    if isinstance(outcome, WorkerRefusedError):
                        raise StudyError(str(outcome)) from outcome
                    begin(worker)
                    done.append((unit, outcome))
            for (index, unit), outcome in done:
                if isinstance(outcome, BaseException):
                    yield from failed(index, unit, f"{type(outcome).__name__}: {outcome}".partition("\n")[0])
                elif cells.running(index) and (numbers := cells.finish(index, unit, outcome)) is not None:
                    cells.report(cells.label(index))
                    yield index, numbers
    except OSError as error:
        raise StudyError(f"lost the scheduler ({error}); the same command resumes") from error
    finally:
        with suppress(OSError):
            client.cancel(list(at))


def _all_of(ended: queue.SimpleQueue[Any]) -> Generator[Any]:
    """Empty the queue, waiting a while for the first item."""
    with suppress(queue.Empty):
        yield ended.get(timeout=POLL_SECONDS)
        for _ in range(ended.qsize()):
            yield ended.get_nowait()


def _program_for(worker: str, waiting: Mapping[Any, deque[Any]], has: Mapping[Any, set[str]]) -> list[Any]:
    """Choose the program of a worker's next cell; none if workers that have one compiled will be sooner.

    Prefers programs that the worker has compiled, then those with the most cells per worker that has them.
    """
    left = {program: len(cells) for program, cells in waiting.items() if cells}
    own = [program for program in left if worker in has[program]]
    new = [program for program, cells in left.items() if cells > len(has[program])]
    return sorted(own or new, key=lambda program: left[program] / (1 + len(has[program])))[-1:]


def _packed(plan: StudyPlan) -> bytes:
    """Pack the configuration, and what a worker's own plan must agree with."""
    import cloudpickle

    return cloudpickle.dumps((plan.config, plan.chunk_size, precision(), versions(), plan.contents))


def _compute(study: bytes, index: int, kept: Arrays, unit: int) -> Arrays:
    with _ONE_AT_A_TIME:
        plan, computation = _prepared(study)
        return computation.compute(plan.cells[index], unit, Checkpoint(kept)).result()


@functools.lru_cache(maxsize=4)
def _prepared(study: bytes) -> tuple[StudyPlan, Computation]:
    """Set up JAX once; return the plan and its `Computation` with compiled programs."""
    from distributed import get_worker

    config, chunk, asked, *client = pickle.loads(study)
    if not _SET_UP.is_set():
        if (gpu := _gpu(get_worker().name)) is not None:
            os.environ["CUDA_VISIBLE_DEVICES"] = gpu
        configure(precision=asked, cpu_devices=1)
        watch(functools.partial(print, file=sys.stderr))  # a worker that hangs is lost, and its unit tried again
        _SET_UP.set()
    plan = plan_study(config)
    ours = versions(), plan.contents
    if different := differences(*({**one, **other} for one, other in (client, ours))):
        raise WorkerRefusedError(f"the worker {get_worker().address} is refused: {different} ('there' is the client)")
    plan = dataclasses.replace(plan, chunk_size=chunk)
    return plan, plan.kind.computation(plan)


def _gpu(worker: Any) -> str | None:
    """GPU of a worker whose name is a number or ends with one after a hyphen; None leaves the choice to JAX."""
    visible, number = os.environ.get("CUDA_VISIBLE_DEVICES"), re.fullmatch(r"(?:.*-)?(\d+)", str(worker))
    found = [path.removeprefix("/dev/nvidia") for path in sorted(glob(GPUS))]
    gpus = found if visible is None else visible.split(",")
    return gpus[int(number[1]) % len(gpus)] if number and len(gpus) > 1 else None
