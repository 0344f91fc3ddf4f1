"""Rollouts without derivatives, in which events are found, and what derives them again at what was found.

Both onset terms first simulate, then differentiate along the known states, with their terms where events are.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mjx_study.graph.derivative_rule import flat_with_rule, refusing, with_rule
from mjx_study.graph.scalars import traced_part
from mjx_study.simulation import constraint
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.constraint import Qvel, Scalar
from mjx_study.simulation.dynamics import Act, Control, Controls, Point, State, change_over, observed_step, with_solver
from mjx_study.simulation.scene import Scene
from mjx_study.simulation.touch import Changes, Events, Past, changes

TOGETHER: Final = 8
"""Number of events that an accelerator computes in the time of one."""


class Observed(NamedTuple):
    """A rollout without derivatives.

    Attributes:
        last: the state after it.
        past: what its guards did.
        before, controls, after, residuals, costs: of every step, the state before it, its control, the state after it,
            its residual and its cost.
        found: where guards change, of every step.
    """

    last: State
    past: Past
    before: State
    controls: Controls
    after: State
    residuals: Float[Array, " horizon"]
    costs: Any
    found: Changes


class Known(NamedTuple):
    """What is known of a step.

    Attributes:
        before, after: the states.
        control: the control.
    """

    before: State
    control: Control
    after: State


Replay = Callable[[State, Any, Control, Known, Any], tuple[State, Any]]
"""The state after a step, with its derivatives, and what the next needs to know: from the state before it, the same of
the one before, its control, what is known of it, and its row."""
Acted = Callable[[Any, State], tuple[Control, Any]]
"""The control of a step and its cost, from its input and the state before it."""


def observed_rollout(scene: Scene, model: mjx.Model, start: State, acted: Acted, inputs: Any) -> Observed:
    """Simulate without derivatives.

    Args:
        model: the model to step, without derivatives.
        inputs: of every step.
    """

    def observe(carry: tuple[State, Past], given: Any):
        state, past = carry
        control, cost = jax.lax.stop_gradient(acted(given, state))
        following, residual, past, found = with_solver(partial(_observed, scene), model, state, control, past)
        return (following, past), (state, control, following, residual, cost, found)

    begin = jax.lax.stop_gradient(start)
    step = partial(observed_step, scene, constraint.run_solver, model)
    course = lambda given: step(begin, acted(given, begin)[0])[2]  # noqa: E731
    like = jax.eval_shape(course, jax.tree.map(lambda leaf: leaf[0], inputs))
    (last, past), known = jax.lax.scan(observe, (begin, Past.none(like)), inputs)
    before, controls, after, residuals, costs, found = known
    return Observed(last, past, before, controls, after, residuals, costs, found)


def _observed(scene: Scene, solver: constraint.Solver, model: mjx.Model, state: State, control: Control, past: Past):
    after, residual, course = observed_step(scene, solver, model, state, control)
    return after, residual, *changes(course, past, model.opt.timestep)


def moving_values(known: Any, moving: Any) -> Any:
    """Known values, with the derivatives of others."""
    return jax.tree.map(_with_tangent, known, moving)


def known_step(scene: Scene, model: mjx.Model, point: Point, after: State) -> tuple[Qvel, Act]:
    """Velocity and activations after a step, which are known, with their derivatives over what precedes it."""
    traced, whole = traced_part(model)

    def known(traced: Any, point: Point, after: State) -> tuple[Qvel, Act]:
        return after.qvel, after.act

    def rule(primals: Any, changes: Any) -> Any:
        traced, point, after = primals
        inputs = traced, *differentiated_once(point)
        return step(*primals), change_over(scene, whole, inputs, after.warmstart, (changes[0], *changes[1]))[1:3]

    step = with_rule(known, rule)
    return step(traced, point, after)


def over_events(function: Callable[[Events], Any], events: Events) -> Any:
    """A function of every event, zeros for those slots that no sample of a batch uses."""

    def fill(_: None, some: Events):
        """Of a few events; a loop, which ends at once where no sample has any.

        It carries the events, and clears them, since what depends on nothing that changes is computed before it.
        """
        none = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(every, some))
        once = lambda carry: (jnp.zeros((), bool), jax.tree.map(jnp.zeros_like, carry[1]), every(carry[1]))  # noqa: E731
        return None, jax.lax.while_loop(lambda carry: carry[0], once, (jnp.any(some.used), some, none))[2]

    every, few = (function, ()) if jax.default_backend() == "cpu" else (jax.vmap(function), (TOGETHER,))
    slots = len(events.used)
    grouped = jax.tree.map(lambda leaf: jnp.resize(leaf, (-(-slots // math.prod(few)), *few, *leaf.shape[1:])), events)
    _, each = jax.lax.scan(fill, None, grouped)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[1 + len(few) :])[:slots], each)


def least_travel(model: mjx.Model, across: Float[Array, " 2"], either: Bool[Array, ""], rate: Scalar) -> Scalar:
    """Travel of a guard in a step [m or rad] below which its onset counts as grazing: h |a| / max(b, sqrt(k d)).

    Args:
        across: acceleration of the guard with the contact and without [m/s^2 or rad/s^2].
        either: whether both count, as where contact ends or begins in penetration, or that without alone.
        rate: the larger of `guards.relaxation_rates`.
    """
    on, off = jnp.abs(across)
    return model.opt.timestep * jnp.where(either, jnp.maximum(on, off), off) / rate


def tangent_of(value: Float[Array, "..."]) -> Float[Array, "..."]:
    """Zero, with the derivative of `value`; differentiating it again raises TypeError."""
    return _with_tangent(jnp.zeros_like(value), value)


def _of_second(primals: Any, changes: Any) -> Any:
    return _with_tangent(primals[0], differentiated_once(primals[1])), changes[1]


_with_tangent = with_rule(lambda value, moving: value, _of_second)
"""A value without its own derivative, with that of another; differentiating it again raises TypeError."""
differentiated_once = refusing("derivatives with the onset term are of first order: it has no second derivative")


def along_events(
    jumps: Float[Array, "slots after"],
    slopes: Float[Array, "slots before"],
    own: tuple[Int[Array, ""], Int[Array, ""]],
    moved: Float[Array, " before"],
) -> Float[Array, " after"]:
    """Sum of some events' jumps times their slopes' products with a motion, linear in the latter.

    Args:
        own: the first of the events, and the one after the last.
    """

    def total(jumps: Array, slopes: Array, first: Array, last: Array, moved: Array) -> list[Array]:
        none = jnp.zeros(jumps.shape[1:], moved.dtype)
        add = lambda carry: (carry[0] + 1, carry[1] + jumps[carry[0]] * jnp.sum(slopes[carry[0]] * moved))  # noqa: E731
        return [jax.lax.while_loop(lambda carry: carry[0] < last, add, (first, none))[1]]

    def rule(primals: Sequence[Any], changes: Sequence[Any]) -> Any:
        return linear(*primals), linear(*primals[:-1], changes[-1])

    def transpose(fixed: Sequence[Any], adjoints: Sequence[Any]) -> list[Any]:
        jumps, slopes, first, last, _ = fixed
        return [*[None] * 4, along_events(slopes, jumps, (first, last), adjoints[0])]

    def linear(*arguments: Array) -> list[Array]:
        return flat_with_rule(total, arguments, rule, transpose)

    (found,) = linear(jumps, slopes, *own, moved)
    return found


def without_derivative(tree: Any) -> Any:
    """Return the pytree, without the derivatives of its traced leaves."""
    traced, whole = traced_part(tree)
    return whole(jax.lax.stop_gradient(traced))
