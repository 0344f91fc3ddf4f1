"""Patches for MJX terms with correct values but wrong derivatives, reimplemented with safe branches.

A branch not taken still contributes to a derivative: if it is infinite or NaN, so is the result. And a norm has no
derivative at zero, where MJX sets it to zero, although a rotation vector computed from it is smooth. Values agree with
MJX to rounding; see `docs/gradient-faults.md`.
"""

import contextlib
import functools
import sys
from collections.abc import Callable, Generator, Mapping
from types import MappingProxyType
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float

from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.integration import rotate_quaternion, rotation_between
from mjx_study.simulation.linear_algebra import MOST_UNROLLED, cholesky, solve_factored, solve_positive_definite

_REFSAFE: Final = int(mujoco.mjtDisableBit.mjDSBL_REFSAFE)
_UNSEEN: Final = 1e-18  # [m]; its square is still a normal number, of 32 bits, too


def stiffness_damping_impedance(
    model: mjx.Model, solref: Float[Array, " 2"], solimp: Float[Array, " 5"], position: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Return stiffness k [1/s^2], damping b [1/s] and impedance d of a constraint row, as in MuJoCo.

    Differentiable where MJX is not: at a direct solref (-k, 0), in the power of solimp beyond the width, at noninteger
    powers, and at d_0 equal to d_width. The position of the row is in m or rad.

    Reference: MuJoCo documentation, Modeling, "Solver parameters".
    """
    low, high, width, midpoint, power = solimp
    low, high, midpoint = (jnp.clip(value, mujoco.mjMINIMP, mujoco.mjMAXIMP) for value in (low, high, midpoint))
    width, power = jnp.maximum(width, mujoco.mjMINVAL), jnp.maximum(power, 1.0)

    timeconst, dampratio = solref
    if not model.opt.disableflags & _REFSAFE:
        timeconst = jnp.maximum(timeconst, 2 * model.opt.timestep)
    direct_k, direct_b = solref[0] <= 0, solref[1] <= 0
    product = jnp.where(direct_k, 1.0, timeconst * dampratio)
    k = jnp.where(direct_k, -solref[0], 1 / product**2) / high**2
    b = jnp.where(direct_b, -solref[1], 2 / jnp.where(direct_b, 1.0, timeconst)) / high

    depth = jnp.abs(position) / width
    within, below = depth < 1, depth < midpoint
    rise = jnp.where(below, depth, midpoint) ** power / midpoint ** (power - 1)
    fall = jnp.where(within & ~below, 1 - depth, 1 - midpoint) ** power / (1 - midpoint) ** (power - 1)
    share = jnp.where(below, rise, 1 - fall)
    # MJX clips to [d_0, d_width], which has no effect between the two; the C engine interpolates between any two
    impedance = jnp.where(within, low + share * (high - low), high)
    return k, b, impedance


def _touching(model: mjx.Model, solref: Array, solimp: Array, position: Array) -> tuple[Array, Array, Array]:
    """The same for a row without penetration, whose spring exerts no force yet."""
    k, b, impedance = stiffness_damping_impedance(model, solref, solimp, jnp.zeros_like(position))
    return jnp.zeros_like(k), b, impedance


def _damper(model: mjx.Model, solref: Array, solimp: Array, position: Array) -> tuple[Array, Array, Array]:
    """The same with a damping of b, as in `simulation.contact`."""
    k, b, impedance = _touching(model, solref, solimp, position)
    return k, b * _width_impedance(solimp), impedance


def _spring(model: mjx.Model, solref: Array, solimp: Array, position: Array) -> tuple[Array, Array, Array]:
    """The same with a damping of sqrt(k s), as in `simulation.contact`."""
    k, _, impedance = stiffness_damping_impedance(model, solref, solimp, jnp.zeros_like(position))
    return jnp.zeros_like(k), jnp.sqrt(k * impedance * _width_impedance(solimp)), impedance


def _width_impedance(solimp: Array) -> Array:
    return jnp.clip(solimp[1], mujoco.mjMINIMP, mujoco.mjMAXIMP)


def rotation_vector(quaternion: Float[Array, " 4"]) -> tuple[Float[Array, " 3"], Float[Array, ""]]:
    """Return (rotation vector [rad], 1) instead of MJX's (axis, angle), of which MJX only uses the product."""
    still = jnp.zeros_like(quaternion).at[0].set(1.0)
    return rotation_between(still, quaternion), jnp.ones_like(quaternion[0])


def rotation_difference(end: Float[Array, " 4"], start: Float[Array, " 4"]) -> Float[Array, " 3"]:
    """Rotation vector [rad] from `start` to `end`; replaces MJX's `quat_sub`."""
    return rotation_between(start, end)


def mjx_module(name: str) -> Any:
    """A module of MJX's implementation, or the package `mujoco.mjx` for the empty name."""
    return sys.modules[f"{mjx.make_constraint.__module__.rpartition('.')[0]}.{name}"] if name else mjx


def springs_and_dampers(model: mjx.Model, data: mjx.Data) -> Float[Array, " nv"]:
    """MJX's spring and damper forces [N or N m] of joints and tendons, with tendon stiffness at the rest length.

    A spring with a single rest length rather than a range is linear; MJX composes it of two halves that both have zero
    derivative where they meet. The correction has zero value but nonzero derivative.
    """
    force = _ORIGINAL["passive", "_spring_damper"](model, data)
    if model.ntendon == 0 or model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_SPRING):
        return force
    shortest, longest = model.tendon_lengthspring.T
    linear = (shortest == longest) & (data.ten_length == shortest)
    stiffness = jnp.where(linear, model.tendon_stiffness, 0.0)
    rows: Any = data._impl
    return force + rows.ten_J.T @ (stiffness * (shortest - data.ten_length))


def contacts_with_friction(model: mjx.Model, data: mjx.Data) -> dict[Any, Any]:
    """MJX's contact parameters, with friction of at least MuJoCo's minimum, as in the C engine.

    Without it MJX drops elliptic contacts of zero friction, and the solver does not converge for pyramidal ones.
    """
    return {
        key: contact.replace(friction=jnp.maximum(contact.friction, mujoco.mjMINMU))
        for key, contact in _ORIGINAL["collision_driver", "_contact_groups"](model, data).items()
    }


def wrap_inside(
    end: Float[Array, " 4"], radius: Float[Array, ""], *rest: Any
) -> tuple[Float[Array, " 1"], Float[Array, " 4"]]:
    """MJX's path of a tendon inside a sphere or cylinder: (length along it or -1, contact points).

    The length is always 0; MJX takes the square root of its square, which has no derivative at 0. Here it is negligibly
    small instead, and differentiable. Where the tendon does not wrap, MJX's search ends in NaN, which reverse mode
    would spread: there it is given ends between which a tendon does.
    """
    original = _ORIGINAL["support", "wrap_inside"]
    wraps = original(end, radius, *rest)[0] >= 0
    elsewhere = 2 * radius * jnp.array([-1.0, 1.0, 1.0, 1.0], end.dtype)
    _, points = original(jnp.where(wraps, end, elsewhere), radius, *rest)
    return jnp.where(wraps, _UNSEEN, -1.0), jnp.where(wraps, points, 0.0)


def cylinder_distance(position: Float[Array, " 3"], size: Float[Array, " 3"]) -> Float[Array, ""]:
    """MJX's signed distance [m] of a point from a cylinder along z, with size (radius, half length, 0) [m].

    MJX places contacts by its gradient. For an inside point, the square root in its branch for outside points is at 0,
    so that gradient has no derivative in reverse mode.
    """
    height = position[2] * jnp.sign(position[2])  # its derivative at 0 is 0, as in MJX
    gaps = jnp.stack([_root(position[0] ** 2 + position[1] ** 2) - size[0], height - size[1]])
    inside = jnp.where(gaps[0] >= gaps[1], gaps[0], gaps[1])
    return jnp.where(inside < 0, inside, _root(jnp.sum(jnp.maximum(gaps, 0) ** 2)))


def _root(square: Float[Array, ""]) -> Float[Array, ""]:
    """Square root, with derivative 0 at 0."""
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def factored_inertia(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """MJX's factorisation of the inertia; dense ones use this project's, unrolled if small."""
    rows: Any = data._impl
    if rows.M.ndim != 2:
        return _ORIGINAL["smooth", "factor_m"](model, data)
    factored: Any = data.tree_replace({"_impl.qLD": cholesky(rows.M)})
    return factored


def solved_inertia(model: mjx.Model, data: mjx.Data, force: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """MJX's solution of M a = force, likewise; large ones from M, whose factor fills up in MJX's order."""
    rows: Any = data._impl
    if rows.M.ndim != 2:
        return _ORIGINAL["smooth", "solve_m"](model, data, force)
    large = model.nv > MOST_UNROLLED
    return solve_positive_definite(rows.M, force) if large else solve_factored(rows.qLD, force)


def body_tree(model: mjx.Model, of_body: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    """MJX's traversal of the body tree, with a barrier against fusion across levels.

    If fused, XLA recomputes a body's ancestors for each of their uses, in time exponential in the depth.
    """

    def of_level(carry: Any, *own: Any) -> Any:
        leaves, structure = jax.tree.flatten(carry)
        arrays = {index: leaf for index, leaf in enumerate(leaves) if isinstance(leaf, jax.Array)}
        apart = jax.lax.optimization_barrier(arrays) if arrays else {}
        return of_body(structure.unflatten(apart.get(index, leaf) for index, leaf in enumerate(leaves)), *own)

    return _ORIGINAL["scan", "body_tree"](model, of_level, *arguments, **named)


Place = tuple[str, str]
"""Module and name of an MJX function; the empty module is the package, whose names only callers of MJX use."""

_REPLACED: Final[dict[Place, Callable[..., Any]]] = {
    ("collision_driver", "_contact_groups"): contacts_with_friction,
    ("constraint", "_kbi"): stiffness_damping_impedance,
    ("math", "quat_integrate"): lambda start, velocity, timestep: rotate_quaternion(start, timestep * velocity),
    ("math", "quat_sub"): rotation_difference,
    ("math", "quat_to_axis_angle"): rotation_vector,
    ("passive", "_spring_damper"): springs_and_dampers,
    ("scan", "body_tree"): body_tree,
    ("support", "wrap_inside"): wrap_inside,
    ("collision_sdf", "_cylinder"): cylinder_distance,
    ("smooth", "factor_m"): factored_inertia,
    ("smooth", "solve_m"): solved_inertia,
}
_ORIGINAL: Final[dict[Place, Any]] = {place: getattr(mjx_module(place[0]), place[1], None) for place in _REPLACED}
"""MJX's own functions; `patched` checks that there are all of them."""
AT_FIRST_TOUCH: Final = {("constraint", "_kbi"): _touching}
"""Gives every active constraint row its values at first touch."""
DAMPER: Final = {("constraint", "_kbi"): _damper}
SPRING: Final = {("constraint", "_kbi"): _spring}
"""Makes every active row's reference acceleration minus its relaxation rate times its velocity."""

_CHOSEN: Final = jax.make_user_context(())
"""This thread's pairs of place and function; JAX retraces functions traced with others."""


@contextlib.contextmanager
def patched(also: Mapping[Place, Callable[..., Any]] = MappingProxyType({})) -> Generator[None]:
    """Patch MJX with this module's and other functions in everything that this thread traces inside.

    MJX has no hook for them, since they are called deep inside its pipeline. If a version of MJX lacks one of them,
    this raises rather than silently bringing back the fault. The first use leaves a branch in MJX at each place;
    outside of this context, and in other threads, it takes MJX's own function.

    Raises:
        RuntimeError: MJX lacks one of the functions.
    """
    chosen = {**_REPLACED, **also}
    for place in chosen:
        _branch_at(*place)
    with _CHOSEN(tuple(chosen.items())):
        yield


def _branch_at(module_name: str, name: str) -> None:
    module = mjx_module(module_name)
    original = getattr(module, name, None)
    if original is None:
        raise RuntimeError(f"this version of MJX has no {module.__name__}.{name}: adapt patches.py to it")
    if hasattr(original, "branches"):
        return

    @functools.wraps(original)
    def branch(*arguments: Any, **named: Any) -> Any:
        return dict(_CHOSEN.value).get((module_name, name), original)(*arguments, **named)

    branch.branches = True  # type: ignore[attr-defined]
    setattr(module, name, branch)
