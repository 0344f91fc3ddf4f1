"""Fit parameters of a model to recorded trajectories, and say which of them the records determine.

Parameters are positive, and fitted by their logarithms, so that all errors are relative. With residuals
r = (predicted - observed) / deviation, independent and normal at the true parameters, the Fisher information over the
logarithms is J^T J, J = dr / d log(values); its inverse bounds the covariance of any unbiased estimate.
"""

from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import minimize

from mjx_study.choices import unknown
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.drop_in import step
from mjx_study.simulation.dynamics import fwd_position

Values = Mapping[str, Any]
"""Parameters by name: numbers, or traced arrays without axes."""
Predict = Callable[[dict[str, Any]], Any]
"""Predictions from parameters, of the shape of the records."""
Numbers = np.ndarray | Array | float

DERIVATIVES: Final = ("exact", "smoothed", "none")
SPREAD: Final = 0.02  # standard deviation of the logarithms by which predictions are smoothed
_SLIDES_ONLY: Final = 2
"""MuJoCo's mark of bodies on slides along axes alone, whose inverse weight is that of their mass alone."""
DECREMENT: Final = 1e-3
"""A fit has converged if a full step would lower half the sum of squares by less: 0.04 standard errors away."""


class Identified(NamedTuple):
    """A fit to records.

    Attributes:
        values: the parameters.
        information: the Fisher information over their logarithms, in the order of `values`.
        misfit: sum of squared residuals in standard deviations; about `size` if model and deviations are right.
        size: how many residuals there are.
        predictions: how many predictions were made; a derivative over one parameter counts as one.
        converged: whether the search ended where its derivatives, or its simplex, expect no further gain.
    """

    values: dict[str, float]
    information: Float[np.ndarray, "p p"]
    misfit: float
    size: int
    predictions: int
    converged: bool

    @property
    def standard_errors(self) -> dict[str, float]:
        """Relative standard error of each parameter, all others being fitted too; inf where there is no information."""
        spread, basis = self.directions
        parts = np.multiply(spread[:, None], basis, out=np.zeros_like(basis), where=basis != 0)
        return dict(zip(self.values, np.sqrt((parts**2).sum(axis=0)).tolist(), strict=True))

    @property
    def directions(self) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p p"]]:
        """Standard errors along the information's eigenvectors, worst first, and these as rows, over the logarithms.

        A product of powers of the parameters whose error is above 1 is not identified.
        """
        found, basis = np.linalg.eigh(self.information)
        null = found <= 1e-12 * max(found[-1], 1e-300)
        return np.where(null, np.inf, 1 / np.sqrt(np.where(null, 1, found))), np.where(abs(basis.T) < 1e-6, 0, basis.T)


def trajectories(
    model: mjx.Model,
    data: mjx.Data,
    change: Callable[[mjx.Model, Values], mjx.Model],
    starts: tuple[Any, Any],
    steps: int,
    observe: Callable[[mjx.Data], Array] = lambda data: data.qpos,
    *,
    onset: str = "none",
) -> Predict:
    """Predict what is observed after each step of rollouts by `mjx_study.step`, with derivatives over parameters.

    Args:
        data: a state of the model, such as `mjx.make_data` returns.
        change: puts parameters into the model, such as `model.replace(geom_friction=...)`. Masses go in by
            `with_masses`, since `replace` leaves what MuJoCo derived from the old ones.
        starts: positions (tosses, nq) and velocities (tosses, nv) at which the rollouts begin; known, at time 0.
        observe: what is observed of a state.
        onset: "none" or "linear", as in `step`; "linear" where the step at which contact begins depends on parameters.
    """

    @jax.jit
    def predict(values: dict[str, Any]) -> Float[Array, "tosses steps ..."]:
        changed = change(model, values)

        def advance(data: mjx.Data, _: None) -> tuple[mjx.Data, Array]:
            following = step(changed, data, onset=onset)
            return following, observe(following)

        def toss(qpos: Array, qvel: Array) -> Array:
            return jax.lax.scan(advance, data.replace(qpos=qpos, qvel=qvel), length=steps)[1]

        return jax.vmap(toss)(*starts)

    return predict


def engine_trajectories(
    host: mujoco.MjModel,
    change: Callable[[mujoco.MjModel, Values], None],
    starts: tuple[Any, Any],
    steps: int,
    observe: Callable[[mujoco.MjData], np.ndarray] = lambda data: data.qpos.copy(),
) -> Predict:
    """`trajectories` by MuJoCo's C engine, without derivatives.

    Args:
        change: puts parameters into the model, in place; what depends on masses is computed again.
        starts: as in `trajectories`.
    """

    def predict(values: dict[str, Any]) -> Float[np.ndarray, "tosses steps ..."]:
        change(host, values)
        data, observed = mujoco.MjData(host), []
        mujoco.mj_setConst(host, data)
        for qpos, qvel in zip(*starts, strict=True):
            mujoco.mj_resetData(host, data)
            data.qpos[:], data.qvel[:] = qpos, qvel
            for _ in range(steps):
                mujoco.mj_step(host, data)
                observed.append(observe(data))
        return np.reshape(observed, (-1, steps, *np.shape(observed[0])))

    return predict


def with_masses(model: mjx.Model, data: mjx.Data, mass: Float[Array, " nbody"]) -> mjx.Model:
    """Replace the bodies' masses [kg], scale their inertias in proportion, and derive again what depends on them.

    Contact and limits are scaled by inverse weights at `qpos0`, which `model.replace(body_mass=...)` leaves as they
    were, and so the contact's stiffness. Not derived again: `actuator_acc0` (of muscles without a given force).

    Args:
        data: a state of the model, such as `mjx.make_data` returns.
    """
    factor = mass / jnp.where(model.body_mass > 0, model.body_mass, 1)
    model = model.replace(body_mass=mass, body_inertia=model.body_inertia * factor[:, None])
    data = fwd_position(model, data.replace(qpos=jnp.asarray(model.qpos0)))
    inverse = jnp.linalg.inv(mjx.full_m(model, data))

    def weight(jacobian: Array) -> Array:
        return jnp.trace(jacobian.T @ inverse @ jacobian) / 3

    of_bodies, within = [], np.eye(model.nbody, dtype=bool)
    for body in range(model.nbody - 1, 0, -1):
        within[model.body_parentid[body]] |= within[body]
    for body in range(model.nbody):
        move, turn = (weight(jacobian) for jacobian in mjx.jac(model, data, data.xipos[body], jnp.array(body)))
        if model.body_simple[body] == _SLIDES_ONLY:
            move = 1 / mass[body]
        of_bodies.append(jnp.stack([move, turn]))
    of_dofs = jnp.diag(inverse)
    for kind, start in zip(model.jnt_type, model.jnt_dofadr, strict=True):
        sizes = {mujoco.mjtJoint.mjJNT_FREE: 2, mujoco.mjtJoint.mjJNT_BALL: 1}.get(mujoco.mjtJoint(kind), 0)
        for first in range(start, start + 3 * sizes, 3):
            of_dofs = of_dofs.at[first : first + 3].set(of_dofs[first : first + 3].mean())
    tendons: Any = data._impl
    return model.replace(
        body_subtreemass=within @ mass,
        body_invweight0=jnp.stack(of_bodies),
        dof_invweight0=of_dofs,
        tendon_invweight0=jnp.einsum("ti,ij,tj->t", tendons.ten_J, inverse, tendons.ten_J),
    )


def identify(
    predict: Predict,
    observed: Numbers,
    deviation: Numbers,
    guess: Values,
    *,
    derivatives: str = "exact",
    iterations: int = 60,
    seed: int = 0,
) -> Identified:
    """Fit positive parameters to records by weighted least squares.

    Args:
        predict: what would be observed, as from `trajectories` or `engine_trajectories`.
        observed: the records.
        deviation: standard deviations of their noise, broadcast to them; inf leaves a record out.
        guess: where the search starts; all must be positive.
        derivatives: "exact" (of `predict`, a function of JAX, by forward mode) or "smoothed" (zeroth order: slopes of a
            regression on predictions at random antithetic parameters about the current ones, two pairs per parameter)
            for Levenberg and Marquardt's search; "none" for Nelder and Mead's. Without exact derivatives, the
            information is that of smoothed ones.
        iterations: of the search at most; 0 leaves the guess, and computes the information there. For "none", 100 times
            as many predictions.
        seed: of the random parameters.

    Raises:
        ValueError: unknown derivatives, or a guess that is not positive.
    """
    if derivatives not in DERIVATIVES:
        raise ValueError(unknown("derivatives of a fit", derivatives, DERIVATIVES))
    if wrong := [name for name, value in guess.items() if not 0 < value < np.inf]:
        raise ValueError(f"parameters are fitted by their logarithms, {', '.join(wrong)} must be positive and finite")
    problem = _Problem(predict, observed, deviation, tuple(guess), seed)
    slopes = problem.exact if derivatives == "exact" else problem.smoothed
    point = np.log([float(value) for value in guess.values()])
    if derivatives == "none":
        simplex = point + np.vstack([np.zeros_like(point), 0.1 * np.eye(len(point))])
        options = {"initial_simplex": simplex, "maxfev": 100 * iterations, "xatol": 1e-4, "fatol": DECREMENT}
        found = minimize(lambda at: 0.5 * _squares(problem.residuals(at)), point, method="Nelder-Mead", options=options)
        point, residuals, converged = found.x, problem.residuals(found.x), bool(found.success)
        jacobian = slopes(point)
    else:
        point, residuals, jacobian, converged = _descend(problem.residuals, slopes, point, iterations)
    values = dict(zip(guess, np.exp(point).tolist(), strict=True))
    size = int(np.isfinite(problem.deviation).sum())
    return Identified(values, jacobian.T @ jacobian, _squares(residuals), size, problem.predictions, converged)


def profile(
    predict: Predict, observed: Numbers, deviation: Numbers, fit: Identified, name: str, grid: Any, **search: Any
) -> Float[np.ndarray, " points"]:
    """Profile of one parameter: the misfit at each of its values with all others fitted again, less that of the fit.

    Values at which it is below 3.84 are a 95 % interval. `search` are options of `identify`, such as `derivatives`.
    """
    others = {key: value for key, value in fit.values.items() if key != name}

    def misfit(at: Array) -> float:
        fixed = lambda values: predict({**values, name: at})  # noqa: E731
        if others:
            return identify(fixed, observed, deviation, others, **search).misfit
        return _squares(_Problem(fixed, observed, deviation).residuals(np.zeros(0)))

    return np.array([misfit(at) for at in jnp.asarray(grid, float)]) - fit.misfit


def _squares(residuals: Float[np.ndarray, " n"]) -> float:
    total = float(residuals @ residuals)
    return total if np.isfinite(total) else np.inf


def _in_deviations(numbers: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Numbers in standard deviations; 0 where these are inf, as the record left out may be NaN."""
    return np.divide(numbers, deviation, out=np.zeros(numbers.shape), where=np.isfinite(deviation))


class _Problem:
    """Residuals in standard deviations, and their derivatives over the logarithms of parameters."""

    def __init__(
        self, predict: Predict, observed: Numbers, deviation: Numbers, names: tuple[str, ...] = (), seed: int = 0
    ) -> None:
        self.observed = np.asarray(observed, float)
        self.deviation = np.broadcast_to(np.asarray(deviation, float), self.observed.shape)
        self.predictions, self._rng, self._predict = 0, np.random.default_rng(seed), predict
        self._named = lambda point: {name: jnp.exp(point[index]) for index, name in enumerate(names)}
        self._slopes = jax.jacfwd(lambda point: predict(self._named(point)))

    def residuals(self, point: Float[np.ndarray, " p"]) -> Float[np.ndarray, " n"]:
        self.predictions += 1
        gap = np.asarray(self._predict(self._named(np.asarray(point)))) - self.observed
        return _in_deviations(gap, self.deviation).ravel()

    def exact(self, point: Float[np.ndarray, " p"]) -> Float[np.ndarray, "n p"]:
        self.predictions += len(point)
        slopes = np.asarray(self._slopes(jnp.asarray(point)))
        return _in_deviations(slopes, self.deviation[..., None]).reshape(-1, len(point))

    def smoothed(self, point: Float[np.ndarray, " p"]) -> Float[np.ndarray, "n p"]:
        shifts = SPREAD * self._rng.standard_normal((2 * len(point), len(point)))
        changes = [0.5 * (self.residuals(point + shift) - self.residuals(point - shift)) for shift in shifts]
        return np.linalg.lstsq(shifts, np.array(changes))[0].T


def _descend(
    residuals: Callable[[np.ndarray], np.ndarray],
    slopes: Callable[[np.ndarray], np.ndarray],
    point: np.ndarray,
    iterations: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, bool]:
    """Levenberg and Marquardt's search; returns point, residuals, derivatives and whether it converged."""
    damping, found = 1e-3, residuals(point)
    jacobian = slopes(point)
    for _ in range(iterations):
        curvature, descent = jacobian.T @ jacobian, -jacobian.T @ found
        scale = np.diag(np.maximum(np.diag(curvature), 1e-12 * max(np.diag(curvature).max(), 1e-300)))
        if descent @ np.linalg.pinv(curvature, rcond=1e-10, hermitian=True) @ descent < 2 * DECREMENT:
            return point, found, jacobian, True
        while damping < 1e9:
            trial = point + np.clip(np.linalg.solve(curvature + damping * scale, descent), -1, 1)
            if _squares(there := residuals(trial)) < _squares(found):
                break
            damping *= 4
        else:
            return point, found, jacobian, False
        point, found, damping = trial, there, damping / 8
        jacobian = slopes(point)
    return point, found, jacobian, False
