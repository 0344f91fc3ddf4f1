r"""States as costs see them: with positions, orientations and velocities of bodies, contact forces and sensors.

Nothing is computed until it is asked for. Positions and velocities need kinematics alone; contact forces and sensors of
forces and accelerations need the constrained acceleration, and with it about as much as a step. They are those that act
during the step from the state under its control, as `mj_forward` computes them in C.

All are differentiable: positions and velocities through MJX's kinematics (as graphs for small models, see
`mjx_study.graph`), forces through the implicit derivative of the acceleration as well.
"""

import dataclasses
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from estimators.choices import suggestion
from estimators.pytree import register_pytree
from mjx_study.simulation import constraint
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.contact import ContactModel, apply_contact, contact_pair, has_mujoco_law
from mjx_study.simulation.dynamics import Act, Control, Qpos, State, acceleration, entry_by_entry, smooth_stages
from mjx_study.simulation.patches import patched
from mjx_study.simulation.scene import Scene

POSITIONS: Final = {
    "xpos": "positions of body frames [m], (nbody, 3)",
    "xquat": "orientations of bodies, unit quaternions, (nbody, 4)",
    "xmat": "orientations of bodies, rotation matrices, (nbody, 3, 3)",
    "xipos": "centres of mass of bodies [m], (nbody, 3)",
    "ximat": "orientations of the bodies' principal axes of inertia, (nbody, 3, 3)",
    "geom_xpos": "positions of geoms [m], (ngeom, 3)",
    "geom_xmat": "orientations of geoms, (ngeom, 3, 3)",
    "site_xpos": "positions of sites [m], (nsite, 3)",
    "site_xmat": "orientations of sites, (nsite, 3, 3)",
    "subtree_com": "centres of mass of bodies with all their descendants [m], (nbody, 3)",
}
VELOCITIES: Final = {
    "cvel": "velocities of bodies, (nbody, 6): angular [rad/s], then linear where the tree's centre of mass is [m/s]",
    "xlinvel": "linear velocities of body frames [m/s], as by the sensor framelinvel, (nbody, 3)",
    "xangvel": "angular velocities of bodies [rad/s], as by the sensor frameangvel, (nbody, 3)",
    "xilinvel": "linear velocities of the bodies' centres of mass [m/s], (nbody, 3)",
    "geom_xlinvel": "linear velocities of geoms' centres [m/s], (ngeom, 3)",
    "geom_xangvel": "angular velocities of geoms [rad/s], (ngeom, 3)",
    "site_xlinvel": "linear velocities of sites [m/s], (nsite, 3)",
    "site_xangvel": "angular velocities of sites [rad/s], (nsite, 3)",
}
FORCES: Final = {
    "sensordata": "outputs of all sensors, (nsensordata,)",
    "contact_force(first, second)": "force of the second geom on the first, over all their contacts [N], (3,)",
}
QUANTITIES: Final = POSITIONS | VELOCITIES | FORCES
"""What costs may ask a state for besides qpos, qvel and act, all in the world frame; rows are in the model's order."""
_POINTS: Final = {"x": "xpos", "xi": "xipos", "geom_x": "geom_xpos", "site_x": "site_xpos"}
"""Points whose velocities the quantities with these prefixes are."""
_UNKNOWN: Final = {
    int(mujoco.mjtSensor.mjSENS_CLOCK): "clock",
    int(mujoco.mjtSensor.mjSENS_TACTILE): "tactile",
    int(mujoco.mjtSensor.mjSENS_CONTACT): "contact",
}
"""Kinds of sensors that a state does not determine, that MJX leaves at zero, and that it takes from other geoms."""
_LATE: Final = int(mujoco.mjtStage.mjSTAGE_ACC)


@partial(register_pytree, static=("scene",))
@dataclasses.dataclass(frozen=True)
class ObservedState(State):
    """A `State` that also computes any of `QUANTITIES` of its scene, when asked for it.

    Leading axes of the state are axes of the quantities.

    Attributes:
        scene: the scene, whose `body`, `geom`, `site` and `sensor` return indices into the quantities.
        contact: the contact model under which forces act; None for the MJCF's.
        control: controls during the step from the state; None if unknown, which leaves forces unknown.

    Raises:
        AttributeError: the scene has no such quantity.
        ValueError: without a control, a force or a sensor of forces or accelerations of a model with actuators; with
            leading axes, or a contact law other than MuJoCo's, any force; or a sensor that no state determines.
    """

    scene: Scene
    contact: ContactModel | None = None
    control: Float[Array, "*batch nu"] | None = None

    def __getattr__(self, name: str) -> Float[Array, "..."]:
        if name not in QUANTITIES:
            known = ["qpos", "qvel", "act", *QUANTITIES]
            raise AttributeError(f"a state has {', '.join(known)}, but no {name!r}{suggestion(name, known)}")
        found = self._sensors() if name == "sensordata" else self._motion(name)
        traces = {_trace_of(leaf) for leaf in jax.tree.leaves(self)}
        if _trace_of(found) in {None, *traces}:  # otherwise it is of a program that this state outlives
            object.__setattr__(self, name, found)  # so that it is computed once
        return found

    def contact_force(self, first: str | int, second: str | int) -> Float[Array, " 3"]:
        """Force [N] of the second geom on the first, given by names or indices, in the world frame.

        ValueError if the two are never tested for collision.
        """
        one, other = (self.scene.geom(geom) if isinstance(geom, str) else int(geom) for geom in (first, second))
        contact_pair(self.scene, one, other)  # which refuses those that never collide
        return self._forced("contact_force", partial(_contact_force, (one, other)))

    def _motion(self, name: str) -> Float[Array, "..."]:
        inputs = (self.qpos,) if name in POSITIONS else (self.qpos, self.qvel)
        function = partial(entry_by_entry, partial(_motion, self.scene, name), self.scene.model)
        for _ in range(self.qpos.ndim - 1):
            function = jax.vmap(function)
        return function(*inputs)

    def _sensors(self) -> Float[Array, " nsensordata"]:
        host = self.scene.host
        if found := [_UNKNOWN[kind] for kind in host.sensor_type.tolist() if kind in _UNKNOWN]:
            raise ValueError(
                f"sensordata of {self.scene.name} has no {found[0]} sensor; remove it from the MJCF, or ask for "
                "contact_force(first, second)"
            )
        if host.sensor_delay.any() or host.sensor_interval.any():
            raise ValueError(f"sensordata of {self.scene.name} has no delay or interval; remove them from the MJCF")
        late = bool((host.sensor_needstage == _LATE).any())
        return self._forced("sensordata", _sensordata, needed=late)

    def _forced(self, what: str, function: Any, needed: bool = True) -> Float[Array, "..."]:
        """A function of the model and of the data of `mj_forward`, whose acceleration is zero unless needed."""
        host, control = self.scene.host, self.control
        if self.qpos.ndim > 1:
            raise ValueError(f"{what} is computed for single states: map over them with jax.vmap")
        if control is None and needed and host.nu:
            raise ValueError(
                f"{what} depends on the control, which only the running_cost is given: ask for it there, or for "
                "positions and velocities here"
            )
        if needed and not has_mujoco_law(self.contact):
            raise ValueError(
                f"{what} has forces of MuJoCo's law: it is unknown for another, ask for what moves instead"
            )
        control = jnp.zeros(host.nu, self.qpos.dtype) if control is None else control
        model = apply_contact(self.scene.model, self.contact)
        state = State(self.qpos, self.qvel, self.act, self.warmstart)
        qacc = acceleration(self.scene, model, state, control) if needed else jnp.zeros_like(self.qvel)
        point = self.qpos, self.qvel, self.act, control, qacc
        return entry_by_entry(partial(_forward, self.scene, function), model, *point)


def observed(
    scene: Scene, state: State, contact: ContactModel | None = None, control: Float[Array, "*batch nu"] | None = None
) -> ObservedState:
    """Return a state of a scene with its `QUANTITIES`; see `ObservedState` for the arguments."""
    return ObservedState(state.qpos, state.qvel, state.act, state.warmstart, scene, contact, control)


def _trace_of(value: Any) -> Any:
    """The trace that a value belongs to; None of an array."""
    return getattr(value, "_trace", None)


@jax.jit
def _moving(model: mjx.Model, data: mjx.Data, qpos: Qpos, qvel: Array) -> mjx.Data:
    """Positions and velocities of bodies; jitted so that JAX traces them once for all quantities."""
    with patched():
        data = mjx.com_pos(model, mjx.kinematics(model, data.replace(qpos=qpos, qvel=qvel)))
        return mjx.com_vel(model, data)


def _motion(scene: Scene, name: str, model: mjx.Model, qpos: Qpos, qvel: Array | None = None) -> Float[Array, "..."]:
    """A quantity of positions, or with qvel of velocities."""
    data = _moving(model, scene.template, qpos, scene.template.qvel if qvel is None else qvel)
    if name in POSITIONS:
        return getattr(data, name)
    if name == "cvel":
        return data.cvel
    return _velocity(scene.host, data, name)


def _velocity(host: mujoco.MjModel, data: mjx.Data, name: str) -> Float[Array, "rows 3"]:
    """Angular velocity, or linear velocity at the quantity's points."""
    prefix = name.removesuffix("angvel").removesuffix("linvel")
    owners = {"geom_x": host.geom_bodyid, "site_x": host.site_bodyid}
    body = np.asarray(owners.get(prefix, np.arange(host.nbody)))
    angular, linear = data.cvel[body, :3], data.cvel[body, 3:]
    if name.endswith("angvel"):
        return angular
    offset = getattr(data, _POINTS[prefix]) - data.subtree_com[host.body_rootid[body]]
    return linear + jnp.cross(angular, offset)


def _sensordata(model: mjx.Model, data: mjx.Data) -> Float[Array, " nsensordata"]:
    with patched():
        for stage in (mjx.sensor_pos, mjx.sensor_vel, mjx.sensor_acc):
            data = stage(model, data)
    return data.sensordata


def _contact_force(pair: tuple[int, int], model: mjx.Model, data: mjx.Data) -> Float[Array, " 3"]:
    geoms, forces = constraint.contact_forces(model, data)
    on_second = jnp.all(geoms == jnp.array(pair[::-1]), axis=1)
    on_first = jnp.all(geoms == jnp.array(pair), axis=1)
    sign = on_second.astype(forces.dtype) - on_first.astype(forces.dtype)
    return sign @ forces


def _forward(
    scene: Scene, read: Any, model: mjx.Model, qpos: Qpos, qvel: Array, act: Act, control: Control, qacc: Array
) -> Float[Array, "..."]:
    """`read` of the model and all of a step but the integration, as `mj_forward` does it."""
    state = State(qpos, qvel, act, jnp.zeros_like(qvel))
    return read(model, constraint.with_forces(model, smooth_stages(scene, model, state, control), qacc))
