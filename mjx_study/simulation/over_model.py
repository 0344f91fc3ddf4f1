"""Where guards pass zero, as a function of the model: the part of the onset term that derivatives over it need."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from mjx_study.graph.derivative_rule import flat_with_rule
from mjx_study.graph.scalars import traced_part
from mjx_study.simulation import guards
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.constraint import Qvel, Scalar
from mjx_study.simulation.dynamics import State, fwd_position
from mjx_study.simulation.scene import Scene
from mjx_study.simulation.touch import Events, at_touch

Moving = Mapping[int, Array]
"""Leaves of a model that change, by their places in it."""


def slope_over(
    moving: Moving, model: mjx.Model, positioned: mjx.Data, qvel: Qvel, event: Events
) -> Float[Array, " entries"]:
    """Derivative of a guard's distance with respect to the entries of leaves of the model, at constant position."""
    leaves, structure = jax.tree.flatten(model)

    def distance(moving: Moving) -> Scalar:
        moved = structure.unflatten([moving.get(place, leaf) for place, leaf in enumerate(leaves)])
        return guards.find_guards(moved, fwd_position(moved, positioned), qvel, event.ends).distance[event.guard]

    return ravel_pytree(jax.grad(distance)(dict(moving)))[0].astype(qvel.dtype)


def moved_by_model(scene: Scene, model: mjx.Model, before: State, events: Events) -> Float[Array, " slots"]:
    """Zeros, with the derivatives over the model of the distances of events' guards, at constant positions.

    Without a derivative, and so at no cost, where the model has none.

    Args:
        model: the model to step, which may have derivatives.
        before: states before every step.
        events: the rollout's events.
    """
    traced, whole = traced_part(model)
    places = [place for place, leaf in enumerate(traced) if leaf is not None]
    others, structure = jax.tree.flatten((before.qpos[events.step], before.qvel[events.step], events))

    def zeros(*leaves: Array) -> list[Array]:
        return [jnp.zeros(events.step.shape, before.qvel.dtype)]

    def rule(primals: Sequence[Any], changes: Sequence[Any]) -> Any:
        of_model = {place: each for place, each in zip(places, changes, strict=False) if each is not None}
        value = flat_with_rule(zeros, primals, rule)
        if not of_model:
            return value, [None]
        fixed = jax.lax.stop_gradient(list(primals))
        given = dict(zip(places, fixed, strict=False))
        there = whole([given.get(place) for place in range(len(traced))])
        moving = {place: given[place] for place in of_model}

        def slope(at: tuple[Array, Array, Events]) -> Array:
            touch = at_touch(None, there, scene.template, *at)
            positioned = fwd_position(there, scene.template.replace(qpos=touch.qpos))
            found = slope_over(moving, there, positioned, at[1], at[2])
            return jnp.where(touch.valid, found, 0.0)

        slopes = jax.lax.map(slope, structure.unflatten(fixed[len(places) :]))
        return value, [slopes @ ravel_pytree(of_model)[0]]

    (found,) = flat_with_rule(zeros, [*(traced[place] for place in places), *others], rule)
    return found
