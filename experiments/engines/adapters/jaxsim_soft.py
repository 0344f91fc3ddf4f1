"""JaxSim's soft contacts, with the parameters that it estimates itself; a sphere is 50 points, its default.

It knows no walls: a scene with one is turned, so that the wall becomes the ground.
"""

from importlib import import_module
from typing import Any

from experiments.engines.adapters.jax_common import batched
from experiments.engines.scenes import RADIUS, CannotError, Scene, Simulate

MOMENT = 0.4 * RADIUS**2
MODEL = f"""<sdf version="1.7"><model name="ball"><link name="ball"><inertial><mass>1</mass><inertia>
<ixx>{MOMENT}</ixx><iyy>{MOMENT}</iyy><izz>{MOMENT}</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia></inertial>
<collision name="ball"><geometry><sphere><radius>{RADIUS}</radius></sphere></geometry></collision>
</link></model></sdf>"""


def build(scene: Scene, timestep: float, variant: str) -> Simulate:
    """Return rollouts; `variant` is the integrator's name."""
    api: Any = import_module("jaxsim.api")
    if [body.shape for body in scene.bodies] != ["sphere"]:
        raise CannotError("this adapter builds one sphere alone")
    model = api.model.JaxSimModel.build_from_model_description(
        model_description=MODEL,
        time_step=timestep,
        gravity=scene.gravity,
        integrator=getattr(api.model.IntegratorType, variant),
    )
    parameters = api.contact.estimate_good_contact_parameters(model=model, static_friction_coefficient=scene.friction)
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
            base_linear_velocity=turned(*body.velocity, 0.0),
        )
        last, _ = jax.lax.scan(
            lambda data, _: (api.model.step(model=model, data=data), None), state, length=scene.steps(timestep)
        )
        x, y, z = last.base_position
        return jnp.array([[x, y, z] if scene.wall is None else [wall - z, y, -x]])

    return batched(scene, final_positions)
