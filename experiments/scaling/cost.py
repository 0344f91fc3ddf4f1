"""Time rollouts and gradients against samples, horizon, degrees of freedom, contacts and devices."""

import json
import statistics
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, Final

import jax
import numpy as np

from experiments import write_json
from experiments.scaling.models import chain, feet, task_of
from experiments.timing import interleaved
from mjx_study.objective import Simulator, spread
from mjx_study.runtime import configure, environment, local_devices
from mjx_study.simulation.scene import num_constraint_rows
from mjx_study.tasks import make_task
from mjx_study.tasks.task import Task

KINDS: Final = ("value", "gradient")
REPEATS: Final = 7
LIMIT: Final = 6.0  # seconds after which a measurement is not repeated
BASE: Final = "pusher"
HORIZON: Final = 20
SPREAD_HORIZON: Final = 200
"""Horizon of calls that run on several devices: a call must outlast the launch of the others."""
SAMPLES: Final = {"cpu": (100, 1000, 10_000, 100_000), "gpu": (100, 1000, 10_000, 100_000, 1_000_000)}
CHUNK: Final = {"cpu": 256, "gpu": 32_768}
COUNTS: Final = (1, 2, 4, 8, 16)
MODELS: Final = {"contacts": (feet, (1, 2, 4, 8)), "dof": (chain, (2, 4, 8, 16))}


@cache
def _task(model: str, horizon: int) -> Task:
    """Return a task of the package, or of an MJCF."""
    return task_of(model, horizon) if "<" in model else make_task(model, horizon=horizon)


@cache
def _simulator(model: str, horizon: int, chunk: int) -> Simulator:
    return Simulator(_task(model, horizon), chunk_size=chunk)


def rows_of(task: Task, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return key data and factors on the noise of a batch; keys repeat after 10,000 samples."""
    keys = jax.random.key_data(jax.random.split(jax.random.key(0), min(samples, 10_000)))
    return np.resize(keys, (samples, 2)), np.ones(samples, task.scene.template.qpos.dtype)


def batch_call(
    kind: str, samples: int, chunk: int, model: str = BASE, horizon: int = HORIZON, devices: int = 1
) -> tuple[dict[str, Any], Callable[[], Any]]:
    """Return the sizes of a batch, and a call that computes it."""
    simulator, task = _simulator(model, horizon, chunk), _task(model, horizon)
    rows = rows_of(task, samples)
    shared, program = (task.theta, None, np.asarray(task.sigma, rows[1].dtype)), simulator._programs[kind]
    sizes = {"kind": kind, "samples": samples, "chunk": chunk, "devices": devices, "steps": horizon}
    sizes |= {"dof": int(task.scene.host.nv), "constraints": num_constraint_rows(task.scene.template)}
    return sizes, lambda: jax.block_until_ready(spread(program, shared, rows, chunk, local_devices()[:devices]))


def measurements(platform: str) -> Iterator[tuple[str, int, dict[str, Any]]]:
    """Yield the axis, the position on it and the arguments of `batch_call`, the most important first."""
    chunk, largest = CHUNK[platform], len(local_devices())
    counts = [at for at in COUNTS if at <= largest]
    for kind in KINDS:
        for at in SAMPLES[platform]:
            yield "samples", at, {"kind": kind, "samples": at, "chunk": min(at, chunk)}
        for at in counts:
            batch = {"samples": 4 * max(counts) * chunk, "horizon": SPREAD_HORIZON, "devices": at}
            yield "devices", at, {"kind": kind, "chunk": chunk} | batch
        for at in (20, 60, 200):
            yield "horizon", at, {"kind": kind, "samples": chunk, "chunk": chunk, "horizon": at}
        for axis, (mjcf, positions) in MODELS.items():
            for at in positions:
                yield axis, at, {"kind": kind, "samples": chunk, "chunk": chunk, "model": mjcf(at)}


def measure_cost(seconds: float, output: Path, axes: list[str]) -> None:
    """Time what the file lacks, and write it after each measurement.

    Args:
        seconds: time after which no measurement starts; processor time on a CPU.
        output: JSON file, which is completed if it exists.
        axes: axes to measure, again if the file has them; by default, all that the file lacks.
    """
    configure()
    platform = "cpu" if local_devices()[0].platform == "cpu" else "gpu"
    clock = time.process_time if platform == "cpu" else time.perf_counter
    begun, chunk = clock(), CHUNK[platform]
    document: dict[str, Any] = {"environment": environment(), "measured": [], "left_out": []}
    if output.exists():
        document |= {"measured": [r for r in json.loads(output.read_text())["measured"] if r["axis"] not in axes]}
    _, base = batch_call("value", chunk, chunk)
    base()
    bases: list[float] = []
    for axis, at, arguments in measurements(platform):
        known = {(row["axis"], row["at"], row["kind"]) for row in document["measured"]}
        if (axes and axis not in axes) or (axis, at, arguments["kind"]) in known:
            continue
        if clock() - begun > seconds:
            document["left_out"].append([axis, at, arguments["kind"]])
            continue
        sizes, call = batch_call(**arguments)
        call()
        wall = time.perf_counter if axis == "devices" else clock
        taken = interleaved({"base": base, "own": call}, REPEATS, clock=wall, limit=LIMIT)
        steps = chunk * HORIZON  # the unit is one step of one rollout of the base
        ratio = statistics.median(own / other for own, other in zip(taken["own"], taken["base"], strict=True)) * steps
        document["measured"].append({"axis": axis, "at": at, **sizes, "ratio": ratio, "seconds": min(taken["own"])})
        bases += [other / steps for other in taken["base"]]
        document["base"] = {"task": BASE, "steps": HORIZON, "samples": chunk, "step": statistics.median(bases)}
        write_json(output, document)
        print(f"{clock() - begun:6.0f} s  {axis:9} {at:8} {sizes['kind']:9} {min(taken['own']):9.4g} s", flush=True)
    print(f"{len(document['left_out'])} left out for lack of time")


def measure_devices(tasks: list[str], samples: list[int]) -> None:
    """Print the throughput of gradients and rollouts on one device and on all, in equal chunks, as JSON."""
    configure()
    print(json.dumps(environment()))
    every = len(local_devices())
    for name in tasks:
        for count in samples:
            # Several calls on each device, so that the end of the last one hardly counts.
            share = -(-count // every)
            chunk = -(-share // -(-share // 50_000))
            for kind in KINDS:
                horizon = make_task(name).horizon
                calls = {n: batch_call(kind, count, chunk, name, horizon, n)[1] for n in (1, every)}
                alone, together = (jax.tree.leaves(jax.device_get(call())) for call in calls.values())
                same = all(np.array_equal(a, b, equal_nan=True) for a, b in zip(alone, together, strict=True))
                times = {n: statistics.median(taken) for n, taken in interleaved(calls, REPEATS).items()}
                line: dict[str, Any] = {"task": name, "samples": count, "chunk": chunk, "kind": kind, "devices": every}
                line["million steps per second"] = {n: count * horizon / taken / 1e6 for n, taken in times.items()}
                print(json.dumps(line | {"ratio": times[1] / times[every], "bitwise identical": same}), flush=True)
