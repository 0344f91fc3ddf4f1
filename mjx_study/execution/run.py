"""Run studies, in memory or cell by cell in a folder that survives a kill.

A cell is one task, timestep, cone, contact model, sigma and sample count, with all seeds and estimators. It depends on
the configuration alone, not on which cells were computed before it or by whom. Each timestep and cone is compiled
separately; everything else is traced.
"""

import dataclasses
import json
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, Final

import xarray as xr

from estimators.user_inputs import observing
from mjx_study.execution.cells import Cells, Executor, compute_here
from mjx_study.execution.cluster import compute_there, connected
from mjx_study.experiment.plan import plan_study
from mjx_study.experiment.study import Arrays, StudyPlan
from mjx_study.identity import differences, versions
from mjx_study.options.configuration import StudyConfig
from mjx_study.progress import Progress, silent
from mjx_study.storage.dataset import dataset_of, write_dataset
from mjx_study.storage.folder import Store, open_store
from mjx_study.storage.manifest import document_of
from mjx_study.table import as_plain

WAIT_SECONDS: Final = 0.5  # interval between polls of cells that another process computes


def run_study(
    study: StudyConfig | StudyPlan,
    folder: str | Path | Store | None = None,
    progress: Progress = silent,
    *,
    command: str | None = None,
    accept_versions: bool = False,
    keep_going: bool = False,
    cluster: Any = None,
) -> xr.Dataset:
    """Run a study in memory, or compute what a folder lacks, together with any other process doing the same.

    Args:
        study: a configuration, or its plan from `plan_study`.
        folder: folder of the study, new or begun, or a `Store` from `open_store`; None to keep the study in memory.
        progress: called before every cell, and within descents.
        command: command line to record with a new study.
        accept_versions: resume a study begun by other versions of JAX, MuJoCo or this package.
        keep_going: if a file cannot be written, compute the rest in memory; the attribute `unwritten` gives the reason.
        cluster: a `distributed.Client`, or an argument of `connected`, whose workers compute the cells; needs a folder.

    Returns:
        All numbers of the study, labelled; the attribute `computed_cells` counts the cells computed by this call, and
        `failed_cells` lists those that failed on the cluster, with reasons.

    Raises:
        ValueError: the configuration cannot be run, the folder holds another study or is not writable, or the cluster
            cannot be reached.
        StudyError: a file of the study is damaged, or a worker has other versions.
        OSError: a cell could not be written; earlier ones are kept.
    """
    plan = plan_study(study) if isinstance(study, StudyConfig) else study
    if folder is None:
        if cluster is not None:
            raise ValueError("a cluster needs a folder for the study")
        return _in_memory(plan, progress, command)
    store = folder if isinstance(folder, Store) else None
    if store is None:
        store = open_store(plan, Path(folder), command, accept_versions=accept_versions)  # type: ignore[arg-type]
    with ExitStack() as stack:
        client = stack.enter_context(connected(cluster)) if isinstance(cluster, str) else cluster
        stack.enter_context(observing(*plan.user_modules))
        executor = compute_here if client is None else partial(compute_there, client)
        plan = dataclasses.replace(plan, chunk_size=store.chunk_size)
        return _in_folder(plan, store, progress, executor, keep_going=keep_going)


def _in_memory(plan: StudyPlan, progress: Progress, command: str | None) -> xr.Dataset:
    document, total = as_plain(document_of(plan, command)), len(plan.cells)
    document["config"]["chunk_size"] = plan.chunk_size
    computed = compute_here(Cells(plan, plan.kind.computation(plan), progress), range(total))
    found = {index: (arrays, document["versions"]) for index, arrays in computed}
    progress(total, total, "done")
    return dataset_of(document, found).assign_attrs(computed_cells=total)


def _in_folder(
    plan: StudyPlan, store: Store, progress: Progress, executor: Executor, *, keep_going: bool
) -> xr.Dataset:
    """Compute and write missing cells; one that cannot be written is kept in memory or ends the run."""
    total = len(plan.cells)
    for index in range(total):  # reject damaged files before computing anything
        store.read(index) if store.has(index) else store.read_part(index)
    cells = Cells(plan, plan.kind.computation(plan), progress, store.checkpoint)
    held: dict[int, tuple[Arrays, dict[str, str]]] = {}
    failed: dict[int, str] = {}
    computed = 0
    unwritten: OSError | None = None
    while missing := [index for index in store.missing if index not in held and index not in failed]:
        cells.done, claimed = total - len(missing), False
        with store.claims() as claim:  # of cells that no other process has claimed or written
            for index, arrays in executor(cells, (each for each in missing if claim(each) and not store.has(each))):
                claimed = True
                if isinstance(arrays, str):
                    failed[index] = arrays
                    continue
                computed += 1
                try:
                    store.record(plan.seen)
                    store.write(index, arrays)
                except OSError as error:
                    if not keep_going:
                        raise
                    unwritten, held[index] = error, (arrays, store.document["versions"])
        if not claimed:
            progress(cells.done, total, "another process computes the rest")
            time.sleep(WAIT_SECONDS)
    progress(total, total, "done")
    dataset = dataset_of(store.document, store.read_all() | held)
    try:
        write_dataset(dataset, store.folder / "results.nc")
    except OSError as error:
        if not keep_going:
            raise
        unwritten = error
    if computed == 0 and (different := differences(store.document["versions"], versions())):
        dataset.attrs["other_versions"] = different
    if unwritten is not None:
        dataset.attrs["unwritten"] = f"cannot write to {store.folder}: {unwritten.strerror or unwritten}"
    if failed:
        dataset.attrs["failed_cells"] = json.dumps({cells.label(index): why for index, why in sorted(failed.items())})
    return dataset.assign_attrs(computed_cells=computed)
