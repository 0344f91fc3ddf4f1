r"""What a first-order gradient misses where contact begins, against theory.

A body meets a plane at speed v, accelerated by a_0; r is the gap. In contact r'' = (1 - d) a_0 - b r' - k r, so that
the acceleration jumps by b v - d a_0 at the onset, whose time depends on the state. The sensitivity to the initial gap
after a time tau in contact is

    exp(A tau) (1, -b + d a_0 / v)    of the motion: the jump moves with the gap, a term that does not depend on h;
    exp(A tau) (1, 0)                 of each step's derivative, which holds the step at which contact begins fixed.

Without damping the part of a_0 remains: there is nothing to miss only where nothing accelerates the body, or where the
impedance is near 0.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from mjx_study.simulation.contact import ContactModel, apply_contact
from mjx_study.simulation.dynamics import initial_state, rollout
from tests.scenes import DROP, floor_scene, option, scene_of

STIFFNESS, SPEED, APPROACH, CONTACT = 1e4, 1.0, 0.01, 0.01  # [1/s^2], [m/s] at the onset, [s], [s]
PHASES = 64


@functools.cache
def program(timestep: float):
    """Last (gap, velocity) and its derivative by the initial gap, of a batch; compiled once for all contacts."""
    scene = scene_of(floor_scene(DROP, option(timestep, 'gravity="0 0 0"', 'refsafe="disable"'), 'condim="1"'))
    horizon = round((APPROACH + CONTACT) / timestep)

    def last(gap, speed, damping, impedance, gravity):
        solimp = jnp.array([0.0, 0.0, 0.001, 0.5, 2.0]).at[:2].set(impedance)
        model = apply_contact(scene.model, ContactModel(jnp.stack([-STIFFNESS * jnp.ones(()), -damping]), solimp))
        model = model.replace(opt=model.opt.replace(gravity=jnp.zeros(3).at[2].set(-gravity)))
        start = initial_state(scene, gap[None], -speed[None])
        states, *_ = rollout(scene, model, start, lambda index, state: jnp.zeros(0), horizon)
        return jnp.stack([states.qpos[-1, 0], states.qvel[-1, 0]])

    batched = jax.vmap(lambda *args: (last(*args), jax.jacfwd(last)(*args)), in_axes=(0, None, None, None, None))
    return jax.jit(batched, compiler_options={"xla_backend_optimization_level": "0"})


def sensitivities(timestep: float, damping: float, impedance: float, gravity: float) -> tuple[np.ndarray, np.ndarray]:
    """d(gap, velocity)/d(initial gap) at the end: of the motion, and as the mean of the steps' derivatives.

    The means are over initial gaps within one step's travel, so that contact begins everywhere within a step.
    """
    travel = SPEED * timestep
    fallen = SPEED * APPROACH - gravity * APPROACH**2 / 2
    gaps = fallen + travel * (np.arange(PHASES + 1) + 0.5) / PHASES
    numbers = map(jnp.asarray, (SPEED - gravity * APPROACH, damping, impedance, gravity))
    values, derivatives = map(np.asarray, program(timestep)(gaps, *numbers))
    return (values[-1] - values[0]) / travel, derivatives[:-1].mean(axis=0)


@pytest.mark.parametrize(
    ("damping", "impedance", "gravity"),
    [
        pytest.param(0.0, 0.5, 0.0, id="undamped, nothing accelerates"),
        pytest.param(200.0, 0.5, 0.0, id="critically damped"),
        pytest.param(0.0, 0.9, 50.0, id="undamped, accelerated"),
        pytest.param(0.0, 1e-4, 50.0, id="undamped, accelerated, hardly any impedance"),
        pytest.param(200.0, 0.9, 50.0, id="critically damped, accelerated"),
    ],
)
def test_the_jump_at_the_onset_is_what_first_order_gradients_miss(
    damping: float, impedance: float, gravity: float
) -> None:
    propagate = expm(np.array([[0.0, 1.0], [-STIFFNESS, -damping]]) * CONTACT)
    jump = -damping - impedance * gravity / SPEED
    motion, steps = propagate @ [1.0, jump], propagate @ [1.0, 0.0]
    scale = np.abs(propagate @ [1.0, 200.0])
    errors = []
    for timestep in (5e-4, 1.25e-4):
        found_motion, found_steps = sensitivities(timestep, damping, impedance, gravity)
        errors.append(
            max(
                np.max(np.abs(found - exact) / scale) for found, exact in ((found_motion, motion), (found_steps, steps))
            )
        )
    assert errors[1] < 0.04 and errors[1] < 0.35 * errors[0]  # of first order in the timestep, towards the theory
    missed = np.max(np.abs(motion - steps) / scale)
    assert missed > 0.15 if jump < -1 else missed < 1e-3
