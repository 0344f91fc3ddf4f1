"""Nimble on torch's tape, in float64; it warns of derivatives of friction beneath a normal along z: here y is up."""

from importlib import import_module
from typing import Any

import numpy as np

from experiments.engines.scenes import LENGTH, LIMIT, PIVOT, RADIUS, Rollout, Scene, Simulate

UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # from the scene's axes to the engine's
THICK = 1.0  # half thickness of floor and wall, which are boxes [m]
SPREAD = 0.4 * 0.05**2  # moment of inertia of the pendulum's ball about its center, as in MuJoCo's model [kg m^2]


def build(scene: Scene, timestep: float, variant: str) -> Simulate:
    """Return rollouts by its one solver; restitution is the engine's."""
    torch: Any = import_module("torch")
    nimble: Any = import_module("nimblephysics")
    torch.set_num_threads(1)
    world = nimble.simulation.World()
    world.setGravity(UP @ [0, 0, -scene.gravity])
    world.setTimeStep(timestep)
    boxes, spheres = nimble.dynamics.BoxShape, nimble.dynamics.SphereShape
    hinged = scene.bodies[0].shape == "pendulum"

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

    for body in scene.bodies:
        if hinged:
            skeleton = nimble.dynamics.Skeleton()
            joint, node = skeleton.createRevoluteJointAndBodyNodePair()
            joint.setAxis(UP @ [0, -1.0, 0])
            joint.setPositionUpperLimit(0, LIMIT)
            joint.setPositionLimitEnforced(True)
            offset = UP @ [0, 0, -LENGTH]
            spread = SPREAD * np.eye(3) + (offset @ offset) * np.eye(3) - np.outer(offset, offset)
            node.setInertia(nimble.dynamics.Inertia(1.0, offset, spread))
            world.addSkeleton(skeleton)
            continue
        node = add(boxes(np.full(3, 2 * RADIUS)) if body.shape == "box" else spheres(RADIUS), None)
        moment = (2 / 3 if body.shape == "box" else 0.4) * RADIUS**2
        node.setInertia(nimble.dynamics.Inertia(1.0, np.zeros(3), moment * np.eye(3)))
    if scene.floor:
        add(boxes(np.array([40, 2 * THICK, 40])), np.array([0, -THICK, 0]))
    if scene.wall is not None:
        add(boxes(np.array([2 * THICK, 40, 40])), np.array([scene.wall + THICK, 0, 0]))
    rest = torch.zeros(world.getActionSize(), dtype=torch.float64)
    turn, coefficients = torch.tensor(UP), [torch.tensor(each) for each in scene.coefficients()]

    def vector(*entries: Any) -> Any:
        return torch.stack([torch.as_tensor(x, dtype=torch.float64) for x in entries])

    def started(parameter: Any) -> Any:
        if hinged:
            return vector(scene.bodies[0].tilt, parameter)
        placed, moving = [], []
        for body in scene.start(parameter):
            placed += [turn @ vector(0.0, body.tilt, 0.0), turn @ vector(*body.position)]
            moving += [torch.zeros(3, dtype=torch.float64), turn @ vector(*body.velocity)]
        return torch.cat([*placed, *moving])

    def ended(state: Any) -> Any:
        if hinged:
            return vector(LENGTH * torch.sin(state[0]), 0.0, PIVOT - LENGTH * torch.cos(state[0]))[None]
        return torch.stack([turn.T @ state[6 * i + 3 : 6 * i + 6] for i in range(len(scene.bodies))])

    def one(theta: float) -> tuple[float, float, np.ndarray]:
        parameter = torch.tensor(theta, dtype=torch.float64, requires_grad=True)
        state = started(parameter)
        for _ in range(scene.steps(timestep)):
            state = nimble.timestep(world, state, rest)
        end = ended(state)
        linear, quadratic, target = coefficients
        cost = (linear * end + quadratic * (end - target) ** 2).sum()
        cost.backward()
        return cost.item(), parameter.grad.item(), end.detach().numpy()

    def simulate(thetas: np.ndarray) -> Rollout:
        return Rollout(*(np.array(each) for each in zip(*map(one, thetas.tolist()), strict=True)))

    return simulate
