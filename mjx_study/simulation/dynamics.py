r"""One simulation step and whole rollouts, differentiable through contact.

A step is MJX's own pipeline around the solve of `constraint`. It agrees with `mjx.step` up to solver convergence, and
its derivative is that of the converged step. Two programs compute the derivative:

- the *Jacobian* program, by default for models with few coordinates: the Jacobian of the velocity update with respect
  to state and control by the implicit function theorem, once per step. Reverse mode stores only these
  nv (nq + nv + na + nu) numbers per step and replays neither the solver nor the kinematics.
- the *tape* program, for larger models and for derivatives with respect to model parameters: ordinary automatic
  differentiation around the implicit solve, each step recomputed in the backward pass (`jax.checkpoint`) but with the
  solver's result saved, so that the solver does not run again.

The scene's `adjoint` and the differentiated inputs determine the program; both give the same numbers.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from estimators.pytree import register_pytree
from mjx_study.graph.derivative_rule import instantiated, with_rule
from mjx_study.graph.scalars import traced_part, unrolled
from mjx_study.simulation import constraint
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.constraint import Qvel, Scalar
from mjx_study.simulation.integration import integrate_position
from mjx_study.simulation.linear_algebra import MOST_UNROLLED, product, solve_positive_definite
from mjx_study.simulation.patches import patched
from mjx_study.simulation.scene import Scene

SAVE_SOLUTION: Final = jax.checkpoint_policies.save_only_these_names("qacc")
"""Policy of `jax.checkpoint` that recomputes steps in the backward pass without running their solver again."""


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


def initial_state(scene: Scene, qpos: Qpos | None = None, qvel: Qvel | None = None) -> State:
    """Return a state at rest in the MJCF's reference pose, or at `qpos` [m or rad] and `qvel` [m/s or rad/s]."""
    like = scene.template
    return State(
        qpos=like.qpos if qpos is None else jnp.asarray(qpos, like.qpos.dtype),
        qvel=like.qvel if qvel is None else jnp.asarray(qvel, like.qvel.dtype),
        act=like.act,
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
    if scene.host.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        return entry_by_entry(partial(_runge_kutta, scene), model, state, control), jnp.zeros_like(state.qpos, shape=())
    update = _jacobian_update if scene.uses_jacobian else _tape_update
    qvel, act, qacc, residual = update(
        scene, model, state.qpos, state.qvel, state.act, control, jax.lax.stop_gradient(state.warmstart)
    )
    qpos = integrate_position(scene.host, state.qpos, qvel, model.opt.timestep)
    return State(qpos, qvel, act, jax.lax.stop_gradient(qacc)), jax.lax.stop_gradient(residual)


def exact_step(scene: Scene, model: mjx.Model, state: State, control: Control) -> tuple[State, Scalar, mjx.Data]:
    """`step` with constraints solved to rounding, ignoring budgets, and its `smooth_stages`; values only.

    For finite differences, which would otherwise reflect where the solver of `step` stopped.
    """
    if scene.host.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        return *step(scene, model, state, control), smooth_stages(scene, model, state, control)
    return _solved(constraint.solve_to_rounding, scene, model, state, control)


def smooth_stages(scene: Scene, model: mjx.Model, state: State, control: Control) -> mjx.Data:
    """Run a step up to the constraint solve: kinematics, contacts, forces, constraint rows."""
    return force_stage(model, position_stage(scene, model, state.qpos), state.qvel, state.act, control)


def solved_step(
    scene: Scene, model: mjx.Model, state: State, control: Control
) -> tuple[State, Scalar, tuple[Float[Array, " guards"], Float[Array, " guards"], Bool[Array, " guards"]]]:
    """`step` without derivatives; the `constraint.guards` before the step, and which of them exert a force in it."""
    return entry_by_entry(partial(_solved_step, scene), model, state, control)


def _solved_step(scene: Scene, model: mjx.Model, state: State, control: Array):
    after, residual, data = _solved(constraint.run_solver, scene, model, state, control)
    guards = *constraint.guards(model, data), constraint.guards_under_force(model, data, after.warmstart)
    return after, residual, guards


def _solved(solver: constraint.Solver, scene: Scene, model: mjx.Model, state: State, control: Array):
    """State after a step, residual, and `smooth_stages`; no derivatives."""
    data = smooth_stages(scene, model, state, control).replace(qacc_warmstart=state.warmstart)
    qacc = solver(model, data)
    qvel, act = advance_velocity(model, data, qacc)
    qpos = integrate_position(scene.host, state.qpos, qvel, model.opt.timestep)
    return State(qpos, qvel, act, qacc), constraint.residual(model, data, qacc), data


def entry_by_entry(function: Callable[..., Any], model: mjx.Model, *arguments: Any) -> Any:
    """Evaluate `function(model, *arguments)`, unrolled if that pays: few degrees of freedom and a constant model."""
    if model.nv <= MOST_UNROLLED and not isinstance(model.body_mass, Tracer):
        return unrolled(function, model, *arguments)
    return function(model, *arguments)


ControlLaw = Callable[[Int[Array, ""], State], Control]


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

    def advance(state: State, index: Int[Array, ""]):
        control = control_law(index, state)
        if backward is None:
            following, residual = step(scene, model, state, control)
        else:
            following, residual = surrogate_step(scene, model, backward, state, control)
        return following, (following, control, residual)

    if not scene.uses_jacobian:
        advance = jax.checkpoint(advance, policy=SAVE_SOLUTION)
    _, (states, controls, residuals) = jax.lax.scan(advance, start, jnp.arange(horizon))
    trajectory = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, states)
    return trajectory, controls, residuals


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


@partial(jax.jit, static_argnames="solve")
def _constrained_update(
    model: mjx.Model, data: mjx.Data, qvel: Array, act: Array, control: Array, warmstart: Array, solve=constraint.solve
):
    """Velocity update by `constraint.solve`, or by `constraint.run_solver` without derivatives."""
    data = force_stage(model, fwd_position(model, data), qvel, act, control)
    qacc = solve(model, data.replace(qacc_warmstart=warmstart))
    return *advance_velocity(model, data, qacc), qacc, constraint.residual(model, data, qacc)


def _tape_update(scene: Scene, model: mjx.Model, qpos: Array, *inputs: Array):
    """Velocity update (qpos, qvel, act, control, warmstart) -> (qvel, act, qacc, residual)."""
    return _constrained_update(model, scene.template.replace(qpos=qpos), *inputs)


def _jacobian_update(scene: Scene, model: mjx.Model, *inputs: Array):
    """`_tape_update` with derivatives by the Jacobian program, except with respect to the model."""
    traced_model, whole = traced_part(model)

    def solved(traced, qpos, *inputs):
        update = partial(_constrained_update, solve=constraint.run_solver)
        return entry_by_entry(update, whole(traced), scene.template.replace(qpos=qpos), *inputs)

    def rule(primals, changes):
        traced, qpos, qvel, act, control, _ = primals
        if jax.tree.leaves(changes[0]):
            through = lambda traced, *inputs: _tape_update(scene, whole(traced), *inputs)  # noqa: E731
            return jax.jvp(through, primals, instantiated(primals, changes))
        value = update(*primals)
        over_step, over_qacc = step_jacobian(scene, whole(traced), qpos, qvel, act, control, value[2])
        direction = jnp.concatenate(instantiated(primals[1:5], changes[1:5]))
        out, qacc_out = product(over_step, direction), product(over_qacc, direction)
        nv = qvel.shape[0]
        # The tangent of qacc is for second derivatives: the Jacobian is a function of qacc.
        return value, (out[:nv], out[nv:], qacc_out, jnp.zeros_like(value[3]))

    update = with_rule(solved, rule)
    return update(traced_model, *inputs)


def step_jacobian(
    scene: Scene, model: mjx.Model, qpos: Qpos, qvel: Qvel, act: Act, control: Control, qacc: Qvel
) -> tuple[Float[Array, "nv_na inputs"], Float[Array, "nv inputs"]]:
    r"""Compute the Jacobians of (qvel', act') and of qacc over the columns (qpos, qvel, act, control).

    For the step S at a given acceleration a, and the solver's equation G(x, a) = 0,

        da/dx = -G_a^{-1} G_x,   dS/dx = S_x + S_a da/dx.

    Args:
        scene: static part of the model; its own contact parameters are not used.
        model: the model to step, with any contact model applied.
        qpos: positions at the point of linearisation, (nq,).
        qvel: velocities there, (nv,).
        act: activations there, (na,).
        control: controls there, (nu,).
        qacc: the converged constrained acceleration there.
    """
    return entry_by_entry(_jacobian, model, scene.template, qpos, qvel, act, control, qacc)


@jax.jit
def _jacobian(model: mjx.Model, template: mjx.Data, qpos: Array, qvel: Array, act: Array, control: Array, qacc: Array):
    def positions(qpos):
        return fwd_position(model, template.replace(qpos=qpos))

    def equations(data, qvel, act, control, qacc):
        data = force_stage(model, data, qvel, act, control)
        return jnp.concatenate([constraint.imbalance(model, data, qacc), *advance_velocity(model, data, qacc)])

    def columns(function, point):
        push = lambda direction: jax.jvp(function, (point,), (direction,))[1]  # noqa: E731
        return jax.vmap(push, out_axes=-1)(jnp.eye(point.shape[0], dtype=point.dtype))

    positioned = positions(qpos)
    blocks = [
        (lambda x: equations(positions(x), qvel, act, control, qacc), qpos),
        (lambda x: equations(positioned, x, act, control, qacc), qvel),
        (lambda x: equations(positioned, qvel, x, control, qacc), act),
        (lambda x: equations(positioned, qvel, act, x, qacc), control),
    ]
    over_inputs = jnp.concatenate([columns(*block) for block in blocks if block[1].size], axis=1)
    over_qacc = columns(lambda x: equations(positioned, qvel, act, control, x), qacc)
    nv = qvel.shape[0]
    response = -solve_positive_definite(over_qacc[:nv], over_inputs[:nv])
    return over_inputs[nv:] + over_qacc[nv:] @ response, response


def _runge_kutta(scene: Scene, model: mjx.Model, state: State, control: Control) -> State:
    """Classical fourth-order Runge-Kutta; scenes with constraints are rejected on loading."""
    timestep = model.opt.timestep

    def slopes(qpos, qvel, act):
        data = force_stage(model, position_stage(scene, model, qpos), qvel, act, control)
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
    qacc = jax.lax.stop_gradient(first[1])
    if state.act.size == 0:
        return State(qpos, qvel, state.act, qacc)
    # MJX's own activation update, with its clamping
    data = smooth_stages(scene, model, state, control)
    act = mjx.euler(model, data.replace(act_dot=mean[2], qacc=data.qacc_smooth)).act
    return State(qpos, qvel, act, qacc)
