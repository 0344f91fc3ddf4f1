"""The step of `drop_in` in native code: state and acceleration, with their derivatives, from what they depend on."""

from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
from jax.core import Tracer
from jaxtyping import Array

from mjx_study.graph.derivative_rule import instantiated, with_rule
from mjx_study.graph.function import ScalarFunction
from mjx_study.graph.native import native_identity
from mjx_study.graph.operation import computed
from mjx_study.graph.scalars import captured_once
from mjx_study.simulation import constraint
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.dynamics import (
    at_solution,
    by_graph,
    by_tape,
    equations,
    force_stage,
    fwd_position,
    integrated,
)

AMPLE: Final = 20
"""Minimum number of solver iterations in a model's budget for its steps to be solved natively, which is to rounding."""
MOVING: Final = frozenset({".qpos", ".qvel", ".act", ".ctrl"})
"""Inputs for which derivatives are always built; others only where they change."""

Step = tuple[Array, Array, Array, Array]
"""Positions, velocities and activations after a step, and its acceleration."""
Layout = tuple[Any, tuple[jax.ShapeDtypeStruct, ...], tuple[int, ...]]
"""Structure and types of `mjx.Data`, and the places of the arrays that a step depends on."""


def solved_natively(model: mjx.Model, data: mjx.Data) -> Step | None:
    """A step in native code, of first and higher derivatives over every array of `data` but the warm start.

    None without native code, and if the model is traced, has no coordinate, RK4, a budget below `AMPLE` or too large a
    step.
    """
    explicit = model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    if native_identity() is None or explicit or model.opt.iterations < AMPLE or not model.nv:
        return None
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(model)):
        return None
    if (found := solved_graph(model, data)) is None:
        return None
    solved, layout = found
    _, kinds, used = layout
    forced = partial(_forced, layout)
    leaves = jax.tree_util.tree_leaves_with_path(data)
    names = [jax.tree_util.keystr(path) for path, _ in leaves]
    always = [names[place] in MOVING for place in used]
    fixed = [names[place] == ".qacc_warmstart" or kinds[place].dtype.kind != "f" for place in used]

    def forward(*inputs: Array) -> list[Array]:
        return computed(solved, jax.tree.leaves(_whole(layout, inputs)))

    def rule(primals: Any, changes: Any) -> Any:
        following = advance(*primals)
        moved = tuple(
            None if still or (change is None and not needed) else instantiated(primal, change)
            for still, needed, primal, change in zip(fixed, always, primals, changes, strict=True)
        )
        step, qacc = partial(at_solution, forced, model), following[3]
        found = by_graph(partial(equations, forced), step, model, primals, qacc, moved)
        return following, list(found or by_tape(step, qacc, primals, moved))

    advance = with_rule(forward, rule)
    qpos, qvel, act, qacc = advance(*(jnp.asarray(leaves[place][1]) for place in used))
    return qpos, qvel, act, qacc


def solved_graph(model: mjx.Model, data: mjx.Data) -> tuple[ScalarFunction, Layout] | None:
    """A step as a graph, of all arrays of `data`; None if it is too large."""
    leaves, structure = jax.tree.flatten(data)
    kinds = tuple(jax.ShapeDtypeStruct(jnp.shape(leaf), jax.typeof(leaf).dtype) for leaf in leaves)
    solved = captured_once(_solved, model, structure.unflatten(kinds))
    return None if solved is None else (solved, (structure, kinds, tuple(solved.used)))


def _whole(layout: Layout, inputs: tuple[Array, ...]) -> mjx.Data:
    """Data with zeros for what the step does not depend on."""
    structure, kinds, used = layout
    given = dict(zip(used, inputs, strict=True))
    return structure.unflatten(
        given[place] if place in given else jnp.zeros(kind.shape, kind.dtype) for place, kind in enumerate(kinds)
    )


def _forced(layout: Layout, model: mjx.Model, *inputs: Array) -> mjx.Data:
    return _forced_from(model, _whole(layout, inputs))


def _forced_from(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    return force_stage(model, fwd_position(model, data), data.qvel, data.act, data.ctrl)


def _solved(model: mjx.Model, data: mjx.Data) -> Step:
    forced = _forced_from(model, data)
    qacc = constraint.newton(model, forced)
    return *integrated(model, forced, qacc), qacc
