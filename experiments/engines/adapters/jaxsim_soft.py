"""JaxSim's soft contacts, with the parameters that it estimates itself for a penetration at rest of `DEPTH`.

Its default of 1 mm is not resolved by the steps of the study. A sphere is 50 points, its default, a box its corners. It
knows no walls: a scene with one is turned, so that the wall becomes the ground.
"""

import math
from importlib import import_module
from typing import Any

from experiments.engines.adapters.jax_common import batched
from experiments.engines.scenes import RADIUS, CannotError, Scene, Simulate, damping_ratio

DEPTH = 0.1 * RADIUS  # [m]
SHAPES = {
    "sphere": (0.4 * RADIUS**2, 1, f"<sphere><radius>{RADIUS}</radius></sphere>"),
    "box": (2 / 3 * RADIUS**2, 4, f"<box><size>{2 * RADIUS} {2 * RADIUS} {2 * RADIUS}</size></box>"),
}
"""Moment of inertia of 1 kg [kg m^2], points in contact at rest, and geometry."""
MODEL = """<sdf version="1.7"><model name="body"><link name="body"><inertial><mass>1</mass><inertia>
<ixx>{0}</ixx><iyy>{0}</iyy><izz>{0}</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia></inertial>
<collision name="body"><geometry>{2}</geometry></collision></link></model></sdf>"""


def build(scene: Scene, timestep: float, variant: str) -> Simulate:
    """Return rollouts; `variant` is the integrator's name."""
    api: Any = import_module("jaxsim.api")
    first, *others = scene.bodies
    shape = first.shape
    if others:
        raise CannotError("its bodies touch the ground, and not each other")
    if shape not in SHAPES:
        raise CannotError("this adapter builds no joint")
    model = api.model.JaxSimModel.build_from_model_description(
        model_description=MODEL.format(*SHAPES[shape]),
        time_step=timestep,
        gravity=scene.gravity,
        integrator=getattr(api.model.IntegratorType, variant),
    )
    parameters = api.contact.estimate_good_contact_parameters(
        model=model,
        static_friction_coefficient=scene.friction,
        number_of_active_collidable_points_steady_state=SHAPES[shape][1],
        damping_ratio=damping_ratio(scene.restitution) if scene.restitution else 1.0,
        max_penetration=DEPTH,
    )
    with model.editable(validate=False) as model:
        model.contact_params = parameters

    def final_positions(jax, theta):
        jnp = jax.numpy
        (body,) = scene.start(theta)

        def turned(x, y, z, height):
            return jnp.array([x, y, z] if scene.wall is None else [-z, y, height - x], float)

        wall = scene.wall or 0.0
        state = api.data.JaxSimModelData.build(
            model=model,
            base_position=turned(*body.position, wall),
            base_quaternion=jnp.array([math.cos(first.tilt / 2), 0.0, math.sin(first.tilt / 2), 0.0]),
            base_linear_velocity=turned(*body.velocity, 0.0),
        )
        last, _ = jax.lax.scan(
            lambda data, _: (api.model.step(model=model, data=data), None), state, length=scene.steps(timestep)
        )
        x, y, z = last.base_position
        return jnp.array([[x, y, z] if scene.wall is None else [wall - z, y, -x]])

    return batched(scene, final_positions)
