"""Chunks of samples: their sizes, and calls on all devices at once."""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np

from mjx_study.compiled import Compiled
from mjx_study.graph.native import computes_steps, in_numpy
from mjx_study.tasks.task import Task
from mjx_study.watchdog import awaited

CPU_CHUNKS: Final = (11, 101, 201)
"""Samples per call on a CPU, which gains little from more. Few choices, so that other numbers of samples reuse compiled
programs; one more than round numbers, for the baseline."""
MANY: Final = 2000
"""Samples from which a CPU takes the largest chunks, which pay for another program."""
IN_TURN: Final = (16, 56)  # the same in a program that takes batches in turn, as native code in vectors of eight
IN_NUMPY: Final = 2001
"""Samples per call where NumPy stands in for native code, which leaves out copies: an operation takes 0.3 us for 100
samples, 0.6 for 2,000."""
MAX_CHUNK: Final = {"cpu": CPU_CHUNKS[-1], "gpu": 2**17 + 1, "tpu": 2**17 + 1}
"""Maximum number of samples per device and call, by backend."""
MAX_SHARE: Final = 0.25  # maximum share of an accelerator's memory for the gradients of a chunk


def spread(program: Compiled, shared: Any, rows: Sequence[np.ndarray], chunk: int, devices: Sequence[Any]) -> Any:
    """Call a compiled program on chunks of rows, on all devices at once.

    On CPUs all chunks run on the first device, called from as many threads as there are devices: these calls run in
    parallel, and one compilation serves all cores. (JAX 0.11 crashes compiling MJX under `shard_map` or `pmap`.)

    Args:
        program: function of the shared arguments and one chunk of each array of rows.
        rows: arrays of equal length.
        chunk: rows per call; the last chunk is padded with copies of the last row.

    Returns:
        The program's outputs with a leading axis of rows: NumPy arrays, or on accelerators arrays on the first device.
    """
    on_host = devices[0].platform == "cpu"
    fetched, join = (jax.device_get, np) if on_host else (partial(jax.device_put, device=devices[0]), jnp)
    devices = [devices[0]] * len(devices) if on_host else devices
    count = len(rows[0])
    chunks = np.minimum(np.arange(math.ceil(count / chunk) * chunk), count - 1).reshape(-1, chunk)
    devices, outputs = devices[: len(chunks)], [None] * len(chunks)
    placed = {device: jax.device_put(shared, device) for device in devices}

    def call(device: Any, part: np.ndarray) -> Any:
        return run(*placed[device], *jax.device_put(tuple(array[part] for array in rows), device))

    # Traced in this thread, since tracing patches MJX for the whole process.
    first = *placed[devices[0]], *(array[chunks[0]] for array in rows)
    run = program.executable(*first, platform=devices[0].platform)
    left = iter(range(len(chunks)))

    def work(device: Any) -> None:
        for index in left:
            outputs[index] = fetched(call(device, chunks[index]))

    with awaited(), ThreadPoolExecutor(len(devices)) as pool:
        for worker in [pool.submit(work, device) for device in devices]:
            worker.result()
    return jax.tree.map(lambda *leaves: join.concatenate(leaves)[:count], *outputs)


def chunk_for(samples: int, devices: Sequence[Any], tasks: Sequence[Task] = (), *, own_program: bool = False) -> int:
    """Choose the chunk size for `samples` and their baseline.

    On CPUs, the smallest of `CPU_CHUNKS` that holds them, or the middle one for fewer than `MANY`; for a program of
    such batches alone, one of `IN_TURN`, or, through XLA, all that the largest holds; `IN_NUMPY` for half of the middle
    one or more. On accelerators, the size that needs the fewest calls (at least one per device), evenly filled, with at
    most as many samples as task gradients fit into `MAX_SHARE` of the memory.
    """
    platform = devices[0].platform
    if platform == "cpu":
        few, some, most = CPU_CHUNKS
        if in_numpy() and samples > some // 2:
            return IN_NUMPY
        if own_program and natively(tasks):
            return IN_TURN[samples >= IN_TURN[0]]
        if own_program:
            return min(samples + 1, most)
        return few if samples < few else some if samples < MANY else most
    each = math.ceil((samples + 1) / len(devices))
    memory = (devices[0].memory_stats() or {}).get("bytes_limit", math.inf)
    most = max(1, int(min(MAX_CHUNK[platform], MAX_SHARE * memory / max(map(_gradient_bytes, tasks), default=1))))
    return math.ceil(each / math.ceil(each / most))


def natively(tasks: Sequence[Task]) -> bool:
    """Whether JAX's default backend is a CPU that runs the tasks as native code, whatever the size of a chunk."""
    return jax.default_backend() == "cpu" and computes_steps() == "native" and all(t.scene.uses_graph for t in tasks)


def _gradient_bytes(task: Task) -> int:
    """Approximate memory [bytes] of the states and Jacobians stored for a gradient."""
    host = task.scene.host
    inputs = host.nq + host.nv + host.na + host.nu
    return 8 * task.horizon * (inputs * (2 * host.nv + host.na) + 2 * inputs)
