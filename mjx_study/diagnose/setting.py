"""The setting for which a diagnosis holds: the noise, what it is added to, and the rollout."""

import dataclasses

import mujoco

from mjx_study.choices import is_file
from mjx_study.tasks.task import Task

_SLIDE, _HINGE = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)


@dataclasses.dataclass(frozen=True)
class Setting:
    """The setting for which a diagnosis holds.

    Attributes:
        noise: name of the noise density.
        sigma: standard deviation of the noise.
        sigma_unit: unit of sigma; empty if it is not known.
        added_to: what the noise is added to.
        timestep: timestep [s].
        horizon: number of steps.
        params: number of parameters.
    """

    noise: str
    sigma: float
    sigma_unit: str
    added_to: str
    timestep: float
    horizon: int
    params: int

    @property
    def level(self) -> str:
        return f"sigma = {self.sigma:g} {self.sigma_unit}".rstrip()

    def line(self) -> str:
        unit = "" if self.sigma_unit else " (in its unit)"
        parameters = f"{self.params} parameter{'' if self.params == 1 else 's'}"
        return (
            f"{self.noise} noise of {self.level}, added to {self.added_to}{unit}; {parameters}; "
            f"{self.horizon} steps of {self.timestep:g} s"
        )


def setting_of(subject: str, task: Task) -> Setting:
    host = task.scene.host
    if not task.policy.at_start:
        added_to, units = "every control", {_unit_of_control(host, index) for index in range(host.nu)}
    else:
        added_to = "the initial velocities" if is_file(subject) else "theta"
        units = {getattr(task.policy, "unit", "")}
    unit = "" if "" in units else " or ".join(sorted(units))
    return Setting(task.noise, task.sigma, unit, added_to, task.scene.timestep, task.horizon, task.policy.num_params)


def _unit_of_control(host: mujoco.MjModel, index: int) -> str:
    """Unit of a motor's or servo's control; empty for other actuators, or if a gain or gear scales it."""
    kind = host.jnt_type[host.actuator_trnid[index, 0]] if host.actuator_trntype[index] == 0 else None
    gain, bias = host.actuator_gainprm[index, 0], host.actuator_biasprm[index, :3].tolist()
    if kind not in (_SLIDE, _HINGE) or host.actuator_gear[index, 0] != 1 or host.actuator_dyntype[index]:
        return ""
    units = {(1.0, 0.0, 0.0): ("N", "N m"), (gain, -gain, bias[2]): ("m", "rad"), (gain, 0.0, -gain): ("m/s", "rad/s")}
    plain = host.actuator_gaintype[index] == 0 and host.actuator_biastype[index] in (0, 1) and bias[0] == 0
    return units.get((gain, *bias[1:]), ("", ""))[int(kind == _HINGE)] if plain else ""
