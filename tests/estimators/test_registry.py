"""Running estimators by name: oracles, keys, sharing, precision, transformations, refusals; and their page."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

import estimators
from estimators import (
    BASELINES,
    ESTIMATORS,
    NOISES,
    ORACLES,
    AlphaOrder,
    Differentiation,
    Estimator,
    Evaluation,
    GradientEstimate,
    Objective,
    draw,
    estimate,
    make_estimator,
)
from estimators.registry import markdown_table
from tests.estimators import objectives

PAGE = (Path(__file__).parents[2] / "docs" / "estimators.md").read_text()

# Compiled whole: a fraction of the time of compiling operation by operation.
leave_one_out = jax.jit(estimators.leave_one_out)

HESSIAN = np.array([[1.0, 0.4], [0.4, 0.5]])
OBJECTIVE = objectives.quadratic(HESSIAN, 0.5)
THETA = np.array([1.5, -2.0])
OPTIONS: dict[str, Any] = {"gamma": 50.0, "failure_probability": 0.1, "sigma": 0.5}


def made(name: str, **changes: Any) -> Estimator:
    return make_estimator(name, **vars(ESTIMATORS[name].example()) | OPTIONS | changes)


class Spy:
    """Records the keys that each oracle is given."""

    num_params = 2

    def __init__(self) -> None:
        self.calls: list[tuple[str, np.ndarray]] = []
        # attributes of the instance: from Python 3.12 on a runtime protocol does not ask __getattr__
        for method in {oracle.method for oracle in ORACLES.values()}:
            setattr(self, method, self.recorder(method))

    def recorder(self, name: str) -> Callable[[Array, Array], Any]:
        def call(theta: Array, keys: Array) -> Any:
            self.calls.append((name, np.asarray(jax.random.key_data(jax.random.clone(keys)))))
            return getattr(OBJECTIVE, name)(theta, keys)

        return call


@pytest.mark.parametrize("name", ESTIMATORS)
def test_every_estimator_calls_the_oracles_that_it_names_with_independent_keys(name: str):
    spy = Spy()
    estimate(made(name), cast(Objective, spy), jnp.asarray(THETA), jax.random.key(0), 20)
    needs = [ORACLES[oracle] for oracle in ESTIMATORS[name].needs]
    assert [called for called, _ in spy.calls] == [oracle.method for oracle in needs]
    keys = np.concatenate([drawn for _, drawn in spy.calls])
    assert len(np.unique(keys, axis=0)) == 20 * len({oracle.order for oracle in needs})
    batches = draw(tuple(oracle.name for oracle in needs), OBJECTIVE, jnp.asarray(THETA), jax.random.key(0), 20)
    np.testing.assert_array_equal(
        made(name)(batches).mean, estimate(made(name), OBJECTIVE, jnp.asarray(THETA), jax.random.key(0), 20).mean
    )


def test_estimators_and_oracles_describe_themselves():
    for name, entry in ESTIMATORS.items():
        assert issubclass(entry, Estimator) and entry.name == name and entry.description and entry.label
        assert entry.formula and entry.unbiased and isinstance(entry.example(), entry)
        assert isinstance(made(name), entry) and made(name) == made(name) and hash(made(name)) == hash(made(name))
    for name, oracle in ORACLES.items():
        assert oracle.name == name and oracle.order in (0, 1)


def drawn(estimator: Estimator) -> GradientEstimate:
    return jax.jit(lambda theta: estimate(estimator, OBJECTIVE, theta, jax.random.key(2), 200))(jnp.asarray(THETA))


def shared() -> dict[str, GradientEstimate]:
    return {name: drawn(made(name)) for name in ("zobg", "fobg", "aobg", "ivw")}


def test_estimators_share_batches_given_the_same_key():
    estimates = shared()
    zeroth, first = estimates["zobg"], estimates["fobg"]
    for name in ("aobg", "ivw"):
        choice = estimates[name].alpha
        assert choice is not None and 0.0 < choice.alpha < 1.0
        expected = choice.alpha * first.mean + (1.0 - choice.alpha) * zeroth.mean
        np.testing.assert_allclose(estimates[name].mean, expected, rtol=1e-14)
    assert zeroth.alpha is None and first.alpha is None


def test_ivw_is_aobg_without_a_limit():
    unlimited = drawn(AlphaOrder())
    ivw = drawn(made("ivw", gamma=1e-9))
    np.testing.assert_array_equal(unlimited.mean, ivw.mean)
    assert unlimited.alpha is not None and unlimited.alpha.alpha > 0.5
    zeroth = drawn(AlphaOrder(gamma=1e-9))
    np.testing.assert_array_equal(zeroth.mean, drawn(made("zobg")).mean)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_precision_is_the_callers_under_jit(dtype: type):
    chosen = [*map(made, ESTIMATORS), made("zobg", baseline="none"), made("zobg_to_go", baseline="leave_one_out")]

    @jax.jit
    def run(theta: Array, key: Array) -> list[GradientEstimate]:
        return [estimate(each, OBJECTIVE, theta, jax.random.clone(key), 50) for each in chosen]

    for each, found in zip(chosen, run(jnp.asarray(THETA, dtype), jax.random.key(3)), strict=True):
        for leaf in jax.tree.leaves(found):
            assert leaf.dtype == dtype or jnp.issubdtype(leaf.dtype, jnp.integer), each
            assert np.all(np.isfinite(leaf)), each


def test_estimates_can_be_mapped_over_parameters():
    thetas = jnp.asarray(np.stack([THETA, -THETA, 2 * THETA]))
    keys = jax.random.split(jax.random.key(4), 3)

    def run(theta: Array, key: Array) -> GradientEstimate:
        return estimate(AlphaOrder(gamma=50.0), OBJECTIVE, theta, key, 30)

    mapped = jax.jit(jax.vmap(run))(thetas, jax.random.clone(keys))
    assert mapped.per_sample.shape == (3, 30, 2)
    np.testing.assert_array_equal(mapped.num_nonfinite, [0, 0, 0])
    np.testing.assert_allclose(mapped.mean[1], run(thetas[1], keys[1]).mean, rtol=1e-12)
    shapes = jax.eval_shape(run, thetas[0], jax.random.key(0))
    assert shapes.mean.shape == (2,)
    assert jax.tree.map(lambda leaf: None, mapped).alpha.alpha is None


@jax.jit
def lossy_batches() -> tuple[Evaluation, Differentiation]:
    """100 samples each; three values lost, and one gradient of a finite value."""
    theta = jnp.asarray(THETA)
    first_keys, zeroth_keys = jax.random.split(jax.random.key(6), (2, 100))
    zeroth, first = OBJECTIVE.evaluate(theta, zeroth_keys), OBJECTIVE.differentiate(theta, first_keys)
    lost = jnp.array([5, 6, 90])
    return (
        replace(zeroth, value=zeroth.value.at[lost].set(jnp.nan)),
        replace(first, value=first.value.at[lost].set(jnp.inf), gradient=first.gradient.at[7, 0].set(jnp.nan)),
    )


@pytest.mark.parametrize(("name", "lost"), [("zobg", 3), ("fobg", 4), ("aobg", 4)])
@pytest.mark.parametrize("baseline", ["zero_noise", "leave_one_out"])
def test_lost_samples_are_counted_and_do_not_spoil_the_rest(name: str, lost: int, baseline: str):
    zeroth, first = lossy_batches()
    batches = {"evaluation": zeroth, "differentiation": first}
    result = jax.jit(made(name, baseline=baseline))(batches)
    assert result.num_nonfinite == lost
    for leaf in (result.mean, result.variance, result.standard_error):
        assert np.all(np.isfinite(leaf))


def test_leave_one_out_is_the_mean_of_the_other_finite_values():
    zeroth, _ = lossy_batches()
    value = np.asarray(zeroth.value)
    baseline = np.asarray(leave_one_out(zeroth))
    for sample in (0, 5, 50):
        np.testing.assert_allclose(baseline[sample], np.nanmean(np.delete(value, sample)), rtol=1e-13)
    alone = Evaluation(jnp.array([2.0, jnp.nan]), jnp.ones((2, 1)), jnp.zeros(2))
    np.testing.assert_array_equal(leave_one_out(alone), [0.0, 2.0])


class _Bare:
    """An objective with the two methods that every one has."""

    num_params = 2
    evaluate, differentiate = OBJECTIVE.evaluate, OBJECTIVE.differentiate


def test_missing_batches_and_impossible_sizes_are_refused():
    zeroth, first = lossy_batches()
    for name in ("zobg", "aobg", "ivw"):
        with pytest.raises(
            ValueError, match=f"'{name}' needs a zeroth-order batch of values; .*evaluate.*'evaluation'"
        ):
            made(name)({"differentiation": first})
    for name in ("fobg", "aobg", "ivw"):
        with pytest.raises(ValueError, match=f"'{name}' needs a first-order batch"):
            made(name)({"evaluation": zeroth, "differentiation": None})
    for name, option in (("fobg_clipped", "max_norm"), ("fobg_truncated", "window"), ("ddcg", "sigma")):
        with pytest.raises(ValueError, match=f"'{name}' needs the option `{option}`; set it"):
            made(name, **{option: None})
        with pytest.raises(ValueError, match=f"'{name}' needs the option `{option}`; set it"):
            estimate(name, OBJECTIVE, jnp.asarray(THETA), jax.random.key(0), 9)
    with pytest.raises(ValueError, match="_Bare has no method evaluate_pair for a zeroth-order batch of pairs"):
        estimate("zobg_antithetic", _Bare(), jnp.asarray(THETA), jax.random.key(0), 9)
    with pytest.raises(ValueError, match="at least 1, .* got 0"):
        estimate("zobg", OBJECTIVE, jnp.asarray(THETA), jax.random.key(0), 0)
    with pytest.raises(ValueError, match=r"shape \(2,\), the objective's; got \(3,\)"):
        estimate("zobg", OBJECTIVE, jnp.ones(3), jax.random.key(0), 10)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("zobg", {"baseline": "mean"}, "unknown baseline 'mean'; choose from none, zero_noise, leave_one_out"),
        ("aobg", {"gamma": 0.0}, "gamma must be positive; got 0.0"),
        ("aobg", {"gamma": float("nan")}, "gamma must be positive; got nan"),
        ("aobg", {"failure_probability": 1.5}, "failure_probability must be positive and less than 1; got 1.5"),
        ("aobg", {"variance_proxy": "sum"}, "unknown variance proxy 'sum'; choose from variance, second"),
        ("aobg", {"variance_proxy": "upper_bound"}, "'upper_bound' requires a `radius`: .* got 'max_deviation'"),
        ("delta", {"sigma": 0.0}, "sigma must be positive and finite; got 0.0"),
        ("fobg_clipped", {"max_norm": float("inf")}, "max_norm must be positive and finite; got inf"),
        ("fobg_truncated", {"window": 0}, "window must be at least 1 and at most 1000000; got 0"),
        ("ddcg", {"tolerance": 1.0}, "tolerance must be at least 0 and less than 1; got 1.0"),
        ("aobg", {"radius": -0.1}, "radius must be at least 0 and finite; got -0.1"),
        ("aobg", {"radius": "widest"}, "unknown radius 'widest'; choose from max_deviation, or give a number"),
    ],
)
def test_options_out_of_range_are_refused(name: str, change: dict[str, Any], message: str):
    with pytest.raises(ValueError, match=message):
        made(name, **change)


def test_the_table_is_that_of_the_classes() -> None:
    assert markdown_table() in PAGE, f"put this table there:\n{markdown_table()}"
    assert all(f"`{name}`" in PAGE for name in (*BASELINES, *NOISES))
