"""`mjx.step` with exact derivatives, for code without scenes: as a function and as a context manager.

Both trace MJX's own pipeline with the patches of `patches`, and wrap MJX's own solver in the implicit derivative of
`constraint`.
"""

import contextlib
from collections.abc import Callable, Generator
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from mjx_study.choices import unknown
from mjx_study.graph.derivative_rule import instantiated, with_rule
from mjx_study.graph.scalars import traced_part
from mjx_study.simulation import constraint, guards
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.dynamics import Qvel, State, entry_by_entry, fwd_position, with_solver
from mjx_study.simulation.integration import difference_position, integrate_position
from mjx_study.simulation.native_step import solved_natively
from mjx_study.simulation.observed import differentiated_once, tangent_of
from mjx_study.simulation.over_model import Moving
from mjx_study.simulation.patches import Place, patched
from mjx_study.simulation.saltation import onset_term
from mjx_study.simulation.touch import Past, changes, event_of, onset_begins

Replacements = dict[Place, Callable[..., mjx.Data]]
Whole = Callable[[list[Any]], mjx.Model]
"""Makes a model from its traced leaves; the others stay constants, so that steps are native code."""
ONSETS: Final = ("none", "linear")
"""Treatments of the onset of contact in the derivatives of a step."""


def step(model: mjx.Model, data: mjx.Data, *, onset: str = "none") -> mjx.Data:
    """`mjx.step`, differentiable through contact in forward and reverse mode, in every array of model and data.

    Values agree with `mjx.step` to rounding, with the model's solver budget. If that has 20 iterations or more and no
    array of the model is traced, the step is native code where there is some, and solved to rounding; other fields than
    the state are then computed only if they are read. The derivative is that of a converged step, by the implicit
    function theorem at the solver's result, and only as good as the solver's convergence, which `solver_residual`
    reports. Reverse mode stores a step's inputs and acceleration, and recomputes the rest.

    Args:
        model: the model; its array leaves may be traced, batched under `jax.vmap` and differentiated.
        data: the state before the step, with controls and applied forces.
        onset: "none" or "linear"; "linear" makes derivatives account for a change of the step at which contact begins
            or ends under force, and restricts them to first order (see `_corrected_step`).

    Returns:
        The state after the step, with every field that `mjx.step` fills in, of the type that it had before, so that a
        step can be scanned. (`mjx.step` turns 32-bit indices of contacts and tendons into 64-bit ones.)

    Raises:
        ValueError: unknown onset, the onset term with RK4, or the model is not for MJX's JAX implementation.
        TypeError: other kinds of model and data, or a second derivative with the onset term.
    """
    _check_onset(onset)
    if not (isinstance(model, mjx.Model) and isinstance(data, mjx.Data)):
        given = f"{type(model).__name__} and {type(data).__name__}"
        raise TypeError(
            f"step takes an mjx.Model and mjx.Data, as mjx.put_model and mjx.make_data make them, not {given}"
        )
    if model.impl != mjx.Impl.JAX:
        raise ValueError(f"only MJX's implementation in JAX has derivatives, this model is for {model.impl.value}")
    if onset != "none" and model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        raise ValueError(
            "the onset term is that of steps by Euler or implicitfast; with RK4, contact begins within a step"
        )
    with patched(_SOLVE):
        if onset == "none" or not guards.num_guards(data):
            following = _uncorrected_step(model, data)
        else:
            traced, whole = traced_part(model)
            preceding = _preceding_contact(whole(jax.lax.stop_gradient(traced)), jax.lax.stop_gradient(data))
            corrected = jax.checkpoint(partial(_corrected_step, whole), policy=constraint.SAVE_SOLUTION)
            following = corrected(traced, data, preceding)
    return jax.tree.map(lambda new, old: new.astype(jax.typeof(old).dtype), following, data)


@contextlib.contextmanager
def differentiable_mjx(*, onset: str = "none") -> Generator[None]:
    """Give `mjx.step` and `mjx.forward` the derivatives of `step` in everything called or traced inside.

    For environments that call `mjx.step` themselves. Functions traced outside are retraced inside and vice versa, also
    behind `jax.jit`; programs compiled ahead of time do not change. Call the gradient inside: `jax.grad(f)` alone
    traces nothing yet. Other threads are not affected. Also works as a decorator: `@differentiable_mjx()`.

    Args:
        onset: as in `step`. With "linear", a `step` imported from MJX earlier, rather than called as `mjx.step`, raises
            RuntimeError.

    Raises:
        ValueError: unknown onset.
    """
    _check_onset(onset)
    with patched(_REPLACED[onset]):
        yield


def _check_onset(onset: str) -> None:
    if onset not in ONSETS:
        raise ValueError(unknown("onset of a step", onset, ONSETS))


def _uncorrected_step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.step`, in native code where there is some.

    Then MJX's operations compute only those fields that are read and not of the state, from the known acceleration.
    """
    if (found := solved_natively(model, data)) is None:
        return jax.checkpoint(mjx.step, policy=constraint.SAVE_SOLUTION)(model, data)
    qpos, qvel, act, qacc = found
    with patched(_KNOWN):
        following = jax.checkpoint(mjx.step)(model, data.replace(qacc_warmstart=jax.lax.stop_gradient(qacc)))
    return following.replace(qpos=qpos, qvel=qvel, act=act, qacc=qacc, qacc_warmstart=qacc)


def _uncorrected(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Replaces MJX's integrators to catch steps that bypass the replacement of `mjx.step`."""
    raise RuntimeError("this step would have no onset term: call mjx.step by that name, or mjx_study.step")


def solver_residual(model: mjx.Model, data: mjx.Data) -> Float[Array, ""]:
    """Relative force imbalance left by the solver in the last step, 0 if converged; dimensionless.

    Args:
        model: the model used in the step.
        data: the state after `mjx.step`, `mjx.forward` or `step`.
    """
    return constraint.residual(model, data, data.qacc)


def _solve(solver: constraint.Solver, model: mjx.Model, data: mjx.Data) -> mjx.Data:
    data = constraint.with_forces(model, data, constraint.solve(model, data, solver))
    rows: Any = data._impl
    return data.replace(qfrc_constraint=rows.efc_J.T @ rows.efc_force)


_SOLVE: Final[Replacements] = {
    ("solver", "solve"): partial(_solve, lambda model, data: mjx.solve(model, data).qacc),
}
_KNOWN: Final[Replacements] = {("solver", "solve"): partial(_solve, lambda _, data: data.qacc_warmstart)}
"""Takes the warm start for the solution."""
_REPLACED: Final[dict[str, Replacements]] = {
    "none": {**_SOLVE, ("", "step"): step},
    "linear": {
        **_SOLVE,
        ("", "step"): partial(step, onset="linear"),
        **dict.fromkeys([("forward", name) for name in ("euler", "implicit", "rungekutta4")], _uncorrected),
    },
}


def _preceding_contact(model: mjx.Model, data: mjx.Data) -> Past:
    """What the preceding step did, from the constraint rows that it left in its state; none does at time 0.

    After `mjx.forward` the rows are those of the state itself, and no contact is seen to end. The velocity before that
    step, which tells whether contact had just begun, is approximate where damping is integrated implicitly.
    """
    before = data.qvel - model.opt.timestep * data.qacc
    course = entry_by_entry(guards.course, model, data, before, data.qvel, data.qacc)
    begun = onset_begins(course.distance, model.opt.timestep * course.speed)
    none = jnp.zeros((), jnp.int32)
    return Past(course, (course.distance < 0) & ~begun, (data.time > 0).astype(jnp.int32), none, none)


def _corrected_step(whole: Whole, traced: list[Any], data: mjx.Data, preceding: Past) -> mjx.Data:
    """`mjx.step` with the same values, but derivatives that include the onset term.

    Delta is that from the velocity of step k, since the state does not contain the one before: an error of order h in
    the term. No contact begins or ends at time 0, which no step precedes.
    """
    model, fixed = whole(traced), jax.lax.stop_gradient(data)
    timestep = model.opt.timestep
    moved = difference_position(model, fixed.qpos, data.qpos)
    moved_before = moved - tangent_of(timestep * data.qvel)
    earlier, later = _onset_change(whole, traced, fixed, preceding, moved, moved_before)
    shifted = integrate_position(model, fixed.qpos, earlier, timestep)
    moving = data.replace(qpos=data.qpos + tangent_of(shifted), qvel=data.qvel + tangent_of(earlier))
    after = _uncorrected_step(model, moving)
    spread = integrate_position(model, jax.lax.stop_gradient(after.qpos), later, timestep)
    return after.replace(qpos=after.qpos + tangent_of(spread), qvel=after.qvel + tangent_of(later))


def _onset_change(whole: Whole, *arguments: Any) -> tuple[Qvel, Qvel]:
    """Zero velocities, before and after the step, that change with the step at which contact begins or ends.

    Args:
        whole: makes the model from its traced leaves.
        arguments: these, the state, what preceded it, and the change of position, also before the step.
    """

    def zeros(traced: list[Any], data: mjx.Data, preceding: Past, moved: Qvel, before: Qvel) -> tuple[Qvel, Qvel]:
        return jnp.zeros_like(moved), jnp.zeros_like(moved)

    def rule(primals: Any, changes: Any) -> tuple[tuple[Qvel, Qvel], tuple[Qvel, Qvel]]:
        traced, data, preceding = jax.lax.stop_gradient(primals[:3])
        of_model = {place: each for place, each in enumerate(changes[0]) if each is not None}
        spread, shift = _step_terms(whole(traced), data, preceding, {place: traced[place] for place in of_model})
        change, change_before = (
            jnp.concatenate([each, ravel_pytree(of_model)[0]]) for each in instantiated(primals[3:], changes[3:])
        )
        return _onset_change(whole, *differentiated_once(primals)), (shift @ change_before, spread @ change)

    return with_rule(zeros, rule)(*arguments)


def _course_here(model: mjx.Model, data: mjx.Data) -> guards.Course:
    return guards.course(model, fwd_position(model, data), data.qvel, data.qvel, data.qacc)


def _step_terms(
    model: mjx.Model, data: mjx.Data, preceding: Past, moving: Moving
) -> tuple[Float[Array, "nv changes"], Float[Array, "nv changes"]]:
    """(1 - s) Delta n^T / D and s Delta n^T / D of a step, zero if no contact begins or ends; see `onset_term`."""
    here = entry_by_entry(_course_here, model, data)
    empty = jnp.zeros((model.nv, model.nv + sum(leaf.size for leaf in moving.values())), data.qvel.dtype)
    found = changes(here, preceding, model.opt.timestep)[1]
    states = State(*(leaf[None] for leaf in (data.qpos, data.qvel, data.act, data.qacc_warmstart)))

    def add(carry):
        number, *sums = carry
        event = event_of(found, number, preceding.steps)
        term = onset_term(with_solver, model, data, states, data.ctrl[None], event, moving)[0]
        parts = (jnp.outer(each, term.slope) for each in (term.spread, term.shift))
        return number + 1, *(total + part for total, part in zip(sums, parts, strict=True))

    # the loop over a batch ends with the last event of any sample
    _, here, previous = jax.lax.while_loop(lambda carry: carry[0] < found.after, add, (found.before, empty, empty))
    return here, previous
