"""Pure functions for one iteration of stochastic gradient descent over several seeds, and for stopping a seed."""

import ast
import dataclasses
import inspect
import math
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int

from estimators import Estimator, Linearisation, StepEvaluation
from estimators.pytree import register_pytree

DIVERGED: Final = 1e6
"""Ratio of the mean cost to the size of the first one beyond which a run counts as diverged."""
REASONS: Final = (
    "",
    "no sample of the batch is finite",
    "the gradient estimate is not finite",
    "the parameters are not finite after the update",
    f"the mean cost exceeds {DIVERGED:g} times the size of the first one",
)
"""Reasons why a seed stopped, by code; 0 while it continues."""


@register_pytree
@dataclasses.dataclass(frozen=True)
class Descent:
    """State of all seeds of a run.

    Attributes:
        theta: parameters of each seed.
        reason: index into `REASONS`; 0 while a seed continues. Stopped seeds no longer change.
        first_cost: absolute mean cost of each seed at its first iteration.
    """

    theta: Float[Array, "*seeds params"]
    optimizer: Any
    reason: Int[Array, "*seeds"]
    first_cost: Float[Array, "*seeds"]


@register_pytree
@dataclasses.dataclass(frozen=True)
class Record:
    """Record of one iteration for each seed; NaN once a seed has stopped.

    Attributes:
        cost: mean cost of the batch, before the update.
        variance: variance of a single gradient sample.
        alpha: weight of the first-order batch; NaN for estimators with a single batch.
        nonfinite: number of excluded samples.
        residual: largest solver residual in the batch; 0 for an analytic system.
    """

    cost: Float[Array, "*seeds"]
    gradient_norm: Float[Array, "*seeds"]
    variance: Float[Array, "*seeds"]
    alpha: Float[Array, "*seeds"]
    nonfinite: Float[Array, "*seeds"]
    residual: Float[Array, "*seeds"]


def make_optimizer(name: str, learning_rate: float, decay: float) -> optax.GradientTransformation:
    """Create an optax optimiser by name, with learning rate learning_rate / i^decay at iteration i.

    Raises:
        ValueError: optax has no such optimiser, it needs more than a learning rate, or a number is out of range.
    """
    if not learning_rate > 0 or not learning_rate < float("inf"):
        raise ValueError(f"the learning rate must be positive and finite, got {learning_rate}")
    if not 0 <= decay <= 2:
        raise ValueError(f"the decay of the learning rate must be a power from 0 to 2, got {decay}")
    optimizer = _optimizer(name, lambda count: learning_rate / (1.0 + count) ** decay)
    if optimizer is None:
        raise ValueError(
            f"optax has no optimiser {name!r} that takes a learning rate; use for example sgd, adam or rmsprop"
        )
    return optimizer


def _optimizer(name: str, schedule: optax.Schedule) -> optax.GradientTransformation | None:
    """Return optax's optimiser of a name; None if it has no learning rate or needs more than gradients."""
    theta = jax.ShapeDtypeStruct((2,), float)
    try:
        factory = getattr(optax, name)
        if "learning_rate" not in inspect.signature(factory).parameters:
            return None
        optimizer = factory(learning_rate=schedule)
        jax.eval_shape(lambda theta: optimizer.update(theta, optimizer.init(theta), theta), theta)
    except Exception:  # whatever optax has by this name may raise anything
        return None
    return optimizer if isinstance(optimizer, optax.GradientTransformation) else None


def schedule_factors(text: str | None, iterations: int, most: float = math.inf) -> Float[np.ndarray, " iterations"]:
    """Evaluate an optax schedule given as text, such as "linear_schedule(0.01, 1, 100)", at each iteration.

    Args:
        text: call of an optax schedule with numbers, lists or nested schedules as arguments; None for a constant 1.
        iterations: number of iterations.
        most: largest allowed factor.

    Raises:
        ValueError: the text is not such a call, optax rejects it, or a factor is not positive or too large.
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
            raise ValueError(f"optax has no schedule {node.func.id!r}")
        named = {str(keyword.arg): _evaluate(keyword.value) for keyword in node.keywords}
        return factory(*map(_evaluate, node.args), **named)
    if isinstance(node, ast.List | ast.Tuple):
        return [_evaluate(each) for each in node.elts]
    return ast.literal_eval(node)


def begin(optimizer: optax.GradientTransformation, theta: Float[Array, " params"], seeds: int) -> Descent:
    """Start all seeds at the same parameters."""
    thetas = jnp.broadcast_to(theta, (seeds, *theta.shape))
    return Descent(
        thetas, jax.vmap(optimizer.init)(thetas), jnp.zeros(seeds, int), jnp.full(seeds, jnp.nan, theta.dtype)
    )


def advance(
    state: Descent, batches: dict[str, Any], estimator: Estimator, optimizer: optax.GradientTransformation
) -> tuple[Descent, Record]:
    """Advance every active seed by one iteration.

    Args:
        batches: batches of the estimator's oracles, each array with a leading axis of seeds.

    Returns:
        The new state, and the record of the iteration.
    """
    return jax.vmap(lambda state, batches: _advance_one(state, batches, estimator, optimizer))(state, batches)


def _advance_one(state: Descent, batches, estimator, optimizer):
    estimate = estimator(batches)
    value, residual = _values(batches[estimator.needs[0]])
    finite = jnp.isfinite(value)
    cost = jnp.sum(jnp.where(finite, value, 0.0)) / jnp.sum(finite)
    first_cost = jnp.where(jnp.isnan(state.first_cost), jnp.abs(cost), state.first_cost)
    updates, optimizer_state = optimizer.update(estimate.mean, state.optimizer, state.theta)
    theta: Array = optax.apply_updates(state.theta, updates)  # type: ignore[assignment]
    # the most severe reason last
    reason = jnp.zeros((), int)
    for code, holds in (
        (4, jnp.abs(cost) > DIVERGED * jnp.maximum(first_cost, 1e-12)),
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
    figures = (
        cost,
        jnp.linalg.norm(estimate.mean),
        estimate.variance,
        nan if estimate.alpha is None else estimate.alpha.alpha,
        estimate.num_nonfinite.astype(theta.dtype),
        jnp.zeros((), theta.dtype) if residual is None else jnp.max(residual),
    )
    return following, Record(*(jnp.where(stopped_before, nan, figure) for figure in figures))


def _values(batch) -> tuple[Float[Array, " samples"], Float[Array, " samples"] | None]:
    """Total costs and residuals of a batch of any kind."""
    batch = batch[0] if isinstance(batch, tuple) else batch
    batch = batch.steps if isinstance(batch, Linearisation) else batch
    return (batch.value_to_go[:, 0] if isinstance(batch, StepEvaluation) else batch.value), batch.residual


def going(state: Descent) -> Bool[Array, "*seeds"]:
    """Which seeds have not stopped."""
    return state.reason == 0
