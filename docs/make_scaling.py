"""Measures what docs/scaling.md says of the engine: cells that sleep, on as many local workers as asked for.

    python docs/make_scaling.py --workers 20 --cells 10000 --seconds 0.1

What a cell computes is replaced by sleep; the client, Dask, the transfer of arrays and the folder are those of a sweep.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any
from unittest import mock


def main() -> None:
    """Print the figures as JSON."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--workers", type=int, default=20)
    options.add_argument("--cells", type=int, default=10_000)
    options.add_argument("--seconds", type=float, default=0.1, help="that a cell sleeps")
    options.add_argument("--programs", type=int, default=20)
    options.add_argument("--numbers", type=int, default=1000, help="in the arrays of a cell")
    print(json.dumps(measure(**vars(options.parse_args()))))


def measure(workers: int, cells: int, seconds: float, programs: int, numbers: int) -> dict[str, Any]:
    """Run the cells and write them; rates of all of it, and of its parts."""
    import numpy as np

    from mjx_study.study import cluster
    from mjx_study.study.store import Part, Store

    def sleep(study: bytes, index: int, kept: Any, block: Any) -> Any:
        import time

        import numpy

        time.sleep(seconds)
        return {"values": numpy.full(numbers, float(index))}

    class Plan:
        """As much of a plan as hands out cells."""

        def __init__(self) -> None:
            self.cells = range(cells)

        def program_of(self, cell: int) -> int:
            return cell % programs

    index = {"cells": [{"label": str(cell), "at": {}} for cell in range(cells)], "config": {}}
    replaced = {"_compute": sleep, "_packed": lambda plan: b"", "Computation": lambda plan: None}
    replaced["in_blocks"] = lambda plan, index: False
    with tempfile.TemporaryDirectory() as name, mock.patch.multiple(cluster, **replaced):
        store, writing = Store(Path(name), index), 0.0
        (Path(name) / "cells").mkdir()
        with cluster.connected(f"local:{workers}") as client:
            client.wait_for_workers(workers)
            begun, processor = time.perf_counter(), time.process_time()
            parts = {cell: Part() for cell in range(cells)}
            for done, arrays in cluster.cells_on(client, Plan(), parts, lambda _: None):  # type: ignore[arg-type]
                assert isinstance(arrays, dict) and np.all(arrays["values"] == done)
                before = time.perf_counter()
                store.write(done, arrays)
                writing += time.perf_counter() - before
            wall = time.perf_counter() - begun
            processor = time.process_time() - processor
        size = store.path(0).stat().st_size
        claimed = time.perf_counter()
        with store.claim(*range(cells)):
            claimed = time.perf_counter() - claimed
    return {
        "workers": workers,
        "cells": cells,
        "wall [s]": wall,
        "cells per second": cells / wall,
        "busy": cells * seconds / (workers * wall),
        "client's processor [ms/cell]": 1e3 * processor / cells,
        "writing [ms/cell]": 1e3 * writing / cells,
        "file [bytes]": size,
        "claiming [us/cell]": 1e6 * claimed / cells,
    }


if __name__ == "__main__":
    main()
