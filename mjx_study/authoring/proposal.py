"""Numbers of a task proposed for a model: horizon, noise, goal, contact pair, stiffnesses and learning rate."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Final

import mujoco
import numpy as np

from mjx_study.authoring.aim import Aim, choose_aim, rounded
from mjx_study.authoring.trial import MOST_TRIED, SECONDS, Drive, Touch, Trial, moments_of, run_trial, start_of
from mjx_study.simulation.contact import effective_mass
from mjx_study.simulation.scene import Scene

TRIALS: Final = 16  # test rollouts with noise, and as many with held controls
NOISE: Final = 0.1  # share of half a control's range or of its substitute, or [m/s, rad/s] of velocities
LIFTING: Final = 2.0  # half range of a motor that has none, in controls that hold the model against gravity
HELD: Final = 10  # largest held change, in standard deviations of the noise: the whole range of a control
USUAL: Final = 0.5  # shortest duration of a rollout, if `MOST` steps allow it [s]
FEWEST, MOST = 20, 300  # numbers of steps of a rollout
SINKING: Final = 0.2
"""Greatest depth of a contact at the lowest stiffness, as a share of the smaller geom's least half size."""
RESOLVED: Final = 0.5
"""h sqrt(K / m) at the highest stiffness: 13 steps in a contact's period; a critically damped one is stable to 0.83."""
STIFFNESSES: Final = 4
WEIGHT: Final = 0.01  # cost of holding all controls at their largest change
ITERATIONS, SAMPLES = 100, 20
PACE: Final = 0.3
"""Learning rate of Adam, in standard deviations of the noise: about the most that it moves a parameter in an iteration,
whatever the variance of gradients through contact."""


@dataclasses.dataclass(frozen=True)
class Load:
    """What a contact carries: effective mass [kg], approach speed at first touch [m/s], weight of the bodies that move
    [N]; and the least half size of the geoms [m]."""

    mass: float
    speed: float
    weight: float
    size: float

    def depth(self, stiffness: float) -> float:
        """Depth [m] to which impact or weight, whichever is more, presses a spring without damping."""
        return max(self.speed * math.sqrt(self.mass / stiffness), self.weight / stiffness)

    def stiffness(self, depth: float) -> float:
        """Stiffness [N/m] at which they press it to a depth [m]."""
        return max(self.mass * (self.speed / depth) ** 2, self.weight / depth)


@dataclasses.dataclass(frozen=True)
class Proposal:
    """A task for a scene.

    Attributes:
        touches: pairs of geoms in contact in any test rollout, with the earliest touch of each.
        limits: names of joints that reach a limit.
        pair: names of the geoms whose contact is swept; None without one that has names.
        load: what that contact carries; None without one.
        stiffnesses: of that contact [N/m]; empty without one.
    """

    scene: Scene = dataclasses.field(repr=False)
    drive: Drive = dataclasses.field(repr=False)
    horizon: int
    aim: Aim
    touches: dict[tuple[int, int], Touch]
    limits: tuple[str, ...]
    pair: tuple[str, str] | None
    load: Load | None
    stiffnesses: tuple[float, ...]

    @property
    def learning_rate(self) -> float:
        """Of descents by Adam, in the unit of the parameters."""
        return rounded(PACE * self.drive.scale, 1)

    @property
    def damping(self) -> float:
        """Half of the critical damping at the second highest stiffness [N s/m]; 0 without a swept contact."""
        return 0.0 if self.load is None else rounded(math.sqrt(self.load.mass * self.stiffnesses[-2]), 1)


def propose(scene: Scene) -> Proposal:
    """Propose a task from test rollouts with MuJoCo's contact, which take a second or so.

    Raises:
        ValueError: nothing in the scene can move or is moved by noise, or its motion is not finite.
    """
    host = scene.host
    if host.nv == 0:
        raise ValueError(f"{scene.name} has no degree of freedom: there is nothing to study")
    drive = _drive(host)
    quiet = run_trial(drive, np.zeros((1, drive.size)), _longest(host))
    if quiet.steps < _longest(host):
        raise ValueError(
            f"{scene.name}: the state is not finite after step {quiet.steps} of a test rollout in C; mend its MJCF "
            "first, by a smaller timestep, armature, or the integrator implicitfast: mjx-study rollout shows the motion"
        )
    steps = _horizon(host, quiet)
    aim, noisy, held = None, [], []
    while aim is None and steps >= FEWEST:
        noisy, held = _trials(drive, steps)
        aim = choose_aim(drive, quiet, noisy, held, steps) if len(noisy) > 1 and len(held) > 1 else None
        steps = steps if aim else steps // 2  # the motion may have come to rest
    if aim is None:
        changes = "initial velocities" if drive.at_start else "controls"
        raise ValueError(f"{scene.name}: noise on its {changes} of {drive.scale:g} moves nothing; give it room to move")
    rollouts = [run_trial(drive, np.zeros((1, drive.size)), steps), *noisy]
    touches = _touches(rollouts)
    pair = _pair(scene, aim, touches)
    load = None if pair is None else _load(scene, pair, touches)
    stiffnesses = () if load is None else _stiffnesses(load, scene.timestep)
    limits = sorted({joint for trial in rollouts for joint in trial.limits})
    names = tuple(host.joint(joint).name or f"joint {joint}" for joint in limits)
    return Proposal(scene, drive, steps, aim, touches, names, pair, load, stiffnesses)


def _longest(host: mujoco.MjModel) -> int:
    return int(min(MOST_TRIED, max(FEWEST, SECONDS / host.opt.timestep)))


def _drive(host: mujoco.MjModel) -> Drive:
    """Neutral controls are the first keyframe's, or else zero or the nearest to it in range."""
    if host.nu == 0:
        return Drive(host, np.zeros(0), NOISE, "m/s and rad/s")
    limited, (low, high) = host.actuator_ctrllimited.astype(bool), host.actuator_ctrlrange.T
    neutral = host.key_ctrl[0].copy() if host.nkey else np.zeros(host.nu)
    neutral[limited] = np.clip(neutral, low, high)[limited]
    data = start_of(host)
    moments = moments_of(data)
    gain, squares = np.abs(host.actuator_gainprm[:, 0]), np.sum(moments**2, axis=1)
    force = np.abs(moments @ data.qfrc_bias) / np.maximum(squares, mujoco.mjMINVAL)
    motor = (host.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_FIXED)) & (
        host.actuator_biastype == int(mujoco.mjtBias.mjBIAS_NONE)
    )
    holding = np.where(motor & (gain > 0), force / np.maximum(gain, mujoco.mjMINVAL), 0.0)
    strongest = LIFTING * float(holding.max())
    scales = np.where(limited, (high - low) / 2, np.where(motor & (strongest > 0.01), strongest, 1.0))
    meaning = "a fifth of the control that balances gravity" if strongest > 0.01 else "a tenth of the controls' unit"
    meaning = f"{NOISE:g} of half a control's range" if limited.all() else meaning
    return Drive(host, neutral, rounded(NOISE * float(np.median(scales)), 1), meaning)


def _horizon(host: mujoco.MjModel, quiet: Trial) -> int:
    """Twice the time to the first contact that begins after the start, but at least the usual duration."""
    begun = [touch.first for touch in quiet.touches.values() if 1 < touch.first < MOST / 1.5]
    wanted = max(2 * min(begun, default=0), USUAL / host.opt.timestep)
    steps = int(min(MOST, max(FEWEST, wanted)))
    return min(MOST, math.ceil(steps / 10) * 10)


def _trials(drive: Drive, steps: int) -> tuple[list[Trial], list[Trial]]:
    """Finite rollouts with noise, and with held changes."""
    random, rows = np.random.default_rng(0), 1 if drive.at_start else steps
    noise = drive.scale * random.normal(size=(TRIALS, rows, drive.size))
    held = HELD * drive.scale * random.uniform(-1, 1, size=(TRIALS, 1, drive.size))
    noisy, far = ([run_trial(drive, change, steps) for change in changes] for changes in (noise, held))
    return [each for each in noisy if each.steps == steps], [each for each in far if each.steps == steps]


def _touches(trials: Sequence[Trial]) -> dict[tuple[int, int], Touch]:
    """Contacts of any rollout: the earliest touch, the greatest depth, and the share of rollouts."""
    found = {}
    for pair in dict.fromkeys(pair for trial in trials for pair in trial.touches):
        alike = [trial.touches[pair] for trial in trials if pair in trial.touches]
        earliest = min(alike, key=lambda touch: touch.first)
        depth = max(touch.depth for touch in alike)
        found[pair] = dataclasses.replace(earliest, depth=depth, share=len(alike) / len(trials))
    return found


def _pair(scene: Scene, aim: Aim, touches: dict[tuple[int, int], Touch]) -> tuple[str, str] | None:
    """Names of the contact to sweep: one that begins after the start, of the body at issue, and the fastest."""
    host, usable = scene.host, {}
    for pair, touch in touches.items():
        names = host.geom(pair[0]).name, host.geom(pair[1]).name
        if all(names) and host.body_invweight0[host.geom_bodyid[list(pair)], 0].sum() > 0:
            own = aim.body is not None and aim.body in host.body_rootid[host.geom_bodyid[list(pair)]]
            usable[names] = (touch.first > 0, own, touch.speed)
    return max(usable, key=lambda names: usable[names]) if usable else None


def _load(scene: Scene, pair: tuple[str, str], touches: dict[tuple[int, int], Touch]) -> Load:
    host, geoms = scene.host, sorted(scene.geom(name) for name in pair)
    moving = {int(root) for root in host.body_rootid[host.geom_bodyid[geoms]] if root}
    mass = sum(float(host.body_subtreemass[root]) for root in moving)
    speed, weight = max(0.0, touches[geoms[0], geoms[1]].speed), mass * float(np.linalg.norm(host.opt.gravity))
    sizes = [float(host.geom_aabb[geom, 3:].min()) for geom in geoms if host.geom_rbound[geom] > 0]  # if not unbounded
    return Load(effective_mass(scene, *pair), speed, weight, min(sizes, default=0.1))


def _stiffnesses(load: Load, timestep: float) -> tuple[float, ...]:
    """Stiffnesses [N/m], from one at which the geoms sink in little to one that the timestep resolves."""
    high = load.mass * (RESOLVED / timestep) ** 2
    low = min(load.stiffness(SINKING * load.size) or high, high / 10)  # 0 where neither weight nor speed presses
    return tuple(rounded(value, 1) for value in np.geomspace(low, high, STIFFNESSES).tolist())
