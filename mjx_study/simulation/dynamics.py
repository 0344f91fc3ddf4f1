r"""One simulation step and whole rollouts, differentiable through contact.

A step is MJX's own pipeline around the solve of `constraint`. It agrees with `mjx.step` up to solver convergence, and
its derivative is that of the converged step, by the implicit function theorem at the solver's result: for the step S at
a given acceleration a, and the solver's equation G(x, a) = 0,

    da/dx = -G_a^{-1} G_x,   dS/dx = S_x + S_a da/dx.

Reverse mode stores a step's inputs and acceleration, and does not run the solver again. Two programs compute the
derivative, with the same numbers:

- the *graph*, in native code and for models with few degrees of freedom: JAX traces G and S once and without
  derivatives, and their graph is differentiated (`mjx_study.graph.linear_map`). Where that is not possible for a small
  model, JAX forms the step's matrix column by column, in forward mode.
- the *tape*, for steps too large for a graph and for derivatives with respect to model parameters: JAX differentiates
  MJX's operations, in reverse mode by computing them again.

The scene's `adjoint` and the differentiated inputs determine the program.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NoReturn

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from estimators.pytree import register_pytree
from mjx_study.graph.derivative_rule import instantiated, with_rule
from mjx_study.graph.differentiation import NotDifferentiableError
from mjx_study.graph.linear_map import implicit_derivative, implicit_jacobian
from mjx_study.graph.native import count_left, native_identity
from mjx_study.graph.operation import applied, computed
from mjx_study.graph.scalars import captured_once, is_small, traced_part, unrolled
from mjx_study.simulation import constraint, guards
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.constraint import Qvel, Scalar
from mjx_study.simulation.integration import integrate_position
from mjx_study.simulation.law import LawModel
from mjx_study.simulation.linear_algebra import MOST_UNROLLED, product, solve_positive_definite
from mjx_study.simulation.patches import patched
from mjx_study.simulation.scene import Scene

Qpos = Float[Array, " nq"]
Act = Float[Array, " na"]
Control = Float[Array, " nu"]
Controls = Float[Array, "horizon nu"]


@register_pytree
@dataclasses.dataclass(frozen=True)
class State:
    """State carried from step to step.

    Attributes:
        qpos: generalised positions [m or rad; unit quaternions].
        qvel: generalised velocities [m/s or rad/s].
        act: actuator activations.
        warmstart: last acceleration, the solver's warm start [m/s^2 or rad/s^2]; not differentiated.
    """

    qpos: Float[Array, "*batch nq"]
    qvel: Float[Array, "*batch nv"]
    act: Float[Array, "*batch na"]
    warmstart: Float[Array, "*batch nv"]

    if not TYPE_CHECKING:  # so that type checkers still find unknown attributes

        def __getattr__(self, name: str) -> NoReturn:
            raise AttributeError(
                f"a State has qpos, qvel and act, but no {name!r}; positions of bodies, contact forces and sensors are "
                "those of mjx_study.observed(scene, state)"
            )


def initial_state(scene: Scene, qpos: Qpos | None = None, qvel: Qvel | None = None, act: Act | None = None) -> State:
    """Return a state at rest in the MJCF's reference pose, or at `qpos` [m or rad] and `qvel` [m/s or rad/s].

    Activations of actuators are 0 unless `act` gives them. A shape that is not the scene's is a ValueError.
    """
    like = scene.template
    for name, given in (("qpos", qpos), ("qvel", qvel), ("act", act)):
        if given is not None and jnp.shape(given) != (needed := getattr(like, name).shape):
            raise ValueError(f"{name} has shape {jnp.shape(given)}; the scene needs {needed}")
    return State(
        qpos=like.qpos if qpos is None else jnp.asarray(qpos, like.qpos.dtype),
        qvel=like.qvel if qvel is None else jnp.asarray(qvel, like.qvel.dtype),
        act=like.act if act is None else jnp.asarray(act, like.act.dtype),
        warmstart=jnp.zeros_like(like.qvel),
    )


def step(scene: Scene, model: mjx.Model, state: State, control: Control) -> tuple[State, Scalar]:
    """Advance by one timestep.

    Args:
        scene: static part of the model; its own contact parameters are not used.
        model: the model to step, `scene.model` with any contact model applied; may be traced.
        state: the state before the step, with the solver's warm start.
        control: actuator controls, in the MJCF's units.

    Returns:
        The state after the step, and the solver's relative residual (see `constraint.residual`).
    """
    following, residual = _differentiable_step(scene, model, state, control)
    warmstart, residual = jax.lax.stop_gradient((following.warmstart, residual))
    return dataclasses.replace(following, warmstart=warmstart), residual


def acceleration(scene: Scene, model: mjx.Model, state: State, control: Control) -> Qvel:
    """Constrained acceleration during a `step` [m/s^2 or rad/s^2], with its implicit derivative."""
    return _differentiable_step(scene, model, state, control)[0].warmstart


def exact_step(scene: Scene, model: mjx.Model, state: State, control: Control) -> tuple[State, Scalar, mjx.Data]:
    """`step` with constraints solved to rounding, ignoring budgets, and its `smooth_stages`; values only.

    For finite differences, which would otherwise reflect where the solver of `step` stopped.
    """
    if isinstance(model, LawModel) or scene.host.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        return *step(scene, model, state, control), smooth_stages(scene, model, state, control)
    return _solved(constraint.solve_to_rounding, scene, model, state, control)


def _step_of_law(scene: Scene, model: LawModel, state: State, control: Control) -> tuple[State, Scalar]:
    """`step` under another law than MuJoCo's, with a derivative of the acceleration, too."""
    traced_model, whole = traced_part(model)
    values, equations = partial(model.law.step, scene), model.law.equations(scene)

    def stepped(traced: Any, *point: Any) -> Any:
        return entry_by_entry(values, whole(traced), *point)

    def rule(primals: Any, changes: Any) -> Any:
        after, (traced, *point), (of_model, *moved) = advance(*primals), primals, changes
        through = lambda _, traced, *point: values(whole(traced), *point)[:4]  # noqa: E731
        change, leaves = None, [pair for pair in zip(traced, of_model, strict=True) if pair[0] is not None]
        if equations is not None and all(each is None or isinstance(leaf, Tracer) for leaf, each in leaves):
            at_model = lambda qacc, *point: through(qacc, traced, *point)  # noqa: E731
            over_state = instantiated(tuple(point), tuple(moved))
            over_model = (
                [each for leaf, each in leaves if isinstance(leaf, Tracer)] if jax.tree.leaves(of_model) else []
            )
            change = by_graph(equations, at_model, whole(traced), point, after[3], over_state, over_model)
        change = change or by_tape(through, after[3], (traced, *point), (of_model, *moved))
        return after, (*change, jnp.zeros_like(after[4]))

    advance = with_rule(stepped, rule)
    qpos, qvel, act, qacc, residual = advance(traced_model, state.qpos, state.qvel, state.act, control)
    return State(qpos, qvel, act, qacc), residual


def smooth_stages(scene: Scene, model: mjx.Model, state: State, control: Control) -> mjx.Data:
    """Run a step up to the constraint solve: kinematics, contacts, forces, constraint rows."""
    return _forced(scene, model, state.qpos, state.qvel, state.act, control)


def _forced(scene: Scene, model: mjx.Model, qpos: Qpos, qvel: Qvel, act: Act, control: Control) -> mjx.Data:
    return force_stage(model, position_stage(scene, model, qpos), qvel, act, control)


def observed_step(scene: Scene, solver: constraint.Solver, model: mjx.Model, state: State, control: Array):
    """`step` with a solver, without derivatives, and the course of the guards in it."""
    after, residual, data = _solved(solver, scene, model, state, control)
    return after, residual, guards.course(model, data, state.qvel, after.qvel, after.warmstart)


def _solved(solver: constraint.Solver, scene: Scene, model: mjx.Model, state: State, control: Array):
    """State after a step, residual, and `smooth_stages`; no derivatives."""
    data = smooth_stages(scene, model, state, control).replace(qacc_warmstart=state.warmstart)
    qacc = solver(model, data)
    return State(*integrated(model, data, qacc), qacc), constraint.residual(model, data, qacc), data


def entry_by_entry(
    function: Callable[..., Any], model: mjx.Model, *arguments: Any, otherwise: Callable[..., Any] | None = None
) -> Any:
    """Evaluate `function(model, *arguments)`, unrolled if that pays: a constant model, and few degrees of freedom or
    native code. If it does not pay, evaluate `otherwise`."""
    small = model.nv <= MOST_UNROLLED or native_identity() is not None
    if small and not isinstance(model.body_mass, Tracer):
        return unrolled(function, model, *arguments, otherwise=otherwise)
    return (otherwise or function)(model, *arguments)


def with_solver(function: Callable[..., Any], model: mjx.Model, *arguments: Any) -> Any:
    """Evaluate `function(solver, model, *arguments)` entry by entry, solved to rounding, else as `run_solver` does."""
    plain = partial(function, constraint.run_solver)
    solved = partial(function, constraint.newton) if constraint.OWN_SOLVER else plain
    return entry_by_entry(solved, model, *arguments, otherwise=plain)


ControlLaw = Callable[[Any, State], Control]
"""The control of a step from its index, or another input that differs from step to step, and the state before it."""


def surrogate_step(
    scene: Scene, model: mjx.Model, backward: mjx.Model, state: State, control: Control
) -> tuple[State, Scalar]:
    """`step`, with the derivatives over state and control of another model's step, `backward`, at the same point.

    Derivatives with respect to either model are zero.
    """

    traced, whole = traced_part(jax.lax.stop_gradient((model, backward)))

    def forward(traced, state, control):
        return step(scene, whole(traced)[0], state, control)

    def rule(primals, changes):
        point, changes = primals[1:], instantiated(primals[1:], changes[1:])
        return advance(*primals), jax.jvp(partial(step, scene, whole(primals[0])[1]), point, changes)[1]

    advance = with_rule(forward, rule)
    return advance(traced, state, control)


def rollout(
    scene: Scene,
    model: mjx.Model,
    start: State,
    control_law: ControlLaw,
    horizon: int,
    backward: mjx.Model | None = None,
) -> tuple[State, Controls, Float[Array, " horizon"]]:
    """Simulate `horizon` closed-loop steps.

    Args:
        scene: static part of the model.
        model: the model to step; may be traced.
        start: the initial state, the first of those returned.
        control_law: maps (step index, state) to the control of that step.
        horizon: number of steps, at least 1.
        backward: model whose derivatives replace each step's, see `surrogate_step`; None for its own.

    Returns:
        States `(horizon + 1, ...)` including the initial one, controls `(horizon, nu)`, residuals `(horizon,)`.

    Raises:
        ValueError: the horizon is not positive.
    """
    if horizon < 1:
        raise ValueError(f"horizon must be at least 1 step, got {horizon}")
    law = control_law, jnp.arange(horizon)
    last, (states, controls, residuals, _) = simulated(scene, model, start, *law, lambda *_: None, backward)
    return trajectory(states, last), controls, residuals


RunningCost = Callable[[State, Control], Any]


def simulated(
    scene: Scene,
    model: mjx.Model,
    start: State,
    control_law: ControlLaw,
    inputs: Any,
    running_cost: RunningCost,
    backward: mjx.Model | None = None,
) -> tuple[State, tuple[State, Controls, Float[Array, " horizon"], Any]]:
    """Simulate a step for every input of the control law.

    Args:
        scene, model, start, backward: as for `rollout`.
        control_law: maps (input, state) to the control of a step.
        inputs: pytree of arrays with a leading axis of steps.
        running_cost: cost of a step, of the state before it and its control.

    Returns:
        The state after the last step; and of every step, the state before it, its control, residual and cost.
    """

    def advance(state: State, given: Any):
        control = control_law(given, state)
        if backward is None:
            following, residual = step(scene, model, state, control)
        else:
            following, residual = surrogate_step(scene, model, backward, state, control)
        return following, (state, control, residual, running_cost(state, control))

    return jax.lax.scan(advance, start, inputs)


def trajectory(states: State, last: State) -> State:
    """All states of a rollout, from those before each step and the last."""
    return jax.tree.map(lambda before, end: jnp.concatenate([before, end[None]]), states, last)


# The stages of a step. A Jacobian over qvel, act or ctrl starts after the position stage and so is cheap. Each stage is
# jitted so that JAX traces MJX's many operations once rather than per direction; XLA inlines them again.


def position_stage(scene: Scene, model: mjx.Model, qpos: Qpos) -> mjx.Data:
    return fwd_position(model, scene.template.replace(qpos=qpos))


@jax.jit
def fwd_position(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """MJX's `fwd_position`, patched."""
    with patched():
        return mjx.fwd_position(model, data)


@jax.jit
def force_stage(model: mjx.Model, data: mjx.Data, qvel: Qvel, act: Act, control: Control) -> mjx.Data:
    data = data.replace(qvel=qvel, act=act, ctrl=control)
    with patched():
        data = mjx.make_constraint(model, data)  # again: aref depends on qvel
        data = mjx.fwd_velocity(model, data)
        data = mjx.fwd_actuation(model, data)
        return mjx.fwd_acceleration(model, data)


@jax.jit
def advance_velocity(model: mjx.Model, data: mjx.Data, qacc: Qvel) -> tuple[Qvel, Act]:
    """Return velocity and activation after the step, given the constrained acceleration, by MJX's own integrators."""
    data = data.replace(qacc=qacc, qfrc_constraint=constraint.constraint_force(model, data, qacc))
    implicit = model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    data = mjx.implicit(model, data) if implicit else mjx.euler(model, data)
    return data.qvel, data.act


def _differentiable_step(scene: Scene, model: mjx.Model, state: State, control: Control) -> tuple[State, Scalar]:
    """`step`, with a derivative of the acceleration, too: for second derivatives."""
    if isinstance(model, LawModel):
        return _step_of_law(scene, model, state, control)
    if scene.host.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        explicit = partial(_runge_kutta, scene)
        taped = jax.checkpoint(explicit)
        advance = partial(entry_by_entry, explicit, otherwise=taped) if scene.uses_graph else taped
        return advance(model, state, control), jnp.zeros_like(state.qpos, shape=())
    traced_model, whole = traced_part(model)

    def solved(traced: Any, state: State, control: Control) -> tuple[State, Scalar]:
        return with_solver(partial(_values, scene), whole(traced), state, control)

    def rule(primals: Any, changes: Any) -> Any:
        following, residual = advance(*primals)
        inputs, moved = ((model, at.qpos, at.qvel, at.act, control) for model, at, control in (primals, changes))
        change = change_over(scene, whole, inputs, following.warmstart, moved)
        return (following, residual), (State(*change), jnp.zeros_like(residual))

    advance = with_rule(solved, rule)
    return advance(traced_model, state, control)


def _values(
    scene: Scene, solver: constraint.Solver, model: mjx.Model, state: State, control: Control
) -> tuple[State, Scalar]:
    return _solved(solver, scene, model, state, control)[:2]


Point = tuple[Qpos, Qvel, Act, Control]
"""Positions, velocities, activations and controls before a step, or their changes."""
Forced = Callable[..., mjx.Data]
"""A step up to the constraint solve: maps (model, *point) to the data of `force_stage`."""
StepChange = tuple[Array, ...]
"""Changes of positions (nq,), velocities (nv,) and activations (na,) after a step, and of its acceleration (nv,)."""


def change_over(
    scene: Scene,
    whole: Callable[[list[Any]], mjx.Model],
    inputs: tuple[Any, ...],
    qacc: Qvel,
    changes: tuple[Any, ...],
) -> StepChange:
    """`step_change`, which may be over traced arrays of the model, too: by the tape then.

    Args:
        whole: the model, from the traced ones of its arrays.
        inputs: these, and what precedes the step.
        qacc: the converged constrained acceleration there.
        changes: changes of the inputs, None for arrays that do not change.
    """
    traced, *point = inputs
    if not jax.tree.leaves(changes[0]):
        moved = instantiated(tuple(point), changes[1:])
        return step_change(scene, whole(traced), tuple(point), qacc, moved)
    forced = partial(_forced, scene)
    return by_tape(lambda qacc, of_model, *at: at_solution(forced, whole(of_model), qacc, *at), qacc, inputs, changes)


def step_change(scene: Scene, model: mjx.Model, point: Point, qacc: Qvel, change: Point) -> StepChange:
    """Change of a step, linear in the change of what precedes it.

    Args:
        scene: static part of the model; its own contact parameters are not used.
        model: the model to step, with any contact model applied.
        point: what precedes the step.
        qacc: the converged constrained acceleration there.
        change: change of the point.
    """
    forced = partial(_forced, scene)
    step = partial(at_solution, forced, model)
    if scene.uses_graph and (found := by_graph(partial(equations, forced), step, model, point, qacc, change)):
        return found
    return (_by_columns if scene.forms_matrix else by_tape)(step, qacc, point, change)


def by_graph(
    equations: Callable[..., Any],
    step: Callable[..., Any],
    model: mjx.Model,
    point: Sequence[Array],
    qacc: Qvel,
    change: Sequence[Array | None],
    of_model: Sequence[Array | None] = (),
) -> StepChange | None:
    """Change of a step and of its acceleration as a graph, if it is one and worth compiling.

    Native code computes products with the derivative or its transpose. XLA would compute each entry of those anew from
    the start, and is given the matrix.

    Args:
        equations: maps (model, *point, qacc) to the left side of the solver's equation and the step.
        step: maps (qacc, *point) to the step and its acceleration, differentiable by JAX.
        model: the model to step.
        point: what precedes the step.
        qacc: the converged constrained acceleration there.
        change: change of the point, None for arrays that do not change.
        of_model: change of the model's traced arrays, likewise; empty if none changes.
    """
    if isinstance(model.body_mass, Tracer):
        return None
    kind = lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype)  # noqa: E731
    like = jax.tree.map(lambda leaf: kind(leaf) if isinstance(leaf, Tracer) else leaf, model)
    captured = captured_once(equations, like, *map(kind, (*point, qacc)))
    if captured is None:
        return None
    traced = [leaf for leaf in jax.tree.leaves(model) if isinstance(leaf, Tracer)]
    inputs, whole_change = [*traced, *point, qacc], [*(of_model or [None] * len(traced)), *change]
    over = tuple(at for at, each in enumerate(whole_change) if each is not None)
    changes = [each for each in whole_change if each is not None]

    def plain(inputs: Sequence[Any], changes: Sequence[Any]) -> Any:
        *point, qacc = inputs[-1 - len(change) :]
        left = iter(changes)
        return by_tape(step, qacc, tuple(point), tuple(None if each is None else next(left) for each in change))

    try:
        if native_identity() is not None:
            slope = implicit_derivative(captured, over, solve_positive_definite)
            left = None if of_model else plain
            return tuple(applied(slope, inputs, changes, left)) if is_small(slope.push) else None
        matrix = implicit_jacobian(captured, over, solve_positive_definite)
    except NotDifferentiableError as error:
        count_left(f"derivative of {error}")
        return None
    if not is_small(matrix):
        return None
    (entries,) = computed(matrix, inputs)
    ends = np.cumsum([math.prod(aval.shape) for aval in captured.avals[1:]])
    return tuple(jnp.split(product(entries, jnp.concatenate(changes)), ends))


def equations(forced: Forced, model: mjx.Model, *inputs: Array) -> tuple[Qvel, Qpos, Qvel, Act]:
    """Left side of the solver's equation G, and the step S, at any acceleration, the last of the inputs."""
    *point, qacc = inputs
    data = forced(model, *point)
    return constraint.imbalance(model, data, qacc), *integrated(model, data, qacc)


def at_solution(forced: Forced, model: mjx.Model, known: Qvel, *point: Array) -> tuple[Qpos, Qvel, Act, Qvel]:
    """Step and acceleration, whose value is known, with the derivatives of the step."""
    data = forced(model, *point)
    qacc = constraint.solve(model, data.replace(qacc_warmstart=known), lambda _, data: data.qacc_warmstart)
    return *integrated(model, data, qacc), qacc


def integrated(model: mjx.Model, data: mjx.Data, qacc: Array) -> tuple[Qpos, Qvel, Act]:
    """State after a step, given its acceleration and the data of `force_stage`."""
    qvel, act = advance_velocity(model, data, qacc)
    return integrate_position(model, data.qpos, qvel, model.opt.timestep), qvel, act


def by_tape(function: Callable[..., Any], qacc: Qvel, point: tuple[Any, ...], change: tuple[Any, ...]) -> Any:
    """Change of `function(qacc, *point)` with the leaves of the point, those without change None.

    Reverse mode stores the arguments and recomputes the rest.
    """
    leaves, structure = jax.tree.flatten(point)
    changes = dict(enumerate(structure.flatten_up_to(change)))
    changes = {place: each for place, each in changes.items() if each is not None}

    def along(leaves: list[Any], qacc: Array, changes: dict[int, Any]) -> Any:
        def through(moving: dict[int, Any]) -> Any:
            return function(qacc, *structure.unflatten([moving.get(at, leaf) for at, leaf in enumerate(leaves)]))

        return jax.jvp(through, ({place: leaves[place] for place in changes},), (changes,))[1]

    return jax.checkpoint(along)(leaves, qacc, changes)


def _by_columns(function: Callable[..., Any], qacc: Qvel, point: Point, change: Point) -> Any:
    """Change of `function(qacc, *point)` by its matrix, formed in forward mode, which reverse mode stores."""
    flat, unflatten = ravel_pytree(point)

    def along(direction: Array) -> Any:
        return jax.jvp(partial(function, qacc), point, unflatten(direction))[1]

    columns = jax.vmap(along, out_axes=-1)(jnp.eye(len(flat), dtype=flat.dtype))
    return jax.tree.map(lambda matrix: product(matrix, ravel_pytree(change)[0]), columns)


def step_jacobian(
    scene: Scene, model: mjx.Model, qpos: Qpos, qvel: Qvel, act: Act, control: Control, qacc: Qvel
) -> tuple[Float[Array, "nv_na inputs"], Float[Array, "nv inputs"]]:
    r"""Compute the Jacobians of (qvel', act') and of qacc over the columns (qpos, qvel, act, control).

    Args:
        scene: static part of the model; its own contact parameters are not used.
        model: the model to step, with any contact model applied.
        qpos: positions at the point of linearisation, (nq,).
        qvel: velocities there, (nv,).
        act: activations there, (na,).
        control: controls there, (nu,).
        qacc: the converged constrained acceleration there.
    """
    point = qpos, qvel, act, control
    flat, unflatten = ravel_pytree(point)
    column = lambda change: step_change(scene, model, point, qacc, unflatten(change))  # noqa: E731
    _, over_qvel, over_act, over_qacc = jax.vmap(column, out_axes=-1)(jnp.eye(len(flat), dtype=flat.dtype))
    return jnp.concatenate([over_qvel, over_act]), over_qacc


def _runge_kutta(scene: Scene, model: mjx.Model, state: State, control: Control) -> State:
    """Classical fourth-order Runge-Kutta; scenes with constraints are rejected on loading."""
    timestep = model.opt.timestep

    def slopes(qpos, qvel, act):
        data = _forced(scene, model, qpos, qvel, act, control)
        return qvel, data.qacc_smooth, data.act_dot

    def moved(fraction, slope):
        velocity, acceleration, activation = (fraction * timestep * part for part in slope)
        qpos = integrate_position(scene.host, state.qpos, velocity, 1.0)
        return qpos, state.qvel + acceleration, state.act + activation

    first = slopes(state.qpos, state.qvel, state.act)
    second = slopes(*moved(0.5, first))
    third = slopes(*moved(0.5, second))
    fourth = slopes(*moved(1.0, third))
    mean = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, first, second, third, fourth)
    qpos, qvel, _ = moved(1.0, mean)
    if state.act.size == 0:
        return State(qpos, qvel, state.act, first[1])
    # MJX's own activation update, with its clamping
    data = smooth_stages(scene, model, state, control)
    act = mjx.euler(model, data.replace(act_dot=mean[2], qacc=data.qacc_smooth)).act
    return State(qpos, qvel, act, first[1])
