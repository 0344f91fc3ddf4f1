"""Run studies, in memory or cell by cell in a folder that survives a kill.

A cell is one task, timestep, cone, contact model, sigma and sample count, with all seeds and estimators. It depends on
the configuration alone, not on which cells were computed before it or by whom. Each timestep and cone is compiled
separately; everything else is traced.
"""

import dataclasses
import json
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any, Final

import xarray as xr

from estimators import ENOUGH_EFFECTIVE
from estimators.user_inputs import observing
from mjx_study.execution.cells import Computation
from mjx_study.execution.cluster import cells_on, connected
from mjx_study.execution.lost import lost_samples, total
from mjx_study.execution.times import recording
from mjx_study.experiment.blocks import Arrays
from mjx_study.experiment.checkpoint import Checkpoint
from mjx_study.experiment.plan import StudyPlan, plan_study
from mjx_study.identity import differences, versions
from mjx_study.options.configuration import StudyConfig
from mjx_study.progress import Progress, silent
from mjx_study.storage.dataset import dataset_of, write_dataset
from mjx_study.storage.folder import Store, open_store
from mjx_study.storage.manifest import document_of
from mjx_study.table import as_plain

WAIT_SECONDS: Final = 0.5
"""Interval between polls of cells that another process computes."""


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
        with recording():
            return _Run(plan, progress).in_memory(as_plain(document_of(plan, command)))
    if not isinstance(folder, Store):
        folder = open_store(plan, Path(folder), command, accept_versions=accept_versions)
    with ExitStack() as stack:
        client = stack.enter_context(connected(cluster)) if isinstance(cluster, str) else cluster
        stack.enter_context(recording())
        stack.enter_context(observing(*plan.places))
        return _Run(plan.with_chunk(folder.chunk_size), progress).in_folder(folder, keep_going, client)


class _Run:
    def __init__(self, plan: StudyPlan, progress: Progress):
        self._plan, self._progress, self._total = plan, progress, len(plan.cells)
        self._compute = Computation(plan)
        self._begun: set[Any] = {None}

    def in_memory(self, document: dict[str, Any]) -> xr.Dataset:
        """Compute all cells and write none."""
        document["config"]["chunk_size"] = self._plan.chunk_size
        places = ((index, index) for index in range(self._total))
        cells = {
            index: (found, document["versions"]) for index, found in self._computed(places, lambda index: Checkpoint())
        }
        self._progress(self._total, self._total, "done")
        return dataset_of(document, cells).assign_attrs(computed_cells=self._total)

    def in_folder(self, store: Store, keep_going: bool, client: Any) -> xr.Dataset:
        """Compute and write missing cells; one that cannot be written is kept in memory or ends the run."""
        for index in range(self._total):  # reject damaged files before computing anything
            store.read(index) if store.has(index) else store.read_part(index)
        cells = self._cells_here if client is None else partial(self._cells_there, client)
        computed, held, failed = 0, {}, set()
        unwritten: OSError | None = None
        while missing := [index for index in store.missing if index not in held and index not in failed]:
            claimed = False
            for index, arrays in cells(store, missing):
                claimed = True
                try:
                    if isinstance(arrays, str):
                        failed.add(index)
                        store.write_failure(index, arrays)
                        continue
                    computed += 1
                    store.record(self._plan.seen)
                    store.write(index, arrays)
                except OSError as error:
                    if not keep_going:
                        raise
                    unwritten = error
                    if not isinstance(arrays, str):
                        held[index] = (arrays, store.document["versions"])
            if not claimed:
                self._progress(self._total - len(missing), self._total, "another process computes the rest")
                time.sleep(WAIT_SECONDS)
        self._progress(self._total, self._total, "done")
        dataset = dataset_of(store.document, store.read_all() | held)
        try:
            write_dataset(dataset, store.folder / "results.nc")
        except OSError as error:
            if not keep_going:
                raise
            unwritten = error
        if computed == 0 and (told := differences(store.document["versions"], versions())):
            dataset.attrs["other_versions"] = told
        if unwritten is not None:
            dataset.attrs["unwritten"] = f"cannot write to {store.folder}: {unwritten.strerror or unwritten}"
        if failures := store.failures:
            labels = {self._plan.label(self._plan.cells[index]): reason for index, reason in failures.items()}
            dataset.attrs["failed_cells"] = json.dumps(labels)
        return dataset.assign_attrs(computed_cells=computed)

    def _cells_here(self, store: Store, missing: Sequence[int]) -> Generator[tuple[int, Arrays]]:
        """Compute in this process the cells that no other process has claimed."""
        with store.claims() as claim:
            places = enumerate(missing, self._total - len(missing))
            mine = ((done, index) for done, index in places if claim(index) and not store.has(index))
            yield from self._computed(mine, partial(_part, store))

    def _cells_there(self, client: Any, store: Store, missing: Sequence[int]) -> Generator[tuple[int, Arrays | str]]:
        """Compute on a cluster the cells that no other process has claimed; a failure yields its reason as text."""
        with store.claims() as claim:
            parts = {index: _part(store, index) for index in missing if claim(index) and not store.has(index)}
            done = self._total - len(parts)

            def told(workers: int) -> None:
                self._progress(done, self._total, f"{workers} workers" if workers else "waiting for workers")

            def report(blocks: int, tasks: int, what: str) -> None:
                self._progress(*((blocks, tasks) if self._total == 1 else (done, self._total)), what)

            parts = {index: dataclasses.replace(part, report=report) for index, part in parts.items()}
            for index, arrays in cells_on(client, self._plan, parts, told):
                done += 1
                self._progress(done, self._total, self._plan.label(self._plan.cells[index]))
                yield index, arrays

    def _computed(
        self, places: Iterable[tuple[int, int]], part_of: Callable[[int], Checkpoint]
    ) -> Generator[tuple[int, Arrays]]:
        """Yield indices and numbers of cells; each is begun before waiting for the statistics of the one before.
        `places` are the number of cells done before each, and its index."""

        def end(index: int, begun: Future[Arrays]) -> tuple[int, Arrays]:
            return index, self._compute.end(self._plan.cells[index], begun)

        running: deque[tuple[int, Future[Arrays]]] = deque()
        for done, index in places:
            running.append((index, self._begin(index, done, part_of(index))))
            while len(running) > 1 or (running and running[0][1].done()):
                yield end(*running.popleft())
        for each in running:
            yield end(*each)

    def _begin(self, index: int, done: int, part: Checkpoint) -> Future[Arrays]:
        """Begin a cell, reporting progress in whole cells, or within the cell if it is the only one."""
        cell = self._plan.cells[index]
        label = self._plan.label(cell)
        if (program := self._plan.program_of(cell)) not in self._begun:
            self._begun.add(program)
            label += " (compiling first)"
        self._progress(done, self._total, label)
        within = self._progress if self._total == 1 else lambda *_: self._progress(done, self._total, label)
        return self._compute.begin(cell, dataclasses.replace(part, report=within))


def _part(store: Store, index: int) -> Checkpoint:
    """A cell's checkpoint in its folder; failing to write one must not cost the cell."""

    def keep(arrays: Arrays) -> None:
        with suppress(OSError):
            store.write_part(index, arrays)

    return Checkpoint(store.read_part(index), keep, name=str(store.part_path(index)))


def load_study(folder: str | Path) -> xr.Dataset:
    """Load the numbers of a study, even an unfinished one, as labelled arrays; NaN where missing.

    Dimensions: task, timestep, cone, model (a contact model, with coordinates `contact` for its family and
    `stiffness`), sigma, samples, then seed, estimator, iteration, point and param as far as a variable has them.

    Raises:
        StudyError: there is no study, or a file of it is damaged.
    """
    store = Store.open(Path(folder))
    return dataset_of(store.document, store.read_all())


def warnings_of(dataset: xr.Dataset) -> tuple[str, ...]:
    """Return the warnings of a study's plan and those about its numbers."""
    found = json.loads(dataset.attrs.get("warnings", "[]"))
    if dataset.attrs["missing_cells"]:
        found.append(f"{dataset.attrs['missing_cells']} cells are not computed yet; the same command resumes")
    failed = json.loads(dataset.attrs.get("failed_cells", "{}"))
    found += [f"{label}: failed, {reason}; the same command tries again" for label, reason in failed.items()]
    if dataset.attrs.get("mixed_versions"):
        found.append(f"cells were computed with different versions: {dataset.attrs['mixed_versions']}")
    if told := dataset.attrs.get("other_versions"):
        found.append(f"these numbers were computed with other versions ({told}); use another folder to recompute them")
    counted = {
        "unconverged": "rollouts in which the contact solver did not converge",
        "onsets_missed": "onsets of contact have no term, since their rollouts have too many",
        "onsets_bounded": "onsets of contact are grazing, and their terms are bounded",
    }
    counts = {name: total(dataset[name]) for name in counted if name in dataset}
    found += lost_samples(dataset)
    found += [f"{count} {counted[name]}" for name, count in counts.items() if count]
    if "effective_samples" in dataset and (few := int((dataset["effective_samples"] < ENOUGH_EFFECTIVE).sum())):
        found.append(
            f"{few} batches rest on fewer than {ENOUGH_EFFECTIVE:g} effective samples: do not trust their errors, "
            "p-values and variances (marked ? in the table of compare, effective_samples in the data)"
        )
    if "stopped_at" in dataset and (stopped := int(dataset["stopped_at"].notnull().sum())):
        found.append(f"{stopped} descents stopped before their last iteration")
    return tuple(found)
