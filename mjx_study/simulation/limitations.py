"""Features that MJX 3.17 silently ignores, so that motion would differ from the C engine.

Each was found by comparing single steps of MJX and C; see `docs/gradient-faults.md`.
"""

import dataclasses
from typing import Final

import mujoco


@dataclasses.dataclass(frozen=True)
class Flag:
    """An MJCF <flag>: a bit of `enableflags`, or of `disableflags`, where it means "disabled"."""

    bit: int
    optional: bool

    def disable(self, option: mujoco.MjOption) -> None:
        """Disable the flag in place, as `disable` does in an MJCF."""
        if self.optional:
            option.enableflags &= ~self.bit
        else:
            option.disableflags |= self.bit

    def disabled(self, option: mujoco.MjOption) -> bool:
        return not option.enableflags & self.bit if self.optional else bool(option.disableflags & self.bit)


FLAGS: Final = {
    name.removeprefix(prefix).lower(): Flag(int(bit), optional)
    for prefix, bits, optional in (("mjDSBL_", mujoco.mjtDisableBit, False), ("mjENBL_", mujoco.mjtEnableBit, True))
    for name, bit in bits.__members__.items()
    if name.startswith(prefix)
}
_LACKING: Final = ("override", "energy", "fwdinv", "sleep", "diagexact")
_IMPLICITFAST: Final = mujoco.mjtIntegrator.mjINT_IMPLICITFAST


def lacking(host: mujoco.MjModel) -> list[str]:
    """Names of enabled flags that MJX rejects or, like `sleep`, ignores."""
    return [name for name in _LACKING if not FLAGS[name].disabled(host.opt)]


def ignored(host: mujoco.MjModel) -> list[str]:
    """Features of a model that MJX would ignore, each with a remedy."""
    off = {name for name, flag in FLAGS.items() if flag.disabled(host.opt)}
    implicitfast = host.opt.integrator == _IMPLICITFAST
    drag = host.opt.density > 0 or host.opt.viscosity > 0
    muscles = host.actuator_gaintype == mujoco.mjtGain.mjGAIN_MUSCLE
    groups_off = [bool(host.opt.disableactuator & 1 << group) for group in host.actuator_group if 0 <= group < 31]
    features = {
        "noslip_iterations (set it to 0)": host.opt.noslip_iterations > 0,
        "plugins of actuators, bodies or geoms (replace them)": any(
            (owner >= 0).any() for owner in (host.actuator_plugin, host.body_plugin, host.geom_plugin)
        ),
        "actuators' delay (remove it)": host.actuator_delay.any(),
        "actuators' actearly (set it to false)": host.actuator_actearly.any(),
        "actuators' damping and armature (give them to the joints)": (
            host.actuator_damping.any() or host.actuator_dampingpoly.any() or host.actuator_armature.any()
        ),
        "actuatorgroupdisable (remove the actuators)": any(groups_off),
        "muscles' damping under implicitfast (use --integrator euler)": implicitfast and muscles.any(),
        "polynomial stiffness or damping (give one coefficient)": (
            host.jnt_stiffnesspoly.any()
            or host.dof_dampingpoly.any()
            or host.tendon_stiffnesspoly.any()
            or host.tendon_dampingpoly.any()
        ),
        "adhesion of geoms (remove it)": host.geom_adhesion.any() or host.pair_adhesion.any(),
        "surfacevel (remove it)": host.geom_surfacevel.any(),
        'fluidshape="ellipsoid" (remove it)': drag and host.geom_fluid[:, 0].any(),
        "all passive forces, as the flag spring or damper is disabled (set stiffness or damping to 0 instead)": (
            _loses_passive_forces(host, off, drag)
        ),
        "the flag damper, which MJX's implicit damping in Euler does not heed (disable eulerdamp, too)": (
            {"damper", "eulerdamp"} & off == {"damper"} and not implicitfast and host.dof_damping.any()
        ),
    }
    return [feature for feature, present in features.items() if present]


def _loses_passive_forces(host: mujoco.MjModel, off: set[str], drag: bool) -> bool:
    """With springs or dampers disabled, MJX drops all passive forces, the C engine only these."""
    springs = host.jnt_stiffness.any() or host.tendon_stiffness.any()
    dampers = host.dof_damping.any() or host.tendon_damping.any()
    others = drag or (host.body_gravcomp.any() and "gravity" not in off)
    return ("spring" in off) != ("damper" in off) and bool(others or (dampers if "spring" in off else springs))
