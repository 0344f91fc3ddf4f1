"""mujoco-torch on torch's tape, in float64: variants `plain`, its step, and `soft`, in its `differentiable_mode` with
smooth collisions and contacts from a distance, without its substeps, each of which is a step of a smaller timestep.

Rollouts are batched by `torch.vmap`, as its documentation has it. There its loops, of a number of iterations that
depends on the data, take 1.5 s a step; so the numbers are fixed at `ITERATIONS`: where spheres do not slip values are
MJX's, and on the toss derivatives are off at a tenth of the points, at none with 10 iterations.
"""

from importlib import import_module
from typing import Any

import numpy as np

from experiments.engines.scenes import LENGTH, PIVOT, Rollout, Scene, Simulate, mjcf, mjcf_index, mjcf_state

ITERATIONS = 4  # of the solver and of its line search


def build(scene: Scene, timestep: float, variant: str) -> Simulate:
    """Return rollouts by one of the variants."""
    mujoco: Any = import_module("mujoco")
    torch: Any = import_module("torch")
    engine: Any = import_module("mujoco_torch")
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    host = mujoco.MjModel.from_xml_string(mjcf(scene, timestep))
    host.opt.iterations = host.opt.ls_iterations = ITERATIONS
    model, rest = engine.device_put(host), engine.device_put(mujoco.MjData(host))
    hinged = scene.bodies[0].shape == "pendulum"
    start, (is_velocity, index) = mjcf_state(scene, scene.center), mjcf_index(scene)
    soft = variant == "soft"
    step = torch.vmap(lambda data: engine.step(model, data, fixed_iterations=True))
    linear, quadratic, target = (torch.tensor(each) for each in scene.coefficients())

    def simulate(thetas: np.ndarray) -> Rollout:
        parameter = torch.tensor(thetas, requires_grad=True)
        position, velocity = (torch.tensor(each).repeat(len(thetas), 1) for each in start)
        (velocity if is_velocity else position)[:, index] = parameter
        data = torch.stack([rest] * len(thetas)).replace(qpos=position, qvel=velocity)
        with engine.differentiable_mode(smooth_collisions=soft, cfd=soft):
            for _ in range(scene.steps(timestep)):
                data = step(data)
        if hinged:
            angle = data.qpos[:, 0]
            height = PIVOT - LENGTH * torch.cos(angle)
            ends = torch.stack([LENGTH * torch.sin(angle), torch.zeros_like(angle), height], dim=1)[:, None]
        else:
            ends = data.qpos.reshape(len(thetas), -1, 7)[:, :, :3]
        costs = (linear * ends + quadratic * (ends - target) ** 2).sum(dim=(1, 2))
        (derivatives,) = torch.autograd.grad(costs.sum(), parameter)
        return Rollout(costs.detach().numpy(), derivatives.numpy(), ends.detach().numpy())

    return simulate
