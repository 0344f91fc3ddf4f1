"""MJX and what keeps its interface: stock, this project's step, mujodico, and old releases of MJX.

Variants: of stock MJX `forward` (forward mode through the default solver) and `reverse` (its documentation's setting
for reverse mode, one iteration of the solver); of this project `plain` and `onset`; of mujodico its laws.
"""

from functools import partial
from importlib import import_module
from typing import Any

from experiments.engines.adapters.jax_common import batched, started
from experiments.engines.scenes import Scene, Simulate, mjcf, mjcf_state

KAPPA = {"hunt_crossley": 1e-5, "kelvin_voigt": 1e-5, "log_barrier": 1e-3, "conic": 1e-5}
"""Smoothing of mujodico's laws, without which their derivatives are NaN."""


def build(scene: Scene, timestep: float, variant: str) -> Simulate:
    """Return rollouts by one of the variants."""
    mujoco: Any = import_module("mujoco")
    host = mujoco.MjModel.from_xml_string(mjcf(scene, timestep))
    mjx: Any = import_module("mujodico.mjx" if variant in KAPPA else "mujoco.mjx")
    if variant in ("plain", "onset"):
        step = partial(import_module("mjx_study").step, onset="linear" if variant == "onset" else "none")
    else:
        step = mjx.step
    if variant == "reverse":
        host.opt.iterations, host.opt.ls_iterations = 1, 4
    options = {"contact_approximation": variant, "contact_smoothing": KAPPA[variant]} if variant in KAPPA else {}
    model = mjx.put_model(host, **options)
    data = mjx.make_data(model)
    state = mjcf_state(scene, scene.center)

    def final_positions(jax, theta):
        position, velocity = started(jax, scene, state, theta)
        start = data.replace(qpos=position.astype(data.qpos.dtype), qvel=velocity.astype(data.qvel.dtype))
        last, _ = jax.lax.scan(lambda data, _: (step(model, data), None), start, length=scene.steps(timestep))
        return mjx.kinematics(model, last).xipos[1:]

    return batched(scene, final_positions, forward=variant in ("forward", *KAPPA))
