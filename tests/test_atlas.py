"""docs/atlas.md states what atlas.npz holds; cells are distinct; planted verdicts and rules are found."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
import pytest

from estimators.confidence import coverage_interval
from experiments import DOCS, read_lines
from experiments.atlas import design, jumps, page, run, table
from experiments.pages import replace_tables
from mjx_study.table import percent
from mjx_study.tasks import make_task

TABLE, OF_LAWS = (table.read(run.RESULTS, laws) for laws in (False, True))


def test_tables_of_the_page_are_those_of_the_file() -> None:
    text = page.PAGE.read_text()
    assert replace_tables(text, page.tables(TABLE, OF_LAWS)) == text
    assert run.RESULTS.stat().st_size < 1.5e6


def _off(part: table.Table, verdict: str = "fobg_off") -> tuple[int, int]:
    """Number of cells with a verdict, and of those decided."""
    return int((part[verdict] == 1).sum()), int(part[verdict].notna().sum())


def _share(part: table.Table, verdict: str = "above") -> str:
    yes, decided = _off(part, verdict)
    return percent(yes / decided)


def _statements() -> list[str]:
    """Sentences of the page that no table holds, with their numbers from the file."""
    met, wide = TABLE[table.bodies_meet(TABLE)], TABLE[table.noise_is_wide(TABLE)]
    forces, (momentum, wall) = TABLE[TABLE.task.isin(table.FORCES)], (TABLE[TABLE.task == n] for n in table.LAUNCHED)
    tenth, third = (
        (lambda t: t[(t.limit > 0.1) & (t.limit < 1 / 3)]),
        (lambda t: t[(t.limit > 0.03) & (t.limit < 1 / 3)]),
    )
    damped = forces[forces.b > 0]
    low = met[(met.task == "momentum_transfer") & (met.jump <= table.SMOOTH_SHARE)]
    smooth = met[(met.task == "ball_wall") & (met.contact == "smooth_onset")]
    soft, stiff = smooth[smooth.stiffness < 5e3], smooth[smooth.stiffness >= 5e3]
    bar = wide[wide.task == "momentum_transfer"]
    inside = bar[(bar.strength >= 0.03) & (bar.strength < 0.8)]
    assert _off(inside, "beyond")[0] == 0 and len(set(_off(bar[bar.strength > 1], "beyond"))) == 1
    jumping = met[(met.jump > table.SMOOTH_SHARE) & (met.slope.abs() > 5 * met.slope_se)]
    largest = jumping.task.map(TABLE.groupby("task").timestep.max())
    alike = jumping[largest**2 * jumping.k + 2 * largest * jumping.b < 4]
    bias = alike.groupby(["task", "timestep"]).fobg_relative.median()
    left = met[(met.fobg_off == 1) & (met.jump > table.SMOOTH_SHARE)].groupby(["task", "timestep"])
    stiffest = TABLE[TABLE.stiffness >= TABLE.groupby("task").stiffness.transform(lambda each: each.quantile(0.75))]
    above = {key: _share(part) for key, part in stiffest.groupby(["task", "timestep"])}
    off = {key: percent(part.fobg_onset_off.dropna().mean()) for key, part in left}
    tennis = met[met.task == "tennis"]
    assert len(set(_off(tennis))) == 1
    return [
        f"on `tennis` {_off(tennis)[1]} of {len(tennis)} cells are decided, all of them off",
        f"{_share(damped[damped.limit < 1 / 3])} of its cells below a third of it are above zeroth order's, "
        f"{_share(damped[(damped.limit > 0.7) & (damped.limit < 1)])} of those between 0.7 and 1",
        f"between a tenth and a third, {_share(tenth(forces[forces.b == 0]))} of its cells are above",
        f"between 0.03 and a third of the limit {_share(third(wall))} of the cells of `ball_wall` are above, and of "
        f"`momentum_transfer` {_share(third(momentum[momentum.b > 0]))} in damped contact and "
        f"{_share(third(momentum[momentum.b == 0]))} in undamped",
        "{} of {} are.".format(*_off(TABLE[TABLE.task == "tennis"], "above")),
        "below 1.1 kN/m {} of {} decided cells are off, ".format(*_off(low[low.stiffness < 1100]))
        + "above 1.5 kN/m {} of {}.".format(*_off(low[low.stiffness >= 1500])),
        "{} of {} cells with a smooth onset below 5 kN/m are off, ".format(*_off(soft))
        + "and {} of {} above".format(*_off(stiff)),
        "{:.2g}, {:.2g} and {:.2g} times the slope on `ball_wall` at 1, 2 and 4 ms, ".format(*bias["ball_wall"])
        + "and {:.2g}, {:.2g} and {:.2g} times on".format(*bias["momentum_transfer"]),
        f"{off['momentum_transfer', 0.004]} of the cells of `momentum_transfer` are off at 4 ms and "
        f"{off['momentum_transfer', 0.001]} at 1 ms, of `ball_wall` {off['ball_wall', 0.004]} and "
        f"{off['ball_wall', 0.001]}.",
        f"in {above['pusher', 0.01]} at 10 ms and in {above['pusher', 0.0025]} at 2.5 ms; of `momentum_transfer` in "
        f"{above['momentum_transfer', 0.004]} at 4 ms and {above['momentum_transfer', 0.001]} at 1 ms.",
        f"it holds in all {_off(inside, 'beyond')[1]} decided cells with a strength between 0.03 and 0.8 and in none "
        f"of the {_off(bar[bar.strength > 1], 'beyond')[1]} above 1",
    ]


def _between(part: table.Table, verdict: str = "above") -> str:
    """Share of a verdict in percent, with its 95 % Wilson interval."""
    middle, low, high = coverage_interval((part[verdict].dropna() == 1).to_numpy(), 0.95)
    return f"{100 * middle:.0f} % ({100 * low:.0f} to {100 * high:.0f} %)"


def _of_laws() -> list[str]:
    """Sentences on contact laws other than MuJoCo's; those on means without numbers are asserted."""
    usual, met = TABLE[TABLE.contact == "mujoco"], OF_LAWS[table.bodies_meet(OF_LAWS)]
    three = ["momentum_transfer", "pusher", "pusher_apart"]
    some, boxes, wall = (met[met.task.isin(names)] for names in (three, ["sliding_box"], ["ball_wall"]))
    off, decided = _off(some, "fobg_off")
    before = usual[table.bodies_meet(usual) & usual.task.isin(three)]
    wrong = some[some.fobg_off == 1]
    assert set(wrong.task) == {"momentum_transfer"} and wrong.stiffness.max() < 800
    assert not set(wrong.contact) & {"log_barrier", "conic"}
    forces, of_usual = (each[each.task.isin(table.FORCES)] for each in (OF_LAWS, usual))
    voigt = forces[(forces.contact == "kelvin_voigt") & (forces.limit > 1)]
    level = OF_LAWS.smoothing / OF_LAWS.contact.map(page.kappa)
    medians = OF_LAWS.ratio.groupby([OF_LAWS.contact, level.round(2)]).median().unstack()
    assert medians.shape == (4, 4) and (medians.max(axis=1) / medians.min(axis=1)).max() < 5
    for _, part in met.groupby("contact"):
        ends = [
            coverage_interval((each.dropna() == 1).to_numpy(), 0.95)
            for _, each in part.fobg_off.groupby(level.round(2))
        ]
        assert len(ends) == 4 and max(low for _, low, _ in ends) < min(high for *_, high in ends)
    return [
        f"off in {off} of {decided} decided cells (0 to 1 %)",
        f"are off in {off} of {decided} decided cells of three tasks;",
        f"off in {off} of {decided} cells of three tasks, where MuJoCo's impedance is in {_share(before, 'fobg_off')} "
        f"of {_off(before)[1]};",
        f"under MuJoCo's `mujoco` in {_between(before, 'fobg_off')} of {_off(before)[1]}.",
        "{} of {} decided cells below 44 N/m are off".format(*_off(boxes[boxes.stiffness < 44]))
        + " and {} of {} above;".format(*_off(boxes[boxes.stiffness >= 44])),
        f"`tennis` decides {_off(met[met.task == 'tennis'])[1]} of {(met.task == 'tennis').sum()}.",
        "above zeroth order's in {} of {} decided cells,".format(*_off(forces, "above"))
        + f" and under `mujoco` in {_between(of_usual)} of {_off(of_usual, 'above')[1]}.",
        f"above in {_between(of_usual[of_usual.limit > 1])} of the decided cells of `mujoco` and in {_between(voigt)} "
        f"of Kelvin-Voigt's {_off(voigt, 'above')[1]},",
        "above in {} of {} on `momentum_transfer`,".format(*_off(OF_LAWS[OF_LAWS.task == "momentum_transfer"], "above"))
        + " and on `ball_wall` in {} of {}.".format(*_off(OF_LAWS[OF_LAWS.task == "ball_wall"], "above")),
        "on `ball_wall` {} of {} decided cells are off at 0.01 kappa,".format(*_off(wall[level[wall.index] < 0.05]))
        + " where a touch is sharpest, and {} of {} at 10 kappa.".format(*_off(wall[level[wall.index] > 5])),
    ]


def _of_jumps() -> list[str]:
    """Sentences on what quadrature says of them."""
    found = jumps.results(OF_LAWS)
    bar, wall = (found[found.task == name] for name in table.LAUNCHED)
    wrong, soft, stiff = wall[wall.fobg_off == 1], wall[wall.stiffness < 8e3], wall[wall.stiffness >= 8e3]
    large, right = wrong[wrong.large], wrong[wrong.verdict == 0]
    turned = large[large.switches == True]  # noqa: E712
    assert bar.unexplained.max() < 0.002 and (bar.verdict == 1).all()
    assert (turned.stiffness.min().round(-2), turned.stiffness.max().round(-2)) == (500, 7300)
    assert (right.stiffness.min().round(-3), right.stiffness.max().round(-3)) == (6e3, 61e3)
    return [
        f"{len(large)} of the {len(wrong)} cells that are off have one large jump, {len(turned)} of these at a change",
        f"{(soft.verdict == 1).sum()} of {len(soft)} decided cells off below 8 kN/m, and "
        f"{(stiff.verdict == 1).sum()} of {len(stiff)} above.",
        f"in each of the {len(bar)} cells",
        f"and in {(wall.verdict == 1).sum()} of {len(wall)} on a wall",
        f"In {len(right)} of the {len(wrong)} the mean is right.",
        f"In {wrong.verdict.isna().sum()} even {jumps.POINTS:,} angles decide nothing. Of all {len(wall)} decided "
        f"cells of `ball_wall`, {(wall.verdict == 1).sum()} are off, and {(wall.verdict == 0).sum()} right.",
    ]


@pytest.mark.parametrize("statements", [_statements, _of_laws, _of_jumps])
def test_sentences_of_the_page_have_numbers_of_the_file(statements: Callable[[], list[str]]) -> None:
    text = " ".join(f"{page.PAGE.read_text()} {(DOCS / 'which-contact.md').read_text()}".split())
    assert not [each for each in statements() if each not in text]


@pytest.mark.slow
@pytest.mark.parametrize("family", ["mujoco", "conic"])
def test_recomputed_cells_have_the_same_numbers(family: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compare medians, since another machine rounds differently, which changes chaotic cells."""
    if family in design.LAWS:
        pytest.importorskip("mujodico", reason="the extra laws is not installed")
    monkeypatch.delenv("XLA_FLAGS", raising=False)  # without optimisation programs round otherwise
    only = ["momentum_transfer at 0.004", "pusher at 0.0025"]
    run.run(tmp_path, 1, 3600.0, run.BLOCK, only, families=(family,))
    found = run.read(tmp_path / run.RESULTS.name)
    kept = (OF_LAWS if family in design.LAWS else TABLE).set_index("index").loc[found["index"]]
    assert len(kept) == len(only) * run.BLOCK and set(kept.contact) == {family}
    names = ["slope", "zobg_variance", "fobg_variance", "fobg_bias"]
    for name in names if family in design.LAWS else [*names, "fobg_onset_bias"]:
        errors = np.abs(found[name] - kept[name]) / np.abs(kept[name])
        some = kept[name] != 0 if name in names else kept.task == "pusher"
        assert errors[some].groupby(kept.program).median().max() <= 2**-run.DIGITS


def test_quadrature_finds_a_planted_jump(monkeypatch: pytest.MonkeyPatch) -> None:
    """f(x) = x + 0.3 [x > 0.13] with noise of 0.1 around 0.1: the slope of its mean is 1 + 0.3 p(0.3) / 0.1."""
    size, at, theta, sigma = 0.3, 0.13, 0.1, 0.1
    cell = dataclasses.replace(next(design.law_cells(0, "conic")), theta=theta, sigma=sigma)

    def line(points: np.ndarray, _: object) -> tuple[np.ndarray, np.ndarray]:
        return points + size * (points > at), np.ones_like(points)

    asked = []
    monkeypatch.setattr(jumps, "switches", lambda task, contact, where: asked.append(where) or True)
    task = make_task("momentum_transfer")
    found = jumps.measured(task, cast(Any, line), cell, cast(Any, None))
    expected = size * np.exp(-0.5 * ((at - theta) / sigma) ** 2) / (np.sqrt(2 * np.pi) * sigma)
    assert found["slope"] == pytest.approx(1 + expected, rel=1e-3) and found["first"] == pytest.approx(1, rel=1e-9)
    for name in ("steep", "jumps", "largest"):
        assert found[name] == pytest.approx(expected, rel=1e-3)
    assert asked == [pytest.approx(at, abs=jumps.NARROW)] and found["switches"]


@pytest.mark.slow
def test_a_ball_that_sinks_into_a_bar_parts_where_another_face_is_nearest() -> None:
    """At the stored jump of a soft bar; elsewhere both sides meet the same faces."""
    pytest.importorskip("mujodico", reason="the extra laws is not installed")
    row = jumps.results(OF_LAWS).query("task == 'momentum_transfer' and large").iloc[0]
    cell = next(each for each in design.law_cells(int(row.program), row.contact) if each.index == row["index"])
    task = design.task_of(*design.PROGRAMS[cell.program])
    contact = design.contact_of(task, cell)
    assert jumps.switches(task, contact, row["at"])
    assert not jumps.switches(task, contact, row["at"] + 1e-4)


def test_the_file_holds_the_cells_of_the_design() -> None:
    np.testing.assert_array_equal(TABLE["index"], np.arange(design.CELLS))
    program = int(TABLE.program.iloc[0])
    cells = {cell.index: cell for cell in design.cells_of(program)}
    for _, row in TABLE[TABLE.program == program].iterrows():
        cell = cells[int(row["index"])]
        for name in ("family", "stiffness", "width", "sigma", "theta"):
            assert row[name] == pytest.approx(getattr(cell, name), rel=2**-run.DIGITS)


def test_the_file_holds_every_cell_of_the_laws() -> None:
    cells = {cell.index: cell for job in run.jobs(design.LAWS) for cell in job.cells(design.LAWS)}
    np.testing.assert_array_equal(OF_LAWS["index"], sorted(cells))
    for name in ("program", "family", "stiffness", "smoothing", "sigma", "theta"):
        expected = [getattr(cells[index], name) for index in OF_LAWS["index"]]
        np.testing.assert_allclose(OF_LAWS[name], expected, rtol=2**-run.DIGITS)
    assert set(jumps.judged(OF_LAWS)["index"]) == {each["index"] for each in read_lines(jumps.JUMPS)}


def test_tables_of_laws_count_planted_verdicts() -> None:
    """Cells of `conic` on the pusher: right, and less noisy than zeroth order, but for a quarter, at kappa / 10."""
    rows = 40
    off = np.arange(rows) % 4 == 0
    cells = TABLE[(TABLE.task == "pusher")].head(rows).assign(contact="conic", meets=True, stable=1.0)
    cells = cells.assign(fobg_off=off.astype(float), above=off.astype(float), ratio=np.where(off, 4.0, 0.5))
    found = page.tables(TABLE, cells.assign(smoothing=np.where(off, 1e-6, 1e-5)))
    for name, expected in (
        ("laws_off", "| - | refused | 25 (14-40; 40) | - | refused | - |"),
        ("laws_variance", "| 0.5 (25 %; 40) |"),
        ("laws_smoothing", "| - | 100 (72-100; 10) | 0 (0-11; 30) | - | - | 4 (100 %; 10) | 0.5 (0 %; 30) | - |"),
    ):
        (row,) = (line for line in found[name].splitlines() if "`conic`" in line)
        assert expected in row


@pytest.mark.parametrize(("threshold", "flipped"), [(0.5, 0.0), (2.0, 0.1)])
def test_planted_accuracy_and_threshold_of_a_rule_are_found(threshold: float, flipped: float) -> None:
    """A share of verdicts is flipped. Standard error of a share: 0.01 at 1000 cells; thresholds are quantiles of 99."""
    rng, size = np.random.default_rng(0), 4000
    group = np.exp(rng.normal(size=size))
    verdict = (group > threshold) ^ (rng.random(size) < flipped)
    cells = pd.DataFrame({"index": np.arange(size), "group": group, "verdict": verdict.astype(float)})
    rule = table.Rule("", "group", threshold, "verdict", lambda cells: cells.group > 0)
    fit, test = table.halves(cells)
    assert not set(fit["index"]) & set(test["index"])
    assert rule.fitted(rule.judged(fit)) == pytest.approx(threshold, rel=0.1)
    expected = (cells.group > threshold).to_numpy()
    holds, holds_not = rule.hits(cells, threshold)
    assert np.mean(holds) == pytest.approx(np.mean(expected[verdict])) and len(holds) + len(holds_not) == len(cells)
    assert np.mean(holds_not) == pytest.approx(np.mean(~expected[~verdict]))
    assert rule.balanced(cells, threshold) > rule.balanced(cells, 4 * threshold) + 0.05


@pytest.mark.parametrize(
    ("bias", "error", "uncertain", "effective", "expected"),
    [
        (0.0, 0.02, 0.01, 30.0, 0.0), (0.5, 0.02, 0.01, 30.0, 1.0), (-0.5, 0.02, 0.01, 30.0, 1.0),
        (0.5, 0.2, 0.01, 30.0, np.nan), (0.5, 0.02, 0.5, 30.0, np.nan), (0.5, 0.02, 0.01, 2.0, np.nan),
        (0.22, 0.02, 0.01, 30.0, np.nan),
    ],
)  # fmt: skip
def test_a_mean_is_off_beyond_both_intervals(bias, error, uncertain, effective, expected):
    columns = {"bias": bias, "bias_se": error, "effective": effective, "lost": 0.0}
    cell = {f"fobg_{name}": [value] for name, value in columns.items()} | {"slope": [-1.0], "slope_se": [uncertain]}
    np.testing.assert_array_equal(table.is_off(pd.DataFrame(cell), "fobg"), [expected])


def test_parts_and_files_are_joined_without_duplicate_cells(tmp_path: Path) -> None:
    """Newer numbers replace older ones, columns are added, and all but NaN, infinity and zero is rounded."""
    thirds = np.array([1, 3, np.nan, np.inf, 0.0]) / 3
    for part, indices in enumerate([[3, 1], [1, 2]]):
        run.write(tmp_path / f"part-{part}.npz", [{"index": np.array(indices, float), "slope": thirds[indices]}])
    assert run.condense(tmp_path) == run.condense(tmp_path) == 3
    path, more = tmp_path / "atlas.npz", tmp_path / "more.npz"
    assert [each.name for each in tmp_path.iterdir()] == [path.name] and len(run.about(path)["environments"]) == 1
    columns = {"index": [1.0, 7.0, 8.0], "slope": [9.0, np.inf, 0.0], "smoothing": [0.5, 0.25, 0.125]}
    arrays = {name: np.array(each) for name, each in columns.items()} | {"environment": np.zeros(3)}
    run.write(more, [arrays], about=run.described(["there"]))
    run.merge(more, path)
    found = run.read(path)
    np.testing.assert_array_equal(found["index"], [1, 2, 3, 7, 8])
    np.testing.assert_allclose(found["slope"], [9, np.nan, np.inf, np.inf, 0], rtol=2**-run.DIGITS)
    np.testing.assert_array_equal(found["smoothing"], [0.5, np.nan, np.nan, 0.25, 0.125])
    np.testing.assert_array_equal(found["environment"], [1, 0, 0, 1, 1])
    assert run.about(path)["environments"][1:] == ["there"]
