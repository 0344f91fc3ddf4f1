r"""The constraint solve as differentiable root finding.

MuJoCo's constrained acceleration minimises a convex function; equivalently, it is the root `a` of

    G(a) = M a - qfrc_smooth - J^T f(J a - aref) = 0,

with `f` the force law of each constraint row. MJX solves this with a `while_loop`, which has no reverse mode, so
`mjx.step` is differentiable only with a single solver iteration, which gets both the step and its gradient wrong. Here
the solver runs to convergence (MJX's own or, for few degrees of freedom, a faster one), and the derivative follows from
the implicit function theorem: one symmetric positive definite system in `dG/da = M + J^T f' J`, whatever the solver and
its budget. The derivative is only as good as the solver's convergence, which `residual` measures and every result
reports.

MJX's constraint rows are private (`Data._impl.efc_*`) and are read only in this package, and by gradcheck.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float, Int

from mjx_study.graph.derivative_rule import with_rule
from mjx_study.graph.scalars import traced_part
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.linear_algebra import MOST_UNROLLED, product, solve_positive_definite
from mjx_study.simulation.scene import num_constraint_rows

Scalar = Float[Array, ""]
Qvel = Float[Array, " nv"]
Rows = Float[Array, " rows"]
Solver = Callable[[mjx.Model, mjx.Data], Qvel]
ELLIPTIC: Final = mujoco.mjtCone.mjCONE_ELLIPTIC

OWN_SOLVER: Final = True
"""Whether small systems use the solver below instead of MJX's; tests compare both."""
NEWTON_STEPS: Final = 30
LINE_SEARCH_STEPS: Final = 4
MOST_ROUNDINGS: Final = 8  # tolerance of the solver's equation in rounding errors of its terms
GENEROUS: Final = (100, 50)  # iterations of the solver and its line search in `solve_to_rounding`
POLISHING_STEPS: Final = 4
EPSILON: Final = 1e-14
"""Relative rounding error of a force in the solver's equation."""

SAVE_SOLUTION: Final = jax.checkpoint_policies.save_only_these_names("qacc")
"""Policy of `jax.checkpoint` that recomputes steps in the backward pass without running their solver again."""


def row_force(model: mjx.Model, data: mjx.Data, slack: Rows) -> Rows:
    """Force of each constraint row [N or N m] at the slack J a - aref [m/s^2 or rad/s^2]: MuJoCo's force law f.

    With D the inverse regularisation of a row and x its slack, the force is -D x for an equality; -D x clipped to
    +- frictionloss for friction loss; -D x where x < 0, else 0, for limits and for frictionless and pyramidal contacts;
    elliptic contacts depend on the zone of the cone (`_elliptic_force`).

    Reference: MuJoCo documentation, Computation, "Constraint model".
    """
    rows: Any = data._impl
    linear = -rows.efc_D * slack
    unilateral = jnp.where(slack < 0, linear, 0.0)

    loss = rows.efc_frictionloss
    friction = jnp.where(loss > 0, jnp.clip(linear, -loss, loss), linear)

    kind = np.zeros(slack.shape[0], dtype=int)
    kind[: rows.ne] = 2
    kind[rows.ne : rows.ne + rows.nf] = 1
    force = jnp.where(kind == 2, linear, jnp.where(kind == 1, friction, unilateral))
    return _elliptic_force(model, rows, slack, linear, force) if model.opt.cone == ELLIPTIC else force


def _elliptic_force(model: mjx.Model, rows: Any, slack: Rows, linear: Rows, force: Rows) -> Rows:
    """Replace the rows of elliptic contacts in `force`; those of the same dimension at once.

    With the scaled slack u = (mu x_n, friction * x_t), N = u_n, T = |u_t|: if separated (N >= mu T), no force; if
    sticking (mu N + T <= 0), linear; if sliding (in between, on the cone), force -dm mu (N - mu T) along (1, -u_t / T).
    The branch not taken is evaluated at a safe T, so the derivative is finite at T = 0.
    """
    contact = rows.contact
    condims, addresses = np.asarray(contact.dim), np.asarray(contact.efc_address)
    for condim in np.unique(condims[condims > 1]):
        (alike,) = np.nonzero(condims == condim)
        span = addresses[alike][:, None] + np.arange(condim)
        friction = contact.friction[alike, : condim - 1]
        mu = friction[:, 0] / jnp.sqrt(model.opt.impratio)
        normal = mu * slack[span[:, 0]]
        tangent = friction * slack[span[:, 1:]]

        square = jnp.sum(tangent**2, axis=1)
        moving = square > 0
        length = jnp.where(moving, jnp.sqrt(jnp.where(moving, square, 1.0)), 0.0)
        safe_length = jnp.where(moving, length, 1.0)
        sticking = jnp.where(moving, mu * normal + length <= 0, normal < 0)
        sliding = moving & (normal < mu * length) & (mu * normal + length > 0)

        stiffness = rows.efc_D[span[:, 0]] / jnp.maximum(mu * mu * (1 + mu * mu), mujoco.mjMINVAL)
        magnitude = -stiffness * mu * (normal - mu * length)
        along = -magnitude[:, None] * friction * tangent / safe_length[:, None]
        on_cone = jnp.concatenate([magnitude[:, None], along], axis=1)
        others = jnp.where(sliding[:, None], on_cone, 0.0)
        force = force.at[span].set(jnp.where(sticking[:, None], linear[span], others))
    return force


def row_forces_at(model: mjx.Model, data: mjx.Data, qacc: Qvel) -> Rows:
    """Force of each constraint row [N or N m] at the acceleration `qacc`."""
    rows: Any = data._impl
    return row_force(model, data, rows.efc_J @ qacc - rows.efc_aref)


def constraint_force(model: mjx.Model, data: mjx.Data, qacc: Qvel) -> Qvel:
    """Joint-space constraint force J^T f(J a - aref) [N or N m] at the acceleration `qacc`."""
    rows: Any = data._impl
    return rows.efc_J.T @ row_forces_at(model, data, qacc)


def with_forces(model: mjx.Model, data: mjx.Data, qacc: Qvel) -> mjx.Data:
    """The data with an acceleration, and with the force of every constraint row at it."""
    found: Any = data.tree_replace({"qacc": qacc, "_impl.efc_force": row_forces_at(model, data, qacc)})
    return found


def contact_forces(model: mjx.Model, data: mjx.Data) -> tuple[Int[Array, "contacts 2"], Float[Array, "contacts 3"]]:
    """Geoms of every contact, and its force [N] on the second one in the world frame; data of `with_forces`.

    The rows of an elliptic contact are its normal and tangential forces; of a pyramidal one, forces along n + mu t and
    n - mu t for each tangent t.
    """
    rows: Any = data._impl
    contact, forces = rows.contact, []
    if not (len(contact.dim) and num_constraint_rows(data)):  # none where constraints are disabled
        return jnp.zeros((0, 2), int), jnp.zeros((0, 3), data.qpos.dtype)
    for index, (condim, address) in enumerate(zip(contact.dim, contact.efc_address, strict=True)):
        edges = 2 * (condim - 1) if condim > 1 and model.opt.cone != ELLIPTIC else 0
        force = rows.efc_force[int(address) : int(address) + (edges or int(condim))]
        if edges:
            plus, minus = force[::2], force[1::2]
            force = jnp.concatenate([jnp.sum(force)[None], contact.friction[index, : condim - 1] * (plus - minus)])
        forces.append(force[:3] @ contact.frame[index][: len(force[:3])])
    return contact.geom, jnp.stack(forces)


def imbalance(model: mjx.Model, data: mjx.Data, qacc: Qvel) -> Qvel:
    """Left side of the solver's equation, G(a) = M a - qfrc_smooth - J^T f(J a - aref) [N or N m]."""
    return mjx.mul_m(model, data, qacc) - data.qfrc_smooth - constraint_force(model, data, qacc)


def residual(model: mjx.Model, data: mjx.Data, qacc: Qvel) -> Scalar:
    """Relative imbalance |G(a)| / (|M a| + |qfrc_smooth| + |J^T f|), 0 where all are 0; dimensionless."""
    inertial = mjx.mul_m(model, data, qacc)
    constraint = constraint_force(model, data, qacc)
    scale = sum(jnp.sum(jnp.abs(term)) for term in (inertial, data.qfrc_smooth, constraint))
    gap = jnp.sum(jnp.abs(inertial - data.qfrc_smooth - constraint))
    return jnp.where(scale > 0, gap / jnp.where(scale > 0, scale, 1.0), 0.0)


def run_solver(model: mjx.Model, data: mjx.Data) -> Qvel:
    """Compute the constrained acceleration [m/s^2 or rad/s^2] from the warm start; no reverse mode.

    Small systems use Newton's method, to rounding; larger ones use MJX's solver within the model's budget.
    """
    if OWN_SOLVER and model.nv <= MOST_UNROLLED:
        return newton(model, data)
    return data.qacc_smooth if num_constraint_rows(data) == 0 else mjx.solve(model, data).qacc


def newton(model: mjx.Model, data: mjx.Data) -> Qvel:
    """Compute the constrained acceleration to rounding by Newton's method with a line search, ignoring budgets.

    If no row exerts a force, the result is the unconstrained acceleration. The loop over a batch ends with its slowest
    sample: seldom after more than two steps, or six where boxes stick and slip.
    """
    if num_constraint_rows(data) == 0:
        return data.qacc_smooth
    rows: Any = data._impl
    inertia, jacobian = mjx.full_m(model, data), rows.efc_J
    rounding = MOST_ROUNDINGS * jnp.finfo(inertia.dtype).eps

    def force(slack):
        return row_force(model, data, slack)

    def slack_at(qacc):
        return product(jacobian, qacc) - rows.efc_aref

    def gap(qacc):
        return product(inertia, qacc) - data.qfrc_smooth - product(jacobian.T, force(slack_at(qacc)))

    def unsolved(qacc):
        acting, size = jnp.where(force(slack_at(qacc)) != 0, rows.efc_D, 0.0), jnp.abs(qacc)
        terms = acting * (product(jnp.abs(jacobian), size) + jnp.abs(rows.efc_aref))
        scale = product(jnp.abs(inertia), size) + jnp.abs(data.qfrc_smooth) + product(jnp.abs(jacobian).T, terms)
        return jnp.sum(jnp.abs(gap(qacc))) > rounding * jnp.sum(scale)

    def advance(qacc):
        left, slope = jax.linearize(gap, qacc)
        step = -_solve_linear(slope, left)
        start, along = slack_at(qacc), product(jacobian, step)
        constant = jnp.vdot(step, product(inertia, qacc) - data.qfrc_smooth)
        linear = jnp.vdot(step, product(inertia, step))
        derivative = lambda x: constant + linear * x - jnp.sum(along * force(start + x * along))  # noqa: E731
        return qacc + step * _line_search(derivative, qacc.dtype)

    def again(carry):
        qacc = advance(carry[0])
        return qacc, carry[1] + 1, unsolved(qacc)

    acting = jnp.any(force(slack_at(data.qacc_smooth)) != 0)
    warm = acting & jnp.all(jnp.isfinite(data.qacc_warmstart))  # of a state that has diverged and was reset it is not
    start = jnp.where(warm, data.qacc_warmstart, data.qacc_smooth)
    return jax.lax.while_loop(lambda carry: carry[2] & (carry[1] < NEWTON_STEPS), again, (start, 0, acting))[0]


def _solve_linear(linear_map: Callable[[Array], Array], right_side: Array) -> Array:
    return solve_positive_definite(jax.vmap(linear_map)(jnp.eye(len(right_side), dtype=right_side.dtype)), right_side)


def _line_search(derivative: Callable[[Array], Array], dtype: Any) -> Scalar:
    """Return a multiple of the Newton step that lowers the cost, whose increasing `derivative` is negative at 0.

    It is the full step unless the derivative's magnitude at its end exceeds half of that at the start, because contacts
    began, ended or slipped on the way. Then it is the best of a few Newton steps on the derivative's root, with false
    position where they leave the bracket. The derivative is piecewise linear unless cones are elliptic.
    """
    low, high, fraction = jnp.zeros((), dtype), jnp.full((), jnp.inf, dtype), jnp.ones((), dtype)
    at_low = at_high = at_start = derivative(low)
    best, least, whole = fraction, jnp.abs(at_start) / 2, jnp.asarray(False)
    for index in range(LINE_SEARCH_STEPS):
        value, slope = jax.jvp(derivative, (fraction,), (jnp.ones((), dtype),))
        better = jnp.abs(value) <= least
        best, least = jnp.where(better, fraction, best), jnp.where(better, jnp.abs(value), least)
        if index == 0:
            whole, least = better, jnp.where(better, least, jnp.abs(at_start))
        above = value > 0
        low, at_low = jnp.where(above, low, fraction), jnp.where(above, at_low, value)
        high, at_high = jnp.where(above, fraction, high), jnp.where(above, value, at_high)
        newton = fraction - value / jnp.where(slope > 0, slope, 1.0)
        closed = (high < jnp.inf) & (at_high > at_low)
        chord = low - at_low * jnp.where(closed, high - low, 1.0) / jnp.where(closed, at_high - at_low, 1.0)
        outside = jnp.where(closed, chord, 2 * fraction)
        fraction = jnp.where((newton > low) & (newton < high), newton, outside)
    return jnp.where(whole, 1.0, best)


def with_generous_budget(model: mjx.Model) -> mjx.Model:
    """Return the model with a budget large enough for MJX's solver to run until its cost stops decreasing."""
    tolerance = jnp.full_like(model.opt.tolerance, 1e-15)
    return model.replace(opt=model.opt.replace(iterations=GENEROUS[0], ls_iterations=GENEROUS[1], tolerance=tolerance))


def solve_to_rounding(model: mjx.Model, data: mjx.Data) -> Qvel:
    """Compute the constrained acceleration to rounding, ignoring the model's budgets; values only.

    MJX stops when its cost stops decreasing, within the square root of rounding of the solution, which is visible in
    finite differences. Newton steps on the equation itself have no such floor; diverging steps are rejected.
    """
    if num_constraint_rows(data) == 0:
        return data.qacc_smooth
    qacc = run_solver(with_generous_budget(model), data)

    def newton(x):
        """Newton step from x, and the distance of x from the solution in the dimensionless stiffness norm."""
        gap, linear_map = jax.linearize(lambda qacc: imbalance(model, data, qacc), x)
        step = x - _solve_linear(linear_map, gap) - x
        return step, jnp.abs(jnp.vdot(imbalance(model, data, x), step))

    terms = (mjx.mul_m(model, data, qacc), data.qfrc_smooth, constraint_force(model, data, qacc))
    rounding = EPSILON * sum(jnp.abs(term) for term in terms)
    floor = jnp.sum(rounding**2 / jnp.diag(mjx.full_m(model, data)))
    step, distance = newton(qacc)
    for _ in range(POLISHING_STEPS):
        candidate = qacc + step
        following, nearer = newton(candidate)
        better = nearer < jnp.maximum(distance, floor)  # below the floor, steps still follow small changes
        qacc, step, distance = (
            jnp.where(better, new, old) for new, old in ((candidate, qacc), (following, step), (nearer, distance))
        )
    return qacc


def solve(model: mjx.Model, data: mjx.Data, solver: Solver = run_solver) -> Qvel:
    """Constrained acceleration [m/s^2 or rad/s^2] with its implicit derivative, da = -G_a^{-1} G_x dx.

    Model and data, after `mjx.fwd_acceleration`, may be traced and differentiated, except for the warm start, to any
    order in any composition of forward and reverse mode.
    """
    if num_constraint_rows(data) == 0:
        return data.qacc_smooth
    traced, whole = traced_part((model, data))

    def found(traced: Any) -> Qvel:
        return solver(*jax.lax.stop_gradient(whole(traced)))

    def rule(primals: Any, changes: Any) -> tuple[Qvel, Qvel]:
        # Named, so that reverse mode saves it instead of running the solver again.
        qacc = checkpoint_name(root(*primals), "qacc")
        fixed, structure = jax.tree.flatten(primals)
        changes = structure.flatten_up_to(changes)

        def gap(moving: Any, qacc: Qvel) -> Qvel:
            leaves = [leaf if each is None else each for leaf, each in zip(fixed, moving, strict=True)]
            model, data = whole(*structure.unflatten(leaves))
            return imbalance(model, data, qacc)

        moving = [None if change is None else leaf for leaf, change in zip(fixed, changes, strict=True)]
        _, left = jax.jvp(lambda moving: gap(moving, qacc), (moving,), (changes,))
        return qacc, -_solve_linear(lambda change: jax.jvp(partial(gap, moving), (qacc,), (change,))[1], left)

    root = with_rule(found, rule)
    return root(traced)
