"""Gradients of more samples than are held at once: in blocks, whose merged statistics are those of the whole batch."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax
import numpy as np
import psutil
import pytest

from mjx_study import cli
from mjx_study.execution import cells
from mjx_study.execution.cluster import TRIES
from mjx_study.execution.run import run_study
from mjx_study.experiment import gradients
from mjx_study.experiment.gradients import GradientComputation, block_of, blocks_of
from mjx_study.experiment.merged_samples import Blocks
from mjx_study.experiment.plan import plan_study
from mjx_study.experiment.sampling import cell_keys, sample_keys
from mjx_study.experiment.study import Arrays, Checkpoint, StudyPlan
from mjx_study.options.configuration import StudyConfig
from mjx_study.progress import silent
from mjx_study.storage.arrays import CellFile
from mjx_study.storage.folder import Store, load_study, open_store
from tests.documents import MEASURED, numbers_of, same
from tests.poison import ACCOUNT, RAISE, SLOW

SUBSTITUTES = {"bias_p_value", "variance_lower", "variance_upper"}
"""Variables that only rows tell to rounding; the first test of numbers has by how much they differ. Those of norms are
exact up to 16,384 samples."""


def config(**changes: Any) -> StudyConfig:
    common: dict[str, Any] = {"tasks": ("pusher",), "contact": ("reference",), "stiffness": (100.0,), "horizon": 4}
    common |= {"estimators": ("zobg", "fobg", "aobg"), "samples": (40,), "block_size": 8}
    common |= {"seeds": 2, "reference_samples": 20}
    return StudyConfig(**(common | changes))


def planned(**changes: Any) -> StudyPlan:
    return plan_study(config(**changes))


def test_keys_follow_from_the_index_alone() -> None:
    """The 10 million-th as well: no other is drawn, and batches that fit have the keys that they always had."""
    key = jax.random.key(7)
    split = jax.random.key_data(jax.random.split(key, 5000))
    np.testing.assert_array_equal(jax.random.key_data(sample_keys(jax.random.clone(key), 0, 5000)), split)
    np.testing.assert_array_equal(jax.random.key_data(sample_keys(jax.random.clone(key), 4321, 7)), split[4321:4328])
    last = jax.random.key_data(sample_keys(jax.random.clone(key), 9_999_990, 10))
    assert len(np.unique(np.concatenate([split, last]), axis=0)) == 5010


def test_blocks_give_the_numbers_of_the_batch() -> None:
    """Of 4096 samples in eight blocks, every variable."""
    estimators = ("zobg", "zobg_antithetic", "fobg", "fobg_clipped", "fobg_truncated", "aobg", "ivw")
    changes: dict[str, Any] = {"samples": (4096,), "estimators": estimators, "max_norm": 50.0, "window": 2}
    whole, blocks = planned(**changes, block_size=None), planned(**changes, block_size=512)
    assert blocks_of(whole, whole.cells[0]) == 1 and blocks_of(blocks, blocks.cells[0]) == 8
    expected, found = (numbers_of(plan) for plan in (whole, blocks))
    assert set(found) == set(expected) > SUBSTITUTES
    for name in set(expected) - SUBSTITUTES - set(MEASURED):
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-11, err_msg=name)
    width = np.log(expected["variance_upper"] / expected["variance_lower"])
    for end in ("variance_lower", "variance_upper"):
        assert np.all(np.abs(np.log(found[end] / expected[end])) < 1e-3 * width)
    # Shares of 999 other draws: five standard errors of the difference of two.
    middle = (found["bias_p_value"] + expected["bias_p_value"]) / 2
    error = np.sqrt(2 * middle * (1 - middle) / 999) + 1e-3
    assert np.all(np.abs(found["bias_p_value"] - expected["bias_p_value"]) < 5 * error)
    assert np.all(found["seconds_per_sample"] > 0)


@pytest.fixture(scope="module")
def cell() -> tuple[GradientComputation, StudyPlan, dict[int, Arrays]]:
    """Eleven blocks, of a single seed, and what each work unit finds."""
    plan = planned(samples=(84,), seeds=1)
    computation = GradientComputation(plan)
    assert blocks_of(plan, plan.cells[0]) == 11
    units = {unit: computation.compute(plan.cells[0], unit, Checkpoint()).result() for unit in range(12)}
    return computation, plan, units


def in_order(computed: Any, order: Any, *, kept: bool = False) -> Blocks:
    computation, plan, arrays = computed

    def begin(kept: Arrays) -> Blocks:
        work = computation.begin(plan.cells[0], Checkpoint({name: array.copy() for name, array in kept.items()}))
        assert isinstance(work, Blocks)
        return work

    blocks = begin({})
    for unit in order:
        blocks.add(int(unit), arrays[int(unit)])
        if kept:
            blocks = begin(blocks.arrays())
    return blocks


def test_not_a_bit_depends_on_the_order_or_on_checkpoints(cell: Any) -> None:
    expected = in_order(cell, range(12))
    rng = np.random.default_rng(0)
    for _ in range(20):
        found = in_order(cell, rng.permutation(12), kept=True)
        same_bits = jax.tree.map(lambda one, other: one.tobytes() == other.tobytes(), found.arrays(), expected.arrays())
        assert not found.missing and all(same_bits.values())
    jax.tree.map(np.testing.assert_array_equal, found.numbers(), expected.numbers())


def test_checkpoints_are_written_now_and_then_and_read_once(
    cell: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of eleven blocks and a reference, each is finished at once."""
    computation, plan, units = cell
    saved: list[Arrays] = []
    for seconds, count in ((20.0, 0), (0.0, 11)):
        monkeypatch.setattr(cells, "SAVE_SECONDS", seconds)
        begun = cells.Cells(plan, computation, silent, lambda *_: Checkpoint(save=saved.append))
        finished = [begun.finish(0, unit, units[unit]) is not None for unit in begun.begin(0)]
        assert finished == [False] * 11 + [True] and len(saved) == count
    read: list[Path] = []
    read_file = CellFile.read
    monkeypatch.setattr(CellFile, "read", lambda file, *check: read.append(file.path) or read_file(file, *check))
    store = open_store(plan, tmp_path)
    for _ in range(2):
        checkpoint = store.checkpoint(0, silent)
        for arrays in saved[:3]:
            checkpoint.save(arrays)
    assert read == [store.part_path(0)]


def test_a_study_in_blocks_goes_on_where_it_was_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stopped in the fourth block: the other process computes the rest, to the same bits."""
    done: list[int] = []
    compute = GradientComputation.compute

    def stopping(self: GradientComputation, cell: Any, unit: int, checkpoint: Checkpoint) -> Any:
        if len(done) == 4:
            raise KeyboardInterrupt
        done.append(unit)
        return compute(self, cell, unit, checkpoint)

    monkeypatch.setattr(GradientComputation, "compute", stopping)
    monkeypatch.setattr(cells, "SAVE_SECONDS", 0.0)
    with pytest.raises(KeyboardInterrupt):
        run_study(config(), tmp_path / "study")
    assert done == [0, 1, 2, 3] and len(list((tmp_path / "study" / "cells").glob("*.part.npz"))) == 1
    rest: list[int] = []
    resumed = lambda self, cell, unit, kept: rest.append(unit) or compute(self, cell, unit, kept)  # noqa: E731
    monkeypatch.setattr(GradientComputation, "compute", resumed)
    told: list[str] = []
    found = run_study(config(), tmp_path / "study", lambda done, total, what: told.append(f"{done} of {total}: {what}"))
    assert rest == list(range(4, 11)) and not list((tmp_path / "study" / "cells").glob("*.part.npz"))
    assert any(line.startswith("5 of 11: pusher, ") and line.endswith("N = 40, in blocks") for line in told)
    assert same(found, run_study(config()))


def test_what_needs_whole_batches_is_refused() -> None:
    able = "batches of any size are for zobg, zobg_antithetic, .*, aobg, .*ivw, without leave_one_out and cross_fitted$"
    with pytest.raises(
        ValueError,
        match=f"^`block_size` splits batches, and ivw_h, total_propagation must have whole ones: omit it; {able}",
    ):
        planned(estimators=("zobg", "ivw_h", "total_propagation"))
    for changes in ({"baseline": "leave_one_out"}, {"weights": "cross_fitted", "estimators": ("ivw",)}):
        with pytest.raises(ValueError, match="`block_size` splits batches"):
            planned(**changes)
    large: dict[str, Any] = {"samples": (10_000_000,), "block_size": None}
    with pytest.raises(ValueError, match=f"and more seeds; or omit delta: {able}"):
        planned(**large, estimators=("zobg", "delta"))


def test_ten_million_samples_are_planned_in_blocks() -> None:
    """Whatever fits comes whole, as before; the memory of what does not fit is that of a block."""
    plans = [planned(samples=(samples,), block_size=None) for samples in (400, 1_000_000, 5_000_000, 10_000_000)]
    assert [blocks_of(plan, plan.cells[0]) for plan in plans] == [1, 1, 250, 500]
    assert plans[2].memory <= plans[3].memory < 1.01 * plans[2].memory < 5e8 < plans[1].memory
    wide = planned(samples=(10_000_000,), block_size=None, horizon=2000)
    assert 2 <= block_of(wide, wide.cells[0]) < 20_000 and block_of(wide, wide.cells[0]) % 2 == 0


def test_the_first_samples_pick_the_control_variate(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a batch of any size, and whether or not it comes in blocks."""
    sizes: list[int] = []
    reference_of = gradients.reference_of
    monkeypatch.setattr(gradients, "PILOT", 12)
    monkeypatch.setattr(
        gradients, "reference_of", lambda *args: sizes.append(len(args[3].value)) or reference_of(*args)
    )
    found = [numbers_of(plan)["reference"] for plan in (planned(), planned(block_size=None))]
    assert sizes == [12, 12]
    np.testing.assert_allclose(found[0], found[1], rtol=1e-13)


@pytest.mark.slow
def test_a_block_that_fails_takes_its_cell_with_it_and_no_other(workers: Any, tmp_path: Path) -> None:
    """Each of its tasks is begun at most three times, and when one is for the third, the others are dropped."""
    asked = config(tasks=("tests.poison:poison",), stiffness=(RAISE, SLOW), samples=(16,), horizon=None)
    found = run_study(asked, tmp_path, cluster=workers)
    assert found.attrs["computed_cells"] == 1 == found.attrs["missing_cells"]
    assert list(json.loads(found.attrs["failed_cells"]).values()) == ["MemoryError: no memory for the batch"]
    account = Path(workers.submit(os.environ.get, ACCOUNT, pure=False).result()).read_text().split()
    assert TRIES <= account.count(str(RAISE)) < 5 * TRIES


ARGUMENTS = ["compare", "pusher", "--contact", "reference", "--stiffness", "100", "--horizon", "4", "--samples", "4000",
             "--block-size", "20", "--estimators", "zobg,fobg,aobg", "--reference-samples", "20"]  # fmt: skip


SAVING = "from mjx_study import cli; from mjx_study.execution import cells; cells.SAVE_SECONDS = 0; exit(cli.main())"


@pytest.mark.slow
@pytest.mark.parametrize("cluster", [[], ["--cluster", "local:2"]])
def test_a_killed_command_goes_on_to_the_same_data(cluster: list[str], tmp_path: Path) -> None:
    """The command itself, killed by SIGKILL after its fifth block."""
    command = [sys.executable, "-c", SAVING, *ARGUMENTS, *cluster, "--output"]
    folder = tmp_path / "out"
    running = subprocess.Popen([*command, str(folder)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    part = folder / "cells" / "00000.part.npz"
    seen: set[int] = set()
    while len(seen) < 5:
        assert running.poll() is None, running.communicate()[1]
        with suppress(FileNotFoundError):
            seen.add(part.stat().st_mtime_ns)
        time.sleep(0.005)
    children = psutil.Process(running.pid).children(recursive=True)
    running.send_signal(signal.SIGKILL)
    running.communicate()
    assert not psutil.wait_procs(children, timeout=60)[1], "its workers live on"
    assert 0 < len(Blocks(1, 200, Store.open(folder).read_part(0)).missing) < 198
    last = subprocess.run([*command, str(folder)], capture_output=True, text=True)
    assert last.returncode == 0 and "distributed" not in last.stderr, last.stderr
    assert cli.main([*ARGUMENTS, "--output", str(tmp_path / "undisturbed")]) == 0
    assert same(load_study(folder), load_study(tmp_path / "undisturbed"))


def test_keys_of_few_seeds_are_the_first_of_many() -> None:
    few, many = (cell_keys(3, seeds) for seeds in (2, 40))
    zeroth, first, *_, test = jax.random.split(jax.random.key(3), 5)
    for found, all_of, stream in zip(
        (*few["order"], few["tests"]), (*many["order"], many["tests"]), (zeroth, first, test), strict=True
    ):
        data = jax.random.key_data(jax.random.split(stream, 2))
        np.testing.assert_array_equal(jax.random.key_data(found), data)
        np.testing.assert_array_equal(np.asarray(jax.random.key_data(all_of))[:2], data)
