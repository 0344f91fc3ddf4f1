"""Newton on NVIDIA Warp's tape, on a CPU and in float32: variants `semi_implicit` and `old`,
Newton 1.0.0, whose gravity is a number.

Stiffness and damping are Newton's defaults, shared among the points of a contact. The gain of friction is `GAIN`: its
default, 1000 N s/m, is beyond what explicit steps of 5 and 2 ms of 1 kg bear. The bodies of one call are worlds of one
model.
"""

import math
from importlib import import_module
from typing import Any

import numpy as np

from experiments.engines.scenes import LENGTH, LIMIT, PIVOT, RADIUS, Rollout, Scene, Simulate

WORLDS = 100  # rollouts that are simulated at once
GAIN = 50.0
"""Friction per slip speed [N s/m]: a sphere's contact has an effective mass of 2/7 kg, and steps of 5 ms bear 114."""
STIFFNESS, DAMPING = 2500.0, 100.0
"""Newton's defaults [N/m, N s/m]."""
BOB = 0.05  # radius of the pendulum's ball [m], as in MuJoCo's model


def add_pendulum(wp: Any, newton: Any, world: Any) -> None:
    """Add a ball on a massless rod, whose hinge has Newton's default gains at its limit."""
    density = 1 / (4 / 3 * math.pi * BOB**3)
    link = world.add_link() if hasattr(world, "add_link") else world.add_body()
    world.add_shape_sphere(link, radius=BOB, cfg=world.ShapeConfig(density=density, collision_group=0))
    hinge = world.add_joint_revolute(
        parent=-1,
        child=link,
        parent_xform=wp.transform((0.0, 0.0, PIVOT), wp.quat_identity()),
        child_xform=wp.transform((0.0, 0.0, LENGTH), wp.quat_identity()),
        axis=(0.0, -1.0, 0.0),
        limit_lower=-3.0,
        limit_upper=LIMIT,
    )
    world.add_articulation([hinge])


def state_of(scene: Scene, theta: float) -> tuple[np.ndarray, np.ndarray]:
    """Poses (position, quaternion xyzw) [bodies, 7] and velocities (of the center, of the angle) [bodies, 6]."""
    poses, velocities = [], []
    for body in scene.start(theta):
        position, velocity, spin = np.array(body.position), np.array(body.velocity), 0.0
        angle = body.tilt
        if body.shape == "pendulum":
            angle, spin = -body.tilt, -body.spin
            position = np.array([LENGTH * math.sin(body.tilt), 0, PIVOT - LENGTH * math.cos(body.tilt)])
            velocity = body.spin * LENGTH * np.array([math.cos(body.tilt), 0, math.sin(body.tilt)])
        poses.append([*position, 0, math.sin(angle / 2), 0, math.cos(angle / 2)])
        velocities.append([*velocity, 0, spin, 0])
    return np.array(poses), np.array(velocities)


def build(scene: Scene, timestep: float, variant: str) -> Simulate:
    """Return rollouts by one of the solvers."""
    wp: Any = import_module("warp")
    newton: Any = import_module("newton")
    wp.config.quiet = True
    gravity: Any = -scene.gravity if variant == "old" else (0.0, 0.0, -scene.gravity)
    world = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=gravity)
    config = None
    for body in scene.bodies:
        if body.shape == "pendulum":
            add_pendulum(wp, newton, world)
            continue
        points, volume = (4, (2 * RADIUS) ** 3) if body.shape == "box" else (1, 4 / 3 * math.pi * RADIUS**3)
        forces = {"ke": STIFFNESS / points, "kd": DAMPING / points, "kf": GAIN / points}
        config = world.ShapeConfig(density=1 / volume, mu=scene.friction, restitution=scene.restitution, **forces)
        if body.shape == "box":
            world.add_shape_box(world.add_body(), hx=RADIUS, hy=RADIUS, hz=RADIUS, cfg=config)
        else:
            world.add_shape_sphere(world.add_body(), radius=RADIUS, cfg=config)
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=gravity)
    for _ in range(WORLDS):
        builder.add_world(world)
    if scene.floor:
        builder.add_ground_plane(cfg=config)
    if scene.wall is not None:
        builder.add_shape_plane(plane=(-1.0, 0.0, 0.0, scene.wall), width=0.0, length=0.0, cfg=config)
    with wp.ScopedDevice("cpu"):
        model = builder.finalize(requires_grad=True)
        solver = newton.solvers.SolverSemiImplicit(model)
        states = [model.state() for _ in range(scene.steps(timestep) + 1)]
        pipeline = newton.CollisionPipeline(model, requires_grad=True)
        contacts = [pipeline.contacts() for _ in states[1:]]
    control = model.control()

    size, ones = len(scene.bodies), [state_of(scene, each) for each in (0.0, 1.0)]
    along = [one - zero for zero, one in zip(*ones, strict=True)]  # states are linear in the parameter

    def chunk(thetas: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        starts = [state_of(scene, float(theta)) for theta in thetas]
        for array, each in zip((states[0].body_q, states[0].body_qd), zip(*starts, strict=True), strict=True):
            array.assign(np.concatenate(each).astype(np.float32))
        tape = wp.Tape()
        with tape:
            for before, after, touching in zip(states, states[1:], contacts, strict=False):
                before.clear_forces()
                pipeline.collide(before, touching)
                solver.step(before, after, control, touching, timestep)
        ends = states[-1].body_q.numpy().reshape(WORLDS, size, 7)[:, :, :3].astype(float)
        seed = np.zeros((WORLDS, size, 7), np.float32)
        seed[:, :, :3] = [scene.cost_gradient(end) for end in ends]
        seeds = wp.array(seed.reshape(-1, 7), dtype=wp.transform, device="cpu")
        tape.backward(grads={states[-1].body_q: seeds})
        derivatives = sum(
            (array.grad.numpy().astype(float).reshape(WORLDS, size, -1) * change).sum(axis=(1, 2))
            for array, change in zip((states[0].body_q, states[0].body_qd), along, strict=True)
        )
        tape.zero()
        return np.array([scene.cost(end) for end in ends]), np.asarray(derivatives), ends

    def simulate(thetas: np.ndarray) -> Rollout:
        padded = np.resize(thetas, -(-len(thetas) // WORLDS) * WORLDS)
        parts = list(map(chunk, padded.reshape(-1, WORLDS)))
        return Rollout(*(np.concatenate([part[i] for part in parts])[: len(thetas)] for i in range(3)))

    return simulate
