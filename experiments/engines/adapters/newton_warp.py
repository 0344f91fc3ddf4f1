"""Newton on NVIDIA Warp's tape, on a CPU and in float32: variants `semi_implicit`, `xpbd`, and `old`,
Newton 1.0.0, whose gravity is a number.

Stiffness and damping are Newton's defaults, shared among the points of a contact. The gain of friction is `GAIN`: its
default, 1000 N s/m, is beyond what explicit steps of 5 and 2 ms of 1 kg bear. The bodies of one call are worlds of one
model.
"""

import math
from importlib import import_module
from typing import Any

import numpy as np

from experiments.engines.scenes import RADIUS, CannotError, Rollout, Scene, Simulate

WORLDS = 100
"""Rollouts that are simulated at once."""
GAIN = 50.0
"""Friction per slip speed [N s/m]: a sphere's contact has an effective mass of 2/7 kg, and steps of 5 ms bear 114."""
STIFFNESS, DAMPING = 2500.0, 100.0
"""Newton's defaults [N/m, N s/m]."""


def build(scene: Scene, timestep: float, variant: str) -> Simulate:
    """Return rollouts by one of the solvers."""
    wp: Any = import_module("warp")
    newton: Any = import_module("newton")
    wp.config.quiet = True
    (shape, tilt), *others = ((body.shape, body.tilt) for body in scene.bodies)
    if others or tilt or shape not in ("sphere", "box"):
        raise CannotError("this adapter builds one sphere or one level box alone")
    points, volume = (4, (2 * RADIUS) ** 3) if shape == "box" else (1, 4 / 3 * math.pi * RADIUS**3)
    gravity: Any = -scene.gravity if variant == "old" else (0.0, 0.0, -scene.gravity)
    ball = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=gravity)
    forces = {"ke": STIFFNESS / points, "kd": DAMPING / points, "kf": GAIN / points}
    config = ball.ShapeConfig(density=1 / volume, mu=scene.friction, restitution=scene.restitution, **forces)
    if shape == "box":
        ball.add_shape_box(ball.add_body(), hx=RADIUS, hy=RADIUS, hz=RADIUS, cfg=config)
    else:
        ball.add_shape_sphere(ball.add_body(), radius=RADIUS, cfg=config)
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=gravity)
    for _ in range(WORLDS):
        builder.add_world(ball)
    if scene.floor:
        builder.add_ground_plane(cfg=config)
    if scene.wall is not None:
        builder.add_shape_plane(plane=(-1.0, 0.0, 0.0, scene.wall), width=0.0, length=0.0, cfg=config)
    with wp.ScopedDevice("cpu"):
        model = builder.finalize(requires_grad=True)
        if variant == "xpbd":
            solver = newton.solvers.SolverXPBD(model, enable_restitution=scene.restitution > 0)
        else:
            solver = newton.solvers.SolverSemiImplicit(model)
        states = [model.state() for _ in range(scene.steps(timestep) + 1)]
        pipeline = newton.CollisionPipeline(model, requires_grad=True)
        contacts = [pipeline.contacts() for _ in states[1:]]
    control = model.control()

    def chunk(thetas: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        starts = [scene.start(float(theta))[0] for theta in thetas]
        q = np.array([(*body.position, 0, 0, 0, 1) for body in starts], np.float32)
        qd = np.array([(*body.velocity, 0, 0, 0) for body in starts], np.float32)
        states[0].body_q.assign(q)
        states[0].body_qd.assign(qd)
        tape = wp.Tape()
        with tape:
            for before, after, touching in zip(states, states[1:], contacts, strict=False):
                before.clear_forces()
                pipeline.collide(before, touching)
                solver.step(before, after, control, touching, timestep)
        ends = states[-1].body_q.numpy()[:, None, :3].astype(float)
        seed = np.zeros((WORLDS, 7), np.float32)
        seed[:, :3] = [scene.cost_gradient(end)[0] for end in ends]
        tape.backward(grads={states[-1].body_q: wp.array(seed, dtype=wp.transform, device="cpu")})
        if scene.parameter == "z":
            derivatives = states[0].body_q.grad.numpy()[:, 2].astype(float)
        else:
            derivatives = states[0].body_qd.grad.numpy()[:, 0].astype(float)
        tape.zero()
        return np.array([scene.cost(end) for end in ends]), derivatives, ends

    def simulate(thetas: np.ndarray) -> Rollout:
        padded = np.resize(thetas, -(-len(thetas) // WORLDS) * WORLDS)
        parts = list(map(chunk, padded.reshape(-1, WORLDS)))
        return Rollout(*(np.concatenate([part[i] for part in parts])[: len(thetas)] for i in range(3)))

    return simulate
