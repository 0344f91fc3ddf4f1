"""The pusher in MJX, compiled once and shared by the tests, and its closed form at any constant impedance.

MuJoCo's contact of constant impedance d, stiffness K and no damping accelerates two bodies apart by
(1 - d) a_0 + (K / m_eff) penetration, with a_0 what they do without it. `ImpedancePusher` is that law by hand, so it
agrees with MJX at the same d to rounding, while the study's `Pusher` is its limit d -> 0. Comparing with both tells the
impedance's effect on a result from a fault.
"""

import dataclasses
import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np

from mjx_study.objective import Simulator
from mjx_study.reference import Pusher, roll_out
from mjx_study.simulation.contact import ContactModel, ContactWarning, contact_model, family_model
from mjx_study.tasks import make_task
from mjx_study.tasks.task import Task

START = np.array([0.0, 1.0, 0.0, 0.0])
HORIZON = 200
SIGMA = 0.1
NO_NOISE = 1e-150  # as a sigma: added to any control it is rounded away, and its square is no underflow

# Smooth controls (T, 1) [N] with different contact events, so results are stated for one of them by name.
INPUTS = {
    "constant": np.full((HORIZON, 1), 0.1),  # one touch from the second state on, two at K = 1000
    "swell": (0.3 + 0.15 * np.sin(0.05 * np.arange(HORIZON)))[:, None],  # 2 touches; 5 at K = 1000
    # One long touch, but its first control is 0: the bodies stay exactly at touch for a step, on the kink of the
    # contact, where no difference quotient exists.
    "reversing": np.sin(0.05 * np.arange(HORIZON))[:, None],
}


def sample_keys(count: int, seed: int = 0):
    """Fresh keys; JAX refuses to use the same key array twice in these tests."""
    return jax.random.split(jax.random.key(seed), count)


@dataclasses.dataclass(frozen=True)
class ImpedancePusher(Pusher):
    """The pusher with MuJoCo's constant impedance d in its contact."""

    impedance: float = 1e-4

    def _force(self, state, control):
        reduced = self.mass / 2
        drag = (1 - self.damping) / self.timestep
        apart = -drag * (state[..., 3] - state[..., 2]) - control[..., 0] / self.mass
        penetration = self.distance - (state[..., 1] - state[..., 0])
        force = self.stiffness * penetration - reduced * self.impedance * apart
        return np.where((penetration > 0) & (force > 0), force, 0.0)

    def step(self, state, control):
        force = self._force(state, control)
        pushed = np.stack([control[..., 0] - force, force], axis=-1)
        velocity = self.damping * state[..., 2:] + self.timestep / self.mass * pushed
        return np.concatenate([state[..., :2] + self.timestep * velocity, velocity], axis=-1)

    def jacobians(self, state, control):
        h, gain = self.timestep, self.timestep / self.mass
        share = self.mass / 2 * self.impedance
        drag = (1 - self.damping) / h
        row = np.array([self.stiffness, -self.stiffness, -share * drag, share * drag])
        touching = self._force(state, control) > 0
        over_force = row * touching[..., None]
        opposite = np.array([-1.0, 1.0])
        velocity_rows = gain * opposite[:, None] * over_force[..., None, :] + self.damping * np.eye(2, 4, 2)
        over_state = np.concatenate([np.eye(2, 4) + h * velocity_rows, velocity_rows], axis=-2)
        by_control = np.array([1.0, 0.0]) + opposite * (share / self.mass * touching)[..., None]
        over_control = gain * np.concatenate([h * by_control, by_control], axis=-1)[..., None]
        return over_state, over_control


@functools.cache
def pusher_task() -> Task:
    return make_task("pusher")


@functools.cache
def pusher_simulator() -> Simulator:
    """The one simulator of 200 steps; its two programs take 8 s and 15 s to compile."""
    return Simulator(pusher_task(), chunk_size=32)


def penalty(stiffness: float, impedance: float | None = None) -> ContactModel:
    """The penalty family's member, or the same spring with another constant impedance."""
    task = pusher_task()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactWarning)  # of an unstable stiffness, which is tested by itself
        if impedance is None:
            return family_model("penalty", task.scene, stiffness=stiffness, effective_mass=task.effective_mass)
        solimp = (impedance, impedance, 0.001, 0.5, 2.0)
        return contact_model((-stiffness / task.effective_mass, 0.0), solimp, scene=task.scene)


def cost(simulator: Simulator, contact: ContactModel, controls: np.ndarray) -> float:
    """Cost of a control sequence without noise."""
    evaluation = simulator.objective(contact).evaluate(jnp.asarray(controls.reshape(-1)), sample_keys(1))
    return float(evaluation.baseline[0])


def cost_and_gradient(simulator: Simulator, contact: ContactModel, controls: np.ndarray) -> tuple[float, np.ndarray]:
    """Cost of a control sequence without noise, and MJX's reverse-mode gradient."""
    result = simulator.objective(contact, NO_NOISE).differentiate(jnp.asarray(controls.reshape(-1)), sample_keys(1))
    return float(result.value[0]), np.asarray(result.gradient[0])


def contact_events(system: Pusher, controls: np.ndarray) -> np.ndarray:
    """Which states of a rollout are in contact, (T + 1,)."""
    states = roll_out(system, START, controls).states
    return states[..., 1] - states[..., 0] < system.distance


def directions(count: int, coordinates: tuple[int, ...] = ()) -> np.ndarray:
    """Random unit vectors in the space of control sequences, and some of its coordinates."""
    random = np.random.default_rng(0).standard_normal((count, HORIZON))
    random /= np.linalg.norm(random, axis=1, keepdims=True)
    return np.concatenate([random, np.eye(HORIZON)[list(coordinates)]])


def relative(actual, expected) -> float:
    """||actual - expected|| / ||expected||."""
    return float(np.linalg.norm(np.asarray(actual) - np.asarray(expected)) / np.linalg.norm(np.asarray(expected)))
