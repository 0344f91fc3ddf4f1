"""Nimble on torch's tape, in float64; it warns of derivatives of friction beneath a normal along z: here y is up."""

from importlib import import_module
from typing import Any

import numpy as np

from experiments.engines.scenes import RADIUS, CannotError, Rollout, Scene, Simulate

UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""From the scene's axes to the engine's."""
THICK = 1.0
"""Half thickness of floor and wall, which are boxes [m]."""


def build(scene: Scene, timestep: float, variant: str) -> Simulate:
    """Return rollouts by the solver of this name, of its one; restitution is the engine's."""
    (shape, tilt), *others = ((body.shape, body.tilt) for body in scene.bodies)
    if others or tilt or shape not in ("sphere", "box") or variant != "lcp":
        raise CannotError("this adapter builds one sphere or one level box alone, for the solver lcp")
    torch: Any = import_module("torch")
    nimble: Any = import_module("nimblephysics")
    torch.set_num_threads(1)
    world = nimble.simulation.World()
    world.setGravity(UP @ [0, 0, -scene.gravity])
    world.setTimeStep(timestep)

    def add(form: Any, center: np.ndarray | None) -> Any:
        skeleton = nimble.dynamics.Skeleton()
        if center is None:
            _, node = skeleton.createFreeJointAndBodyNodePair()
        else:
            joint, node = skeleton.createWeldJointAndBodyNodePair()
            joint.setTransformFromParentBodyNode(nimble.math.Isometry3(np.eye(3), center))
        node.createShapeNode(form).createCollisionAspect()
        node.setFrictionCoeff(scene.friction)
        node.setRestitutionCoeff(scene.restitution)
        world.addSkeleton(skeleton)
        return node

    boxes, spheres = nimble.dynamics.BoxShape, nimble.dynamics.SphereShape
    node = add(boxes(np.full(3, 2 * RADIUS)) if shape == "box" else spheres(RADIUS), None)
    moment = (2 / 3 if shape == "box" else 0.4) * RADIUS**2
    node.setInertia(nimble.dynamics.Inertia(1.0, np.zeros(3), moment * np.eye(3)))
    if scene.floor:
        add(boxes(np.array([40, 2 * THICK, 40])), np.array([0, -THICK, 0]))
    if scene.wall is not None:
        add(boxes(np.array([2 * THICK, 40, 40])), np.array([scene.wall + THICK, 0, 0]))
    rest = torch.zeros(world.getActionSize(), dtype=torch.float64)
    turn, coefficients = torch.tensor(UP), [torch.tensor(each[0]) for each in scene.coefficients()]

    def one(theta: float) -> tuple[float, float, np.ndarray]:
        parameter = torch.tensor(theta, dtype=torch.float64, requires_grad=True)
        (body,) = scene.start(0.0)
        start = [[*body.position], [*body.velocity]]
        start["v" in scene.parameter]["xz".index(scene.parameter[-1]) * 2] = parameter
        parts = [torch.stack([torch.as_tensor(x, dtype=torch.float64) for x in row]) for row in start]
        still = torch.zeros(3, dtype=torch.float64)
        state = torch.cat([still, turn @ parts[0], still, turn @ parts[1]])
        for _ in range(scene.steps(timestep)):
            state = nimble.timestep(world, state, rest)
        end = turn.T @ state[3:6]
        linear, quadratic, target = coefficients
        cost = (linear * end + quadratic * (end - target) ** 2).sum()
        cost.backward()
        return cost.item(), parameter.grad.item(), end.detach().numpy()[None]

    def simulate(thetas: np.ndarray) -> Rollout:
        return Rollout(*(np.array(each) for each in zip(*map(one, thetas.tolist()), strict=True)))

    return simulate
