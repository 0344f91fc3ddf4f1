"""A dry run: the cost of a study counted from its plan, with nothing computed or written."""

import dataclasses
import json
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjx_study import cli, runtime
from mjx_study.caches import write_cached
from mjx_study.cli import options
from mjx_study.execution import forecast, times
from mjx_study.execution.forecast import forecast_study
from mjx_study.execution.run import run_study
from mjx_study.experiment.plan import plan_study
from mjx_study.options.configuration import StudyConfig
from mjx_study.runtime import available_cores
from mjx_study.stopwatch import Stopwatch
from mjx_study.table import count, duration, size

DESCENTS = (
    "optimise pusher --reference --horizon 8 --iterations 3 --seeds 2 --samples 4 --evaluation-samples 5 "
    "--estimators zobg,fobg --output"
).split()


@pytest.fixture(autouse=True)
def configured(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    """The process as it is, and no records."""
    monkeypatch.setattr(options, "configure", lambda **_: None)
    folder = tmp_path_factory.mktemp("cache") / "times"
    monkeypatch.setattr(times, "times_folder", lambda: folder)
    monkeypatch.setattr(forecast, "times_folder", lambda: folder)


def test_batches_of_gradients_are_counted() -> None:
    """Of each cell: 3 seeds of 8 values, one baseline and 8 gradients; 10 pairs and 100 candidates of the reference."""
    config = StudyConfig(
        tasks=("pusher",), contact=("penalty",), stiffness=(10.0, 100.0), samples=(8,), seeds=3, horizon=4,
        reference_samples=10,
    )  # fmt: skip
    found = forecast_study(plan_study(config))
    assert (found.cells, found.computed, found.programs) == (2, 0, 2)
    assert found.rollouts == 2 * (3 * (8 + 1 + 8) + 2 * 10 + 100)
    assert found.gradients == 2 * (3 * 8 + 100)


def test_a_sweep_needs_no_folder_to_be_counted(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main("sweep pusher --contact reference --horizon 4 --samples 8 --seeds 1 --dry-run".split()) == 0
    assert "rollouts" in capsys.readouterr().out


def test_points_of_landscapes_are_counted() -> None:
    """5 points of 8 values, a baseline and 8 gradients; 1500 gradients of the quadrature in MJX alone."""
    config = StudyConfig(
        tasks=("ball_wall",), contact=("reference", "mujoco_default"), points=5, samples=(8,),
        stiffness=(1000.0,), estimators=("zobg", "fobg"),
    )  # fmt: skip
    found = forecast_study(plan_study(config))
    assert found.rollouts == 2 * 5 * (8 + 1 + 8) + 1500 and found.gradients == 2 * 5 * 8 + 1500


def test_what_is_forecast_is_what_descents_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Their own count of rollouts, and after that nothing is left to do."""
    folder = tmp_path / "out"
    assert cli.main([*DESCENTS, str(folder), "--dry-run", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert not folder.exists() and (told["cells"], told["computed"], told["programs"]) == (1, 0, 0)
    config = StudyConfig(
        tasks=("pusher",), contact=("reference",), stiffness=(550.0,), horizon=8, iterations=3, seeds=2, samples=(4,),
        evaluation_samples=5, estimators=("zobg", "fobg"),
    )  # fmt: skip
    data = run_study(config, tmp_path / "other")
    assert told["rollouts"] == 2 * 3 * int(np.sum(data["rollouts"])) + (2 * 2 + 1) * 5
    assert told["gradients"] == 2 * 3 * 4 and told["kept"] >= 8 * data["theta"].size

    assert cli.main([*DESCENTS, str(folder)]) == 0
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    capsys.readouterr()
    assert cli.main([*DESCENTS, str(folder), "--dry-run"]) == 0
    assert "cells: 1, 1 computed, 0 to compute\n" in capsys.readouterr().out
    longer = ["5" if part == "3" else part for part in DESCENTS]
    assert cli.main([*longer, str(folder), "--dry-run", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["computed"] == 0
    assert cli.main([*DESCENTS, str(folder), "--dry-run", "--sigma", "0.3"]) == 2
    assert "holds another study" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_the_time_is_what_the_last_run_of_each_program_took(tmp_path: Path) -> None:
    """Records of a run are those of its programs; the forecast of the missing cell is the sum of its calls."""
    config = StudyConfig(
        tasks=("pusher",), contact=("penalty",), stiffness=(50.0, 100.0, 200.0), horizon=2, samples=(8,), seeds=3,
        reference_samples=10, chunk_size=7,
    )  # fmt: skip
    before = forecast_study(plan_study(config), tmp_path)
    assert before.basis[times.ROUGH] == pytest.approx(before.seconds) and before.seconds > before.compilation > 0
    run_study(config, tmp_path)
    assert forecast_study(plan_study(config), tmp_path).seconds == 0
    (tmp_path / "cells" / "00001.npz").unlink()
    found = forecast_study(plan_study(config), tmp_path)
    assert found.computed == 2 and found.basis[times.MEASURED] == pytest.approx(found.seconds)
    records = {each.kind: each for each in times.Rates.read(times.times_folder())._records}
    assert set(records) == {"value", "gradient", "statistics"} and {each.rows for each in records.values()} > {7}
    # on two devices: 25 values with their baseline and 20 of the reference; 24 and 100 gradients
    calls = {"value": 2 + 2, "gradient": 2 + 8, "statistics": 1}
    assert found.seconds - found.compilation == pytest.approx(sum(records[kind].each * n for kind, n in calls.items()))
    assert records["value"].calls == 3 * calls["value"] and records["gradient"].calls == 3 * calls["gradient"] + 8


def test_other_rows_and_steps_are_scaled() -> None:
    """With the overhead of a call; a program of other content, by the rough model and what this machine is to it."""
    rows = times.OVERHEAD["cpu"]
    own = times.Program("value", "a", steps=10, rows=rows, dof=2, constraints=3)
    record = times.Record(**vars(own), each=1.0, calls=5, tracing=2.0, compiling=3.0, versions={})
    rates = times.Rates([record])
    assert rates.call(own) == (1.0, times.MEASURED) and rates.setup(own) == (2.0, 3.0, False, times.MEASURED)
    longer = dataclasses.replace(own, steps=20, rows=3 * rows)
    assert rates.call(longer) == (pytest.approx(4.0), times.SCALED)
    assert rates.setup(longer) == (pytest.approx(2.0), pytest.approx(3.0), False, times.SCALED)
    gradient = dataclasses.replace(own, kind="gradient")
    assert rates.call(gradient) == (pytest.approx(times.FACTORS["gradient"]), times.SCALED)
    other = dataclasses.replace(own, content="b", steps=30)
    assert rates.call(other) == (pytest.approx(3.0), times.ROUGH)
    assert times.Rates([]).call(other) == (pytest.approx(other.rough), times.ROUGH)


def test_figures_are_for_people(capsys: pytest.CaptureFixture[str]) -> None:
    command = "compare pusher --contact penalty,mujoco --stiffness 10:1000:5:log --dry-run"
    assert cli.main(command.split()) == 0
    printed = capsys.readouterr().out
    assert "rollouts: about 21,010, 5,000 of them differentiated\n" in printed
    assert "arrays kept: 72 kB" in printed and "e+" not in printed
    assert [count(7), count(1234567)] == ["7", "1,235,000"]
    assert [size(number) for number in (0, 880, 7630, 2.44e9)] == ["0 bytes", "880 bytes", "7.6 kB", "2.4 GB"]
    told = [duration(number) for number in (0, 0.314, 115, 130, 5400, 8000, 1e7)]
    assert told == ["0 s", "0.31 s", "120 s", "2.2 min", "90 min", "2.2 h", "120 days"]


@pytest.mark.parametrize("damage", [b"", b"{}", b"[1", b'{"each": -1}'])
def test_a_damaged_record_is_no_record(damage: bytes, tmp_path: Path) -> None:
    path = tmp_path / f"x{times.SUFFIX}"
    path.write_bytes(damage)
    assert times.Rates.read(tmp_path)._records == []
    write_cached(path, damage)
    assert times.Rates.read(tmp_path)._records == []


def test_a_cache_that_cannot_be_written_fails_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setattr(times, "times_folder", lambda: tmp_path / "file" / "times")
    config = StudyConfig(
        tasks=("pusher",), contact=("reference",), stiffness=(10.0,), horizon=2, samples=(8,), seeds=3,
        reference_samples=10,
    )  # fmt: skip
    assert run_study(config).attrs["computed_cells"] == 1
    assert times.Rates.read(times.times_folder())._records == []


def test_workers_share_the_cells() -> None:
    """Cells go to the next free worker, and workers here to the cores that there are."""
    assert forecast._side_by_side([3.0, 1.0, 1.0, 2.0], 2) == 4.0 and forecast._side_by_side([], 2) == 0.0
    config = StudyConfig(tasks=("pusher",), contact=("penalty",), stiffness=(1.0, 2.0, 3.0), horizon=4)
    alone, many = (forecast_study(plan_study(config), cluster=f"slurm:{workers}") for workers in (1, 3))
    assert (alone.devices, many.devices) == (1, 3) and alone.compilation == many.compilation
    assert alone.seconds - alone.compilation == pytest.approx(3 * (many.seconds - many.compilation))
    assert forecast_study(plan_study(config), cluster="local:1000").devices <= available_cores()


GRADIENTS: dict[str, Any] = {
    "tasks": ("ball_wall",), "contact": ("mujoco",), "stiffness": (300.0, 1000.0), "horizon": 60
}  # fmt: skip
OTHERS: list[dict[str, Any]] = [
    {"samples": (600,)},
    {"stiffness": (100.0, 200.0, 400.0, 800.0, 1600.0), "seeds": 20},
    {"samples": (30,), "horizon": 200, "seeds": 4},
]


@pytest.mark.slow
def test_the_forecast_is_within_a_factor_of_two(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the processor's time on one device, after a single recorded run of another shape.

    Without compilation, whose time depends on what the cache has.
    """
    monkeypatch.setattr(runtime, "_CORES", [1])
    monkeypatch.setattr(Stopwatch, "clock", staticmethod(time.process_time))
    watches: list[Stopwatch] = []
    monkeypatch.setattr(times, "Stopwatch", lambda: watches.append(Stopwatch()) or watches[-1])
    run_study(StudyConfig(**GRADIENTS))
    kept = times.times_folder()
    assert kept is not None
    ratios = []
    for index, other in enumerate(OTHERS):
        folder = tmp_path / str(index)
        shutil.copytree(kept, folder)
        for module in (times, forecast):
            monkeypatch.setattr(module, "times_folder", lambda folder=folder: folder)
        plan = plan_study(StudyConfig(**GRADIENTS | other))
        found = forecast_study(plan)
        assert found.basis[times.ROUGH] == 0, other
        run_study(plan)
        spent = [each for name, each in watches[-1].spent.items() if name != "descents"]
        calls = sum(each.seconds + each.first_calls * each.each for each in spent)
        ratios.append((found.seconds - found.compilation) / calls)
    assert all(0.5 < ratio < 2 for ratio in ratios), [round(ratio, 2) for ratio in ratios]
