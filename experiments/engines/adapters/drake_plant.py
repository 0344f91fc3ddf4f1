"""Drake's MultibodyPlant on AutoDiffXd: discrete updates, by its approximation `sap`.

Compliance and dissipation are Drake's own for point contact. A continuous plant refuses AutoDiffXd: its dissipation is
looked up as a double.
"""

from importlib import import_module
from typing import Any

import numpy as np

from experiments.engines.scenes import LENGTH, LIMIT, PIVOT, RADIUS, CannotError, Rollout, Scene, Simulate


def build(scene: Scene, timestep: float, variant: str) -> Simulate:
    """Return rollouts by one of the variants."""
    d: Any = import_module("pydrake.all")
    if any(body.shape == "box" for body in scene.bodies):
        raise CannotError("no derivative: boxes on a half space have no point contact on AutoDiffXd")
    builder = d.DiagramBuilder()
    plant, _ = d.AddMultibodyPlantSceneGraph(builder, timestep)
    plant.set_discrete_contact_approximation(d.DiscreteContactApproximation.kSap)
    plant.mutable_gravity_field().set_gravity_vector([0, 0, -scene.gravity])
    friction = d.CoulombFriction(scene.friction, scene.friction)
    if scene.floor:
        plant.RegisterCollisionGeometry(plant.world_body(), d.RigidTransform(), d.HalfSpace(), "floor", friction)
    if scene.wall is not None:
        pose = d.HalfSpace.MakePose(np.array([-1.0, 0, 0]), np.array([scene.wall, 0, 0]))
        plant.RegisterCollisionGeometry(plant.world_body(), pose, d.HalfSpace(), "wall", friction)
    links = []
    for i, body in enumerate(scene.bodies):
        if body.shape == "pendulum":
            inertia = d.SpatialInertia(1.0, [0, 0, -LENGTH], d.UnitInertia.PointMass(np.array([0, 0, -LENGTH])))
            link = plant.AddRigidBody("body", inertia)
            frame = plant.AddFrame(
                d.FixedOffsetFrame("pivot", plant.world_frame(), d.RigidTransform(np.array([0, 0, PIVOT])))
            )
            joint = d.RevoluteJoint("hinge", frame, link.body_frame(), [0, -1, 0], -3, LIMIT, 0)
            plant.AddJoint(joint)
        else:
            link = plant.AddRigidBody(f"body{i}", d.SpatialInertia.SolidSphereWithMass(1.0, RADIUS))
            plant.RegisterCollisionGeometry(link, d.RigidTransform(), d.Sphere(RADIUS), f"ball{i}", friction)
        links.append(link.index())
    plant.Finalize()
    diagram = builder.Build().ToAutoDiffXd()
    plant = diagram.GetSubsystemByName(plant.get_name())

    def one(theta: float) -> tuple[float, float, np.ndarray]:
        simulator = d.Simulator_[d.AutoDiffXd](diagram)
        context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
        parameter = d.AutoDiffXd(theta, np.ones(1))
        for link, body in zip(links, scene.start(parameter), strict=True):
            constants = [
                x if x is parameter else d.AutoDiffXd(float(x), np.zeros(1))
                for x in (*body.position, *body.velocity, body.tilt, body.spin)
            ]
            if body.shape == "pendulum":
                plant.SetPositions(context, np.array(constants[6:7]))
                plant.SetVelocities(context, np.array(constants[7:]))
                continue
            link = plant.get_body(link)
            plant.SetFreeBodyPose(context, link, d.RigidTransform_[d.AutoDiffXd](np.array(constants[:3])))
            still = np.array([constants[6] * 0] * 3)
            velocity = d.SpatialVelocity_[d.AutoDiffXd](still, np.array(constants[3:6]))
            plant.SetFreeBodySpatialVelocity(context, link, velocity)
        simulator.Initialize()
        simulator.AdvanceTo(scene.steps(timestep) * timestep)
        positions = []
        for link, body in zip(links, scene.bodies, strict=True):
            pose = plant.EvalBodyPoseInWorld(context, plant.get_body(link))
            offset = [0, 0, -LENGTH] if body.shape == "pendulum" else [0, 0, 0]
            positions.append(list(pose.multiply(np.array([d.AutoDiffXd(float(x)) for x in offset]))))
        cost = d.AutoDiffXd(0.0) + scene.cost(positions)
        gradient = cost.derivatives()
        found = np.array([[p.value() for p in row] for row in positions])
        return cost.value(), gradient[0] if len(gradient) else 0.0, found

    def simulate(thetas: np.ndarray) -> Rollout:
        return Rollout(*(np.array(each) for each in zip(*map(one, thetas), strict=True)))

    return simulate
