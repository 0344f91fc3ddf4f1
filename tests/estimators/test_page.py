"""The page of the estimators names all of them, and its example is one."""

import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import estimators
from estimators import BASELINES, NOISES
from estimators.registry import markdown_table
from tests.estimators import objectives
from tests.estimators.statistics_helpers import assert_mean_is

PAGE = (Path(__file__).parents[2] / "docs" / "estimators.md").read_text()


def test_the_table_is_that_of_the_classes() -> None:
    assert markdown_table() in PAGE, f"put this table there:\n{markdown_table()}"
    assert all(f"`{name}`" in PAGE for name in (*BASELINES, *NOISES))


def test_the_example_is_an_estimator() -> None:
    """In under thirty lines; run like any other, and right where both of its parents are."""
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    assert len(code.splitlines()) < 30
    module: dict[str, Any] = {"__name__": "my_estimators"}
    exec(code, module)
    objective = objectives.linear([1.0, -2.0], 0.5)  # type: ignore[arg-type]
    found = estimators.estimate(module["SignAgreement"](), objective, jnp.zeros(2), jax.random.key(0), 2000)
    assert_mean_is(found.per_sample + 1e-3 * jax.random.normal(jax.random.key(1), (2000, 2)), [1.0, -2.0])
