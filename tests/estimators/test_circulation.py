"""The integral of a mean along a path against the difference of F: right, biased, undecided, and with what power."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from estimators import make_estimator
from estimators.mean_check import circulations, path_rule
from mjx_study.reference import Heaviside, function_objective
from tests.estimators import objectives

QUADRATIC = objectives.quadratic(objectives.HESSIAN, 0.3)
START, END = jnp.array([1.0, -1.5, 0.8]), jnp.array([1.6, -2.2, 1.3])


def check(name: str, objective: Any, start=START, end=END, samples: int = 50_000, **options):
    estimator = make_estimator(name, **{"sigma": objective.sigma, "max_norm": 1e9, "window": 99} | options)
    run = jax.jit(lambda key: circulations([estimator], objective, start, end, key, samples, nodes=5)[0])
    return run(jax.random.key(0))


@pytest.mark.parametrize("name", ["zobg", "fobg", "ddcg"])
def test_unbiased_estimators_pass_on_a_smooth_objective(name: str) -> None:
    """A quadratic, whose difference is known; a bias of a tenth would be found."""
    found = check(name, QUADRATIC)
    exact = (END @ objectives.HESSIAN @ END - START @ objectives.HESSIAN @ START) / 2
    assert abs(found.difference - exact) < 0.03 * abs(exact)
    assert 2 * found.half_width < 0.1 * abs(found.difference)
    assert found.verdict(0.1) == "right" and found.num_nonfinite == 0


def test_a_clip_is_found() -> None:
    found = check("fobg_clipped", QUADRATIC, max_norm=1.0)
    assert found.verdict() == "biased"
    assert found.gap * found.difference < 0  # it falls short


def test_a_jump_is_found_without_a_reference_gradient() -> None:
    objective = function_objective(Heaviside(), 0.1)
    ends = jnp.array([-0.05]), jnp.array([0.1])
    both = [make_estimator(name) for name in ("zobg", "fobg")]
    zeroth, first = circulations(both, objective, *ends, jax.random.key(0), 4000)
    assert zeroth.verdict(0.2) == "right" and first.verdict() == "biased" and first.largest == 1.0
    np.testing.assert_allclose(first.gap, -first.difference, rtol=1e-12)


def test_few_samples_with_tiny_gaps_are_right_and_never_biased() -> None:
    found = check("fobg", QUADRATIC)
    size = abs(found.difference)
    few = dataclasses.replace(found, gap=1e-6 * size, standard_error=1e-7 * size, effective=jnp.ones(()))
    for largest, expected in ((1e-5, "right"), (1.0, "undecided")):
        assert dataclasses.replace(few, largest=largest * size).verdict() == expected
    assert dataclasses.replace(few, gap=0.06 * size, largest=0.04 * size).verdict() == "undecided"


def test_few_samples_decide_nothing() -> None:
    assert check("zobg", QUADRATIC, samples=100).verdict() == "undecided"


def test_the_rules_integrate_polynomials() -> None:
    for nodes in (1, 3, 9):
        points, weights, coarse = path_rule(nodes)
        for power in range(2 * nodes):
            assert abs(weights @ points**power - 1 / (power + 1)) < 1e-12
        for power in range((nodes + 1) // 2):
            assert abs(coarse @ points**power - 1 / (power + 1)) < 1e-12


def test_a_path_too_long_for_its_nodes_is_not_judged_right() -> None:
    """The error of the quadrature is part of the interval: five nodes, a wave of many periods."""
    wave = objectives.OneStep(lambda x: jnp.sin(20 * x[0]), 1, 0.02)
    found = check("fobg", wave, jnp.zeros(1), jnp.ones(1), 5000)
    assert found.quadrature > 10 * found.standard_error and found.verdict() == "undecided"
    assert check("fobg", wave, jnp.zeros(1), 0.05 * jnp.ones(1), 5000).verdict() == "right"


def test_meaningless_arguments_are_refused_by_circulation() -> None:
    fobg = make_estimator("fobg")
    with pytest.raises(ValueError, match="nodes must be an odd number; got 4"):
        circulations([fobg], QUADRATIC, START, END, jax.random.key(0), 9, nodes=4)
    with pytest.raises(ValueError, match="num_samples must be at least 2; got 1"):
        circulations([fobg], QUADRATIC, START, END, jax.random.key(0), 1)
