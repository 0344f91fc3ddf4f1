"""Rate at which workers compute cells that only sleep: client, Dask, transfer of arrays and folder are real."""

import tempfile
import time
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from mjx_study.execution import cluster
from mjx_study.execution.cells import Cells
from mjx_study.progress import silent
from mjx_study.storage.folder import Store


def measure_engine(workers: int, cells: int, seconds: float, programs: int, numbers: int) -> dict[str, Any]:
    """Run the cells and write them; return rates of the whole and of its parts."""

    def sleep(study: bytes, index: int, kept: Any, unit: int) -> Any:
        import time

        import numpy

        time.sleep(seconds)
        return {"values": numpy.full(numbers, float(index))}

    class Plan:
        """Just enough of a plan to hand out cells."""

        def __init__(self) -> None:
            self.cells = range(cells)

        def program_of(self, cell: int) -> int:
            return cell % programs

        def label(self, cell: int) -> str:
            return str(cell)

    class Computation:
        """Cells of one work unit."""

        def begin(self, cell: int, checkpoint: Any) -> None:
            pass

    index = {"cells": [{"label": str(cell), "at": {}} for cell in range(cells)], "config": {}}
    replaced = {"_compute": sleep, "_packed": lambda plan: b""}
    with tempfile.TemporaryDirectory() as name, mock.patch.multiple(cluster, **replaced):
        store, writing = Store(Path(name), index), 0.0
        (Path(name) / "cells").mkdir()
        with cluster.connected(f"local:{workers}") as client:
            client.wait_for_workers(workers)
            begun, processor = time.perf_counter(), time.process_time()
            given = Cells(Plan(), Computation(), silent)  # type: ignore[arg-type]
            for done, arrays in cluster.compute_there(client, given, range(cells)):
                assert isinstance(arrays, dict) and np.all(arrays["values"] == done)
                before = time.perf_counter()
                store.write(done, arrays)
                writing += time.perf_counter() - before
            wall = time.perf_counter() - begun
            processor = time.process_time() - processor
        size = store.path(0).stat().st_size
        claimed = time.perf_counter()
        with store.claims() as claim:
            assert all(map(claim, range(cells)))
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
