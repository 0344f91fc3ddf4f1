"""Pure functions for one iteration of stochastic gradient descent over several seeds, and for stopping a seed."""

import ast
import dataclasses
import inspect
import math
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int

from estimators import Estimator, Linearisation, StepEvaluation
from estimators.choices import suggestion
from estimators.pytree import register_pytree
from mjx_study.experiment.gradient_numbers import estimate_of

AnyArray = Array | np.ndarray
Record = dict[str, Any]
"""Arrays of `variables.HISTORY` in one iteration, by seed; NaN once a seed has stopped. alpha is NaN for estimators
with a single batch, and the residual 0 for an analytic system."""

MOST_COST_RATIO: Final = 1e6
"""Ratio of the mean cost to the size of the first one beyond which a run counts as diverged."""
REASONS: Final = (
    "",
    "no sample of the batch is finite",
    "the gradient estimate is not finite",
    "the parameters are not finite after the update",
    f"the mean cost exceeds {MOST_COST_RATIO:g} times the size of the first one",
)
"""Reasons why a seed stopped, by code; 0 while it continues."""


@register_pytree
@dataclasses.dataclass(frozen=True)
class Descent:
    """State of all seeds of a run; stopped seeds no longer change.

    Attributes:
        reason: index into `REASONS`; 0 while a seed continues.
        first_cost: absolute mean cost of each seed at its first iteration.
    """

    theta: Float[AnyArray, "*seeds params"]
    optimizer: Any
    reason: Int[AnyArray, "*seeds"]
    first_cost: Float[AnyArray, "*seeds"]


def make_optimizer(name: str, learning_rate: float, decay: float) -> optax.GradientTransformation:
    """Create an optax optimiser by name, with learning rate learning_rate / i^decay at iteration i.

    ValueError if optax has no such optimiser, it needs more than a learning rate, or a number is out of range.
    """
    if not learning_rate > 0 or not learning_rate < float("inf"):
        raise ValueError(f"the learning rate must be positive and finite, got {learning_rate}")
    if not 0 <= decay <= 2:
        raise ValueError(f"the decay of the learning rate must be a power from 0 to 2, got {decay}")
    optimizer = None
    with suppress(Exception):  # whatever optax has by this name may raise anything
        if "learning_rate" in inspect.signature(getattr(optax, name)).parameters:
            made = optimizer_of(name, learning_rate, decay)
            theta = jax.ShapeDtypeStruct((2,), float)
            jax.eval_shape(lambda theta: made.update(theta, made.init(theta), theta), theta)
            optimizer = made
    if not isinstance(optimizer, optax.GradientTransformation):
        functions = [] if hasattr(optax, name) else [each for each in vars(optax).values() if inspect.isfunction(each)]
        known = [each.__name__ for each in functions if "learning_rate" in inspect.signature(each).parameters]
        more = suggestion(name, known) or "; use for example sgd, adam or rmsprop"
        raise ValueError(f"optax has no optimiser {name!r} that takes a learning rate{more}")
    return optimizer


def optimizer_of(name: str, learning_rate: Any, decay: Any) -> optax.GradientTransformation:
    """The optimiser of `make_optimizer`, whose numbers may be traced."""
    return getattr(optax, name)(learning_rate=lambda count: learning_rate / (1.0 + count) ** decay)


def schedule_factors(text: str | None, iterations: int, most: float = math.inf) -> Float[np.ndarray, " iterations"]:
    """Evaluate an optax schedule given as text, such as "linear_schedule(0.01, 1, 100)", at each iteration.

    The text calls an optax schedule with numbers, lists or nested schedules; None is a constant 1. ValueError if it is
    not such a call, optax rejects it, or a factor is not positive or larger than `most`.
    """
    if text is None:
        return np.ones(iterations)
    example = "give an optax schedule, such as linear_schedule(0.01, 1, 100)"
    try:
        schedule = _evaluate(ast.parse(text.strip(), mode="eval").body)
        factors = np.asarray(jax.vmap(schedule)(jnp.arange(iterations)), float)
    except Exception as error:  # whatever optax has by this name may raise anything
        raise ValueError(f"{text!r} cannot be read ({str(error).splitlines()[0]}): {example}") from None
    if factors.shape != (iterations,) or not np.all((factors > 0) & (factors <= most)):
        bound = "positive" if most == math.inf else f"positive and at most {most:g}"
        raise ValueError(f"factors must be {bound} in all {iterations} iterations; {text} has others")
    return factors


def _evaluate(node: ast.expr) -> Any:
    """Evaluate a literal, or a call of one of optax's schedules; nothing else is executed."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        factory = vars(optax.schedules).get(node.func.id)
        if not inspect.isfunction(factory):
            known = [name for name, each in vars(optax.schedules).items() if inspect.isfunction(each)]
            raise ValueError(f"optax has no schedule {node.func.id!r}{suggestion(node.func.id, known)}")
        named = {str(keyword.arg): _evaluate(keyword.value) for keyword in node.keywords}
        return factory(*map(_evaluate, node.args), **named)
    if isinstance(node, ast.List | ast.Tuple):
        return [_evaluate(each) for each in node.elts]
    return ast.literal_eval(node)


def begin(
    optimizer: optax.GradientTransformation, theta: Float[Array, " params"], seeds: int, rows: int | None = None
) -> Descent:
    """Start all seeds at the same parameters, in arrays on the host; any further rows have stopped."""
    one = Descent(theta, optimizer.init(theta), jnp.zeros((), int), jnp.asarray(jnp.nan, theta.dtype))
    state = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[None], rows or seeds, axis=0), one)
    state.reason[seeds:] = 1
    return state


def advance_one(
    state: Descent,
    batches: dict[str, Any],
    estimator: Estimator,
    optimizer: optax.GradientTransformation,
    samples: Int[Array, ""] | None = None,
) -> tuple[Descent, Record]:
    """Advance an active seed by one iteration, given the batches of the estimator's oracles; return the new state, and
    the record of the iteration. With a number of samples, the rest of the batches is padding."""
    value, residual = _values(batches[estimator.needs[0]])
    padding = 0
    if samples is None:
        estimate = estimator(batches)
    else:
        estimate, padding = estimate_of(estimator, batches, samples), len(value) - samples
        real = jnp.arange(len(value)) < samples
        value = jnp.where(real, value, jnp.nan)
        residual = None if residual is None else jnp.where(real, residual, 0.0)
    finite = jnp.isfinite(value)
    cost = jnp.sum(jnp.where(finite, value, 0.0)) / jnp.sum(finite)
    first_cost = jnp.where(jnp.isnan(state.first_cost), jnp.abs(cost), state.first_cost)
    updates, optimizer_state = optimizer.update(estimate.mean, state.optimizer, state.theta)
    theta: Array = optax.apply_updates(state.theta, updates)  # type: ignore[assignment]
    reason = jnp.zeros((), int)
    for code, holds in (  # the most severe one last
        (4, jnp.abs(cost) > MOST_COST_RATIO * jnp.maximum(first_cost, 1e-12)),
        (3, ~jnp.all(jnp.isfinite(theta))),
        (2, ~jnp.all(jnp.isfinite(estimate.mean))),
        (1, estimate.num_finite == 0),
    ):
        reason = jnp.where(holds, code, reason)
    stopped_before = state.reason != 0
    reason = jnp.where(stopped_before, state.reason, reason)
    moves = reason == 0
    following = Descent(
        jnp.where(moves, theta, state.theta),
        jax.tree.map(lambda new, old: jnp.where(moves, new, old), optimizer_state, state.optimizer),
        reason,
        first_cost,
    )
    nan = jnp.full((), jnp.nan, theta.dtype)
    record = {
        "cost": cost,
        "gradient_norm": jnp.linalg.norm(estimate.mean),
        "variance": estimate.variance,
        "alpha": nan if estimate.alpha is None else estimate.alpha.alpha,
        "nonfinite": (estimate.num_nonfinite - padding).astype(theta.dtype),
        "residual": jnp.zeros((), theta.dtype) if residual is None else jnp.max(residual),
    }
    return following, jax.tree.map(lambda figure: jnp.where(stopped_before, nan, figure), record)


def if_going(advance: Callable[..., tuple[Descent, Record]], state: Descent, key: Any) -> tuple[Descent, Record]:
    """Advance a seed unless it has stopped, in a program that takes seeds in turn."""
    nothing = jax.tree.map(
        lambda leaf: jnp.full(leaf.shape, jnp.nan, leaf.dtype), jax.eval_shape(advance, state, key)[1]
    )
    return jax.lax.cond(state.reason == 0, advance, lambda state, _: (state, nothing), state, key)


def _values(batch) -> tuple[Float[Array, " samples"], Float[Array, " samples"] | None]:
    """Total costs and residuals of a batch of any kind."""
    batch = batch[0] if isinstance(batch, tuple) else batch
    batch = batch.steps if isinstance(batch, Linearisation) else batch
    return (batch.value_to_go[:, 0] if isinstance(batch, StepEvaluation) else batch.value), batch.residual


def going(state: Descent) -> Bool[np.ndarray, "*seeds"]:
    """Which seeds have not stopped."""
    return np.asarray(state.reason) == 0
