r"""Contact laws other than MuJoCo's: each prepares its model and advances a step, with a derivative of its own.

A contact model names its law; None is MuJoCo's, whose step is `dynamics.step`'s own. Hunt-Crossley, Kelvin-Voigt, log
barrier and cone are those of MuJoDiCo (the extra `laws`), a fork of MJX. With a distance phi (negative in contact), a
normal velocity v after the step h, and smoothing kappa, their normal impulses are

    Hunt-Crossley   h K relu(-phi - 2 h v) relu(1 - d v)      d [s/m]
    Kelvin-Voigt    h K (h + tau) relu(-phi / (h + tau) - v)  tau [s]
    log barrier     kappa / (v + phi / (h + tau))
    cone            complementary to v + phi / (h + tau) >= 0, up to kappa

with each relu rounded off by kappa. None of them has a jump in the state before the step, and all but the first brake
at a distance of (h + tau) |v|. K = 100 k / d_width^2, d = 0.1 b / d_width and tau = d_width b / k, where solref is
(-k, -b). With a pyramidal cone, each of its 2 (condim - 1) edges is a spring K.

A law of one's own is a subclass of `Law` in a module of its own, and an entry of `LAWS`.

Reference: MuJoDiCo 3.17, `solver_sap_util` and `solver_conic`; Castro et al. (arXiv 2110.10107), for the convex solve.
"""

import copy
import dataclasses
import functools
import importlib.util
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.integration import integrate_position
from mjx_study.simulation.scene import Scene

PACKAGE: Final = "mujodico"
INSTALL: Final = "needs MuJoDiCo: pip install 'mjx-study[laws]'"
STIFFNESS_SCALE: Final = 100.0  # MuJoDiCo's stiffness [N/m] over MuJoCo's k / d_width^2 [1/s^2]
BUDGET: Final = {"tolerance": 1e-13, "iterations": 50, "ls_tolerance": 1e-28, "ls_iterations": 8}
"""Of MuJoDiCo's solvers, whose derivative is only as good as their solution. With its line search run to 1e-12 J, as
the steps get small none of them is whole, and the last of 1e-12 m/s leaves as much."""
CONE_FLOOR: Final = 1e-14
"""In place of MuJoDiCo's 1e-8, in float64, with which the derivative of `conic` is off by 2e-3."""
FLOOR: Final = 1e-8
"""Of the k by which MuJoDiCo divides."""
FLAGS_OFF: Final = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)

Step = tuple[Array, Array, Array, Array, Array]
"""Positions, velocities and activations after a step, its acceleration, and the solver's residual, relative to the
forces and to the momentum over the timestep."""
Equations = Callable[..., tuple[Array, Array, Array, Array]]
"""From (model, qpos, qvel, act, control, qacc) to the left side of an equation in qacc with a symmetric Jacobian, and
the positions, velocities and activations after the step."""


@dataclasses.dataclass(frozen=True)
class Law(ABC):
    """A contact law; equal ones share compiled programs.

    Attributes:
        name: its contact family.
        smoothing: kappa; impulse times velocity at the rounded corner of a force [J].
    """

    name: str
    smoothing: float

    def __init_subclass__(cls) -> None:
        jax.tree_util.register_static(cls)

    @abstractmethod
    def solref(
        self, stiffness: float, damping: float | None, *, effective_mass: float, d_width: float, edges: int
    ) -> tuple[float, float]:
        """The (-k, -b) at which the law has a static stiffness [N/m] and damping [N s/m]; `edges` of the cone."""

    @abstractmethod
    def check(self, scene: Scene) -> None:
        """Raise ValueError, before anything is compiled, for a scene that the law does not carry."""

    @abstractmethod
    def step(self, scene: Scene, model: "LawModel", qpos: Array, qvel: Array, act: Array, control: Array) -> Step:
        """Advance by one timestep; differentiable in both modes."""

    def lead(self, solref: tuple[float, float], d_width: float, timestep: float) -> float:
        """Time before touch, at constant velocity, from which the law acts [s]; 0 if from touch on."""
        return 0.0

    def equations(self, scene: Scene) -> "Equations | None":
        """The equation that the acceleration solves, and the step at any; None if only `step` has the derivative."""
        return None


if TYPE_CHECKING:

    class LawModel(mjx.Model):
        """A model with a contact law other than MuJoCo's."""

        law: Law

else:  # made here, since checks at run time of a class statement's constructor would reject placeholders of JAX
    LawModel = type("LawModel", (mjx.Model,), {"__annotations__": {"law": Law}, "__module__": __name__})


def with_law(model: mjx.Model, law: Law) -> LawModel:
    """The model under a law."""
    return LawModel(**vars(model), law=law)


def make_law(name: str, smoothing: float) -> Law:
    """Create a law of `LAWS`; ValueError for a smoothing that is not positive."""
    if not 0 < smoothing < math.inf:
        raise ValueError(f"{name} needs a smoothing above 0: without, its values and derivatives are NaN")
    return LAWS[name](name, smoothing)


@dataclasses.dataclass(frozen=True)
class MujodicoLaw(Law):
    """A law of MuJoDiCo, by its name there, with its solver and implicit derivative."""

    def solref(
        self, stiffness: float, damping: float | None, *, effective_mass: float, d_width: float, edges: int
    ) -> tuple[float, float]:
        k = stiffness * d_width**2 / STIFFNESS_SCALE / edges
        if self.name == "hunt_crossley":
            if damping is not None:
                raise ValueError("hunt_crossley damps in proportion to its penetration, in s/m: omit the damping")
            return -k, -2 * math.sqrt(k)
        damping = 2 * math.sqrt(stiffness * effective_mass) if damping is None else damping
        return -k, -damping / stiffness * k / d_width  # tau = damping / stiffness

    def check(self, scene: Scene) -> None:
        _package(self.name)
        host, condims = scene.host, {int(dim) for dim in scene.template._impl.contact.dim}  # type: ignore[attr-defined]
        elliptic = host.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
        dry = host.dof_frictionloss.any() or host.tendon_frictionloss.any()
        lacking = {
            "RK4: choose the integrator euler or implicitfast": host.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4,
            "elliptic cones: choose --cone pyramidal": self.name in ("log_barrier", "conic")
            and elliptic
            and condims - {1},
            "frictionloss of joints and tendons: remove it": self.name == "conic" and dry,
        }
        for what, present in lacking.items():
            if present:
                raise ValueError(f"{self.name} does not support {what}")

    def step(self, scene: Scene, model: LawModel, qpos: Array, qvel: Array, act: Array, control: Array) -> Step:
        theirs, data = self._given(scene, model, qpos, qvel, act, control)
        data = _package(self.name).forward(theirs, data)
        mass, change = self._inertia(scene, theirs, data), jnp.stack([data.qacc, qvel / model.opt.timestep])
        terms = [*(change @ mass), data.qfrc_smooth, data.qfrc_constraint]
        gap = terms[0] - data.qfrc_smooth - data.qfrc_constraint
        residual = _norm(gap) / (sum(map(_norm, terms)) + jnp.finfo(qvel.dtype).tiny)
        return *self._integrated(scene, theirs, data), data.qacc, residual

    def lead(self, solref: tuple[float, float], d_width: float, timestep: float) -> float:
        if self.name == "hunt_crossley":
            return 2 * timestep
        first, second = solref
        tau = d_width * (second / first if first < 0 else 2 * first * second**2)
        return timestep + tau

    def equations(self, scene: Scene) -> Equations | None:
        """None where impulses are no functions of the velocity after the step: the cone's at limits and equalities."""
        rows: Any = scene.template._impl
        rigid = self.name == "conic" and rows.ne + rows.nl > 0
        return None if rigid else functools.partial(self._equations, scene)

    def _equations(
        self, scene: Scene, model: LawModel, qpos: Array, qvel: Array, act: Array, control: Array, qacc: Array
    ) -> tuple[Array, Array, Array, Array]:
        theirs, data = self._given(scene, model, qpos, qvel, act, control)
        own = _package(self.name)
        for stage in (own.fwd_position, own.fwd_velocity, own.fwd_actuation, own.fwd_acceleration):
            data = stage(theirs, data)
        mass, force = self._inertia(scene, theirs, data), jnp.zeros_like(qvel)
        if data._impl.efc_J.size:
            impulses = self._impulses(theirs, data, qvel + model.opt.timestep * qacc)
            force = data._impl.efc_J.T @ impulses / model.opt.timestep
        moved = self._integrated(scene, theirs, data.replace(qacc=qacc, qfrc_constraint=force))
        return mass @ qacc - data.qfrc_smooth - force, *moved

    def _impulses(self, theirs: Any, data: Any, after: Float[Array, " nv"]) -> Float[Array, " rows"]:
        """Impulses of constraint rows [N s or N m s] at a velocity after the step."""
        from mujodico.mjx._src import solver_sap

        if self.name != "conic":
            return solver_sap._calc_constraint_impulse(solver_sap.Context.create(theirs, data).replace(qvel=after))
        rows = data._impl
        tau = rows.efc_b / jnp.maximum(rows.efc_k, FLOOR)
        return self.smoothing / (rows.efc_J @ after + rows.efc_pos / (theirs.opt.timestep + tau))

    def _given(self, scene: Scene, model: LawModel, qpos: Array, qvel: Array, act: Array, control: Array) -> Any:
        """The package's model and data before a step."""
        theirs, template = _prepared(scene, self)
        theirs = _with_arrays_of(theirs.replace(opt=_with_arrays_of(theirs.opt, model.opt)), model)
        return theirs, template.replace(qpos=qpos, qvel=qvel, act=act, ctrl=control)

    def _inertia(self, scene: Scene, theirs: Any, data: Any) -> Float[Array, "nv nv"]:
        """The matrix that the package's solvers multiply accelerations with."""
        own = _package(self.name)
        mass = own.full_m(theirs, data)
        if _implicit(scene) and (slope := own.deriv_smooth_vel(theirs, data)) is not None:
            mass = mass - theirs.opt.timestep * slope
        return mass

    def _integrated(self, scene: Scene, theirs: Any, data: Any) -> tuple[Array, Array, Array]:
        own = _package(self.name)
        after = own.implicit(theirs, data) if _implicit(scene) else own.euler(theirs, data)
        # MJX's own integration loses the derivative of rotations at rest
        moved = integrate_position(scene.host, data.qpos, after.qvel, theirs.opt.timestep)
        return moved, after.qvel, after.act


def _implicit(scene: Scene) -> bool:
    return scene.host.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST


LAWS: Final[dict[str, type[Law]]] = dict.fromkeys(
    ("hunt_crossley", "kelvin_voigt", "log_barrier", "conic"), MujodicoLaw
)
"""Laws by the name of their contact family."""


def installed() -> bool:
    """Whether the laws' package is."""
    return importlib.util.find_spec(PACKAGE) is not None


def _norm(vector: Float[Array, " n"]) -> Float[Array, ""]:
    return jnp.sqrt(jax.lax.stop_gradient(vector @ vector))


def _package(name: str) -> Any:
    try:
        from mujodico import mjx as mujodico
    except ImportError as error:
        raise ValueError(f"{name} {INSTALL} ({error})") from None
    from mujodico.mjx._src import conic_solver

    if jax.config.values["jax_enable_x64"] and not isinstance(conic_solver.Context, functools.partial):
        # The derivative of the cone is one solve with a matrix that has 100 of these, relatively, on its diagonal
        conic_solver.Context = functools.partial(conic_solver.Context, _EPS=CONE_FLOOR)
    return mujodico


@functools.lru_cache(maxsize=32)
def _prepared(scene: Scene, law: Law) -> tuple[Any, Any]:
    """The law's model and data of a scene, with a budget to converge."""
    host = copy.copy(scene.host)
    host.opt.disableflags |= FLAGS_OFF
    for name, value in BUDGET.items():
        setattr(host.opt, name, value)
    mujodico = _package(law.name)
    with jax.ensure_compile_time_eval():
        model = mujodico.put_model(
            host, contact_approximation=law.name.replace("_", "-"), contact_smoothing=law.smoothing
        )
        data = mujodico.make_data(host)
        return model, jax.tree.map(lambda leaf: jnp.asarray(leaf) if isinstance(leaf, jax.Array) else leaf, data)


def _with_arrays_of(theirs: Any, ours: Any) -> Any:
    """A model or its options with the arrays and numbers that another has by the same name, but for budgets."""
    found = {}
    for field in dataclasses.fields(theirs):
        own, other = getattr(theirs, field.name), getattr(ours, field.name, None)
        given = isinstance(other, jax.Array | np.ndarray | float)
        if isinstance(own, jax.Array) and given and field.name not in BUDGET:
            found[field.name] = jnp.asarray(other)
    return theirs.replace(**found)
