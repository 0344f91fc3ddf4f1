r"""What a first-order gradient misses where contact begins, against theory.

A body meets a plane at speed v, with r the gap. In contact r'' = -b r' - k r, so the acceleration jumps by b v at the
onset, whose time depends on the state. The sensitivity to the initial gap after a time tau in contact is

    exp(A tau) (1, -b)        of the motion:  the jump moves with the gap, a term (0, -b) that does not depend on h;
    exp(A tau) (1, 0)         of each step's derivative, which holds the step at which contact begins fixed.

An undamped spring has b = 0 and nothing to miss.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from mjx_study.contact import ContactModel, apply_contact
from mjx_study.dynamics import initial_state, rollout
from tests.scenes import floor_scene, option, scene_of

STIFFNESS, SPEED, APPROACH, CONTACT = 1e4, 1.0, 0.01, 0.01  # [1/s^2], [m/s], [s], [s]
BODY = '<body pos="0 0 0.1"><joint type="slide" axis="0 0 1"/><geom name="ball" size="0.1" mass="1" condim="1"/></body>'
PHASES = 64


def sensitivities(timestep: float, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """d(gap, velocity)/d(initial gap) at the end: of the motion, and as the mean of the steps' derivatives.

    The means are over initial gaps within one step's travel, so that contact begins everywhere within a step.
    """
    scene = scene_of(floor_scene(BODY, option(timestep, 'gravity="0 0 0"', 'refsafe="disable"'), 'condim="1"'))
    contact = ContactModel(jnp.array([-STIFFNESS, -damping]), jnp.array([0.5, 0.5, 0.001, 0.5, 2.0]))
    model = apply_contact(scene.model, contact)
    horizon = round((APPROACH + CONTACT) / timestep)

    def last(gap):
        start = initial_state(scene, gap[None], jnp.array([-SPEED]))
        states, *_ = rollout(scene, model, start, lambda index, state: jnp.zeros(0), horizon)
        return jnp.stack([states.qpos[-1, 0], states.qvel[-1, 0]])

    travel = SPEED * timestep
    gaps = APPROACH * SPEED + travel * (np.arange(PHASES + 1) + 0.5) / PHASES
    program = jax.jit(
        jax.vmap(lambda gap: (last(gap), jax.jacfwd(last)(gap))),
        compiler_options={"xla_backend_optimization_level": "0"},
    )
    values, derivatives = map(np.asarray, program(gaps))
    return (values[-1] - values[0]) / travel, derivatives[:-1].mean(axis=0)


@pytest.mark.parametrize("damping", [0.0, 200.0], ids=["undamped", "critically damped"])
def test_the_onset_of_damping_is_what_first_order_gradients_miss(damping: float) -> None:
    propagate = expm(np.array([[0.0, 1.0], [-STIFFNESS, -damping]]) * CONTACT)
    motion, steps = propagate @ [1.0, -damping], propagate @ [1.0, 0.0]
    scale = np.abs(propagate @ [1.0, 200.0])
    errors = []
    for timestep in (5e-4, 1.25e-4):
        found_motion, found_steps = sensitivities(timestep, damping)
        errors.append(
            max(
                np.max(np.abs(found - exact) / scale) for found, exact in ((found_motion, motion), (found_steps, steps))
            )
        )
    assert errors[1] < 0.04 and errors[1] < 0.35 * errors[0]  # of first order in the timestep, towards the theory
    missed = np.max(np.abs(motion - steps) / scale)
    assert missed == 0 if damping == 0 else missed > 0.2
