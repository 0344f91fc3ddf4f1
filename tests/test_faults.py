"""The page of MJX's faults: each is still there, and cured or not as the page says."""

import math
import re
from pathlib import Path
from typing import Any

import pytest

PAGE = (Path(__file__).parents[1] / "docs" / "gradient-faults.md").read_text()
SECTIONS = dict(re.findall(r"^## (\d+)\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE))
STATES = dict(re.findall(r"^\| \[(\d+)\]\(#\d+\) \|.*\| ([^|]+) \|$", PAGE, re.MULTILINE))
OUTCOMES = dict(re.findall(r"^\| \[(\d+)\]\(#\d+\) \| [^|]+ \| ([^|]+) \|", PAGE, re.MULTILINE))
FAST = ("1", "4")


def code(text: str) -> str:
    (block,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    return block


@pytest.fixture(scope="module")
def shared() -> dict[str, Any]:
    """What the page's first block defines."""
    names: dict[str, Any] = {}
    exec(code(PAGE[: PAGE.index("## 1\n")]), names)
    return names


def test_every_fault_is_in_the_table() -> None:
    assert list(SECTIONS) == [str(index + 1) for index in range(len(SECTIONS))]
    assert set(STATES) == set(SECTIONS)


@pytest.mark.parametrize("number", [pytest.param(n, marks=[] if n in FAST else [pytest.mark.slow]) for n in SECTIONS])
def test_a_fault_is_as_the_page_says(number: str, shared: dict[str, Any]) -> None:
    names = dict(shared)
    exec(code(SECTIONS[number]), names)
    stock, ours, truth = names["stock"], names["ours"], names["truth"]
    assert math.isfinite(truth)
    assert off(stock, truth), f"MJX has this right now ({stock}): say so on the page"
    assert math.isnan(stock) == ("NaN" in OUTCOMES[number]), stock
    assert isinstance(ours, str) == (STATES[number] == "refused"), ours
    if isinstance(ours, float):
        assert off(ours, truth) != STATES[number].startswith("cured"), (stock, ours, truth)


def off(value: float, truth: float) -> bool:
    """Whether a derivative is not the true one, by far more than differences are."""
    return not abs(value - truth) <= 1e-5 * abs(truth) + 1e-9


@pytest.mark.parametrize(("value", "wrong"), [(1.0, False), (1 + 2e-6, False), (0.0, True), (math.nan, True)])
def test_what_counts_as_off(value: float, wrong: bool) -> None:
    assert off(value, 1.0) is wrong


def test_blocks_are_short() -> None:
    for text in SECTIONS.values():
        assert len([line for line in code(text).splitlines() if line]) <= 10
