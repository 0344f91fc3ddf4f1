"""docs/atlas.md states what atlas.npz holds; cells are distinct; planted verdicts and rules are found."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from experiments.atlas import measure as atlas
from experiments.atlas import page
from mjx_study.table import percent

TABLE = page.read(atlas.RESULTS)


def test_the_page_says_what_the_file_says() -> None:
    text = page.PAGE.read_text()
    assert page.written(text, TABLE) == text
    assert atlas.RESULTS.stat().st_size < 1.5e6


def _off(part: page.Table, verdict: str = "fobg_off") -> tuple[int, int]:
    """Cells with a verdict, and those decided."""
    return int((part[verdict] == 1).sum()), int(part[verdict].notna().sum())


def _share(part: page.Table, verdict: str = "above") -> str:
    yes, decided = _off(part, verdict)
    return percent(yes / decided)


def _statements() -> list[str]:
    """Sentences of the page that no table holds, with their numbers from the file."""
    met, wide = TABLE[page._met(TABLE)], TABLE[page._wide(TABLE)]
    forces, (momentum, wall) = TABLE[TABLE.task.isin(page.FORCES)], (TABLE[TABLE.task == n] for n in page.LAUNCHED)
    tenth, third = (
        (lambda t: t[(t.limit > 0.1) & (t.limit < 1 / 3)]),
        (lambda t: t[(t.limit > 0.03) & (t.limit < 1 / 3)]),
    )
    damped = forces[forces.b > 0]
    low = met[(met.task == "momentum_transfer") & (met.strength <= page.SMOOTH_SHARE)]
    smooth = met[(met.task == "ball_wall") & (met.contact == "smooth_onset")]
    soft, stiff = smooth[smooth.stiffness < 5e3], smooth[smooth.stiffness >= 5e3]
    bar = wide[wide.task == "momentum_transfer"]
    inside = bar[(bar.strength >= 0.03) & (bar.strength < 0.8)]
    assert _off(inside, "beyond")[0] == 0 and len(set(_off(bar[bar.strength > 1], "beyond"))) == 1
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
        f"it holds in all {_off(inside, 'beyond')[1]} decided cells with a strength between 0.03 and 0.8 and in none "
        f"of the {_off(bar[bar.strength > 1], 'beyond')[1]} above 1",
    ]


def test_sentences_of_the_page_have_the_numbers_of_the_file() -> None:
    text = " ".join(page.PAGE.read_text().split())
    assert not [each for each in _statements() if each not in text]


@pytest.mark.slow
def test_cells_are_computed_again_with_the_same_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another machine rounds otherwise, which changes chaotic cells, so the median is compared."""
    monkeypatch.delenv("XLA_FLAGS", raising=False)  # without optimisation programs round otherwise
    atlas.run(tmp_path, 1, 3600.0, atlas.BLOCK, ["momentum_transfer at 0.004", "pusher at 0.0025"])
    found = atlas.read(tmp_path / atlas.RESULTS.name)
    kept = TABLE.set_index("index").loc[found["index"]]
    assert len(kept) == 2 * atlas.BLOCK
    for name in ("slope", "zobg_variance", "fobg_variance", "fobg_bias", "fobg_onset_bias"):
        errors = np.abs(found[name] - kept[name]) / np.abs(kept[name])
        assert errors[kept[name] != 0].groupby(kept.program).median().max() <= 2**-atlas.DIGITS


@pytest.mark.slow
def test_no_two_cells_share_a_contact_model_a_sigma_or_a_theta() -> None:
    cells = [cell for program in range(len(atlas.PROGRAMS)) for cell in atlas.cells_of(program)]
    assert len(cells) == atlas.CELLS >= 10_000
    assert [cell.index for cell in cells] == list(range(len(cells)))
    for names in (("stiffness",), ("program", "sigma"), ("program", "theta")):
        assert len({tuple(getattr(cell, name) for name in names) for cell in cells}) > 0.999 * len(cells)


def test_the_file_holds_the_cells_of_the_design() -> None:
    np.testing.assert_array_equal(TABLE["index"], np.arange(atlas.CELLS))
    program = int(TABLE.program.iloc[0])
    cells = {cell.index: cell for cell in atlas.cells_of(program)}
    for _, row in TABLE[TABLE.program == program].iterrows():
        cell = cells[int(row["index"])]
        for name in ("family", "stiffness", "width", "sigma", "theta"):
            assert row[name] == pytest.approx(getattr(cell, name), rel=2**-atlas.DIGITS)


def test_parts_are_joined_and_a_cell_that_was_computed_twice_is_kept_once(tmp_path: Path) -> None:
    for part, indices in enumerate([[3, 1], [1, 2]]):
        columns = {"index": np.array(indices, float), "slope": np.array(indices) / 3}
        atlas.write(tmp_path / f"part-{part}.npz", [columns])
    assert atlas.condense(tmp_path) == 3
    assert [path.name for path in tmp_path.iterdir()] == ["atlas.npz"]
    assert atlas.condense(tmp_path) == 3 and len(atlas.about(tmp_path / "atlas.npz")["environments"]) == 1
    found = atlas.read(tmp_path / "atlas.npz")
    np.testing.assert_array_equal(found["index"], [1, 2, 3])
    np.testing.assert_array_equal(found["environment"], 0)
    np.testing.assert_allclose(found["slope"], np.array([1, 2, 3]) / 3, rtol=2**-atlas.DIGITS)


def test_rounding_keeps_what_is_no_number() -> None:
    np.testing.assert_array_equal(atlas.rounded(np.array([np.nan, np.inf, -np.inf, 0.0])), [np.nan, np.inf, -np.inf, 0])


def planted(threshold: float, flipped: float, size: int = 4000) -> page.Table:
    """Cells whose verdict is 1 above a threshold, but for a share of them."""
    rng = np.random.default_rng(0)
    group = np.exp(rng.normal(size=size))
    verdict = (group > threshold) ^ (rng.random(size) < flipped)
    table = pd.DataFrame({"index": np.arange(size), "group": group, "verdict": verdict.astype(float)})
    table.attrs["families"] = ["one"]
    return table


@pytest.mark.parametrize(("threshold", "flipped"), [(0.5, 0.0), (2.0, 0.1)])
def test_a_rule_is_as_often_right_as_planted_and_its_threshold_is_found(threshold: float, flipped: float) -> None:
    """Standard error of a share: 0.01 at 1000 cells; the threshold is one of 99 quantiles."""
    table = planted(threshold, flipped)
    rule = page.Rule("", "group", threshold, "verdict", lambda table: table.group > 0)
    fit, test = page.halves(table)
    assert not set(fit["index"]) & set(test["index"])
    assert rule.fitted(rule.judged(fit)) == pytest.approx(threshold, rel=0.1)
    expected = (table.group > threshold).to_numpy()
    verdict = (table.verdict == 1).to_numpy()
    holds, holds_not = rule.hits(table, threshold)
    assert np.mean(holds) == pytest.approx(np.mean(expected[verdict])) and len(holds) + len(holds_not) == len(table)
    assert np.mean(holds_not) == pytest.approx(np.mean(~expected[~verdict]))
    assert rule.balanced(table, threshold) > rule.balanced(table, 4 * threshold) + 0.05


@pytest.mark.parametrize(
    ("bias", "error", "uncertain", "effective", "expected"),
    [
        (0.0, 0.02, 0.01, 30.0, 0.0),
        (0.5, 0.02, 0.01, 30.0, 1.0),
        (-0.5, 0.02, 0.01, 30.0, 1.0),
        (0.5, 0.2, 0.01, 30.0, np.nan),
        (0.5, 0.02, 0.5, 30.0, np.nan),
        (0.5, 0.02, 0.01, 2.0, np.nan),
        (0.22, 0.02, 0.01, 30.0, np.nan),
    ],
)
def test_a_mean_is_off_where_its_interval_and_the_reference_s_say_so(bias, error, uncertain, effective, expected):
    columns = {"bias": bias, "bias_se": error, "effective": effective, "lost": 0.0}
    cell = {f"fobg_{name}": [value] for name, value in columns.items()} | {"slope": [-1.0], "slope_se": [uncertain]}
    np.testing.assert_array_equal(page._off(pd.DataFrame(cell), "fobg"), [expected])
