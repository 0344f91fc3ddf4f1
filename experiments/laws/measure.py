"""What is measured of a contact law: means under noise, the motion itself, descents, `gradcheck`.

In `scenes.SCENES` noise acts on one number, and means are quadrature; in `SAMPLED` they are means over samples, along a
direction of theta.
"""

import copy
import dataclasses
import time
from functools import cache
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import mjx_study as study
from estimators import NOISES, first_order, zeroth_order
from experiments.laws.page import RIGID
from experiments.laws.scenes import SCENES, SPEED, throw
from mjx_study.choices import DEFAULT_SOLIMP, DEFAULT_SOLREF, FAMILIES
from mjx_study.execution.run import run_study
from mjx_study.experiment.quadrature import Line, grid, means
from mjx_study.gradcheck import gradcheck, plan_gradcheck
from mjx_study.objective import Simulator, compiled_rollout
from mjx_study.options.configuration import StudyConfig
from mjx_study.results.rows import rows_of
from mjx_study.simulation.contact import ContactModel, apply_contact, cone_edges, family_model, stiffness_from_solref
from mjx_study.simulation.dynamics import State, step
from mjx_study.simulation.engine import engine_model
from mjx_study.simulation.law import make_law
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import single_contact
from mjx_study.tasks.task import Task

POINTS, CHUNK = 4000, 250  # points, samples and pairs; samples per call
MANY_JOINTS: Final = 10  # degrees of freedom from which a quarter of the points must do
GRAVITY, FINE = 9.81, 0.002  # [m/s^2], [s]
SLOPE: Final = 0.5  # of the ground on which a ball of friction 1 rests
STEPS: Final = (0.001, 0.002, 0.004, 0.006, 0.008, 0.01, 0.015, 0.02, 0.03, 0.04, 0.06, 0.08)
STIFF, SHORT = (0.001, 1.0), 1e-4  # solref and [s] of `RIGID`
SAMPLED: Final = ("pusher", "tennis", "landing")
TRAINED: Final[dict[str, dict[str, Any]]] = {
    "pusher": {"iterations": 200, "samples": (10,)},
    "ball_wall": {"iterations": 40, "samples": (30,), "learning_rate": 1.0},
}
SEEDS, DRAWS = 3, 1000
BATCH: Final = 1000  # samples, and pairs of rollouts of the reference, of `compared`
AFLOAT: Final = 300
DURATION, NARROW = 0.8, 1e-6  # [s], [rad]


def as_stiff(task: Task, family: str) -> dict[str, Any]:
    """Return the options of a family that has MuJoCo's default stiffness, and none if it takes no stiffness."""
    of = FAMILIES[family]
    stiffness = stiffness_from_solref(DEFAULT_SOLREF, effective_mass=task.effective_mass)[0]
    damping = None if of.dampratio or of.smoothing else task.defaults.damping
    return {"stiffness": stiffness, "damping": damping} if of.swept else {}


def member(task: Task, family: str, scale: float = 1.0) -> ContactModel:
    """Return the contact model of a family at MuJoCo's default stiffness; `scale` multiplies its smoothing."""
    assert task.contact_pair is not None
    given: dict[str, Any] = {"effective_mass": task.effective_mass, "edges": cone_edges(task.scene, *task.contact_pair)}
    smoothing = FAMILIES[family].smoothing * scale or None
    return family_model(family, task.scene, smoothing=smoothing, **given, **as_stiff(task, family))


def unmapped(family: str) -> ContactModel:
    """Return a law of MuJoDiCo with MuJoCo's default solref as it stands, which the package reads in its own way, or
    MuJoCo's default."""
    law = make_law(family, FAMILIES[family].smoothing) if FAMILIES[family].smoothing else None
    return ContactModel(jnp.array(DEFAULT_SOLREF), jnp.array(DEFAULT_SOLIMP), law=law)


@cache
def line(scene: str, onset: str) -> tuple[Task, Line]:
    """A scene's task, and its cost and derivative, compiled once for all contacts of a law."""
    task = SCENES[scene]().replace(onset=onset)
    return task, Line(task)


def integrated(scene: str, family: str, onset: str, scale: float = 1.0) -> dict[str, Any]:
    """Slope of the mean cost, mean of the derivative, their errors, deviations of one sample, and time."""
    task, costs = line(scene, onset)
    contact = unmapped(family) if scene.startswith("toss") else member(task, family, scale)
    position = np.asarray(task.theta, float)
    count = POINTS if task.scene.host.nv < MANY_JOINTS else POINTS // 4
    points = grid(position[0], position[0], task.sigma, count, task.noise)
    values, slopes = costs(points, contact)
    begin = time.perf_counter()
    costs(points[:CHUNK], contact)
    took = (time.perf_counter() - begin) / CHUNK
    found, w = means(points, values, slopes, position, task.sigma, task.noise), (points - position[0]) / task.sigma
    weights = NOISES[task.noise].density(w)
    zeroth = (values - np.interp(position[0], points, values)) * w / task.sigma
    spread = [np.average((each - np.average(each, weights=weights)) ** 2, weights=weights) for each in (zeroth, slopes)]
    mean = {name: getattr(found, name)[0] for name in ("smoothed", "slope", "slope_error", "first", "first_error")}
    return mean | {"zeroth_sd": spread[0] ** 0.5, "first_sd": spread[1] ** 0.5, "seconds": took}


def sampled(name: str, family: str, onset: str) -> dict[str, Any]:
    """The same from samples; errors are standard errors."""
    task = make_task(name).replace(onset=onset)
    objective = Simulator(task, CHUNK).objective(member(task, family))
    drawn = np.random.default_rng(1).normal(size=task.policy.num_params)
    along = np.ones(task.theta.size) if name == "pusher" else drawn
    along /= np.linalg.norm(along)
    keys, pairs = (jax.random.split(jax.random.key(seed), POINTS) for seed in range(2))
    reach = task.sigma / 2
    below, above = (np.asarray(objective.evaluate(task.theta + t * along, pairs).value) for t in (-reach, reach))
    zeroth = np.asarray(zeroth_order(objective.evaluate(task.theta, keys), "zero_noise").per_sample)
    differentiate = objective.differentiate if onset == "none" else objective.differentiate_corrected
    first = np.asarray(first_order(differentiate(task.theta, keys)).per_sample)
    begin = time.perf_counter()
    jax.block_until_ready(differentiate(task.theta, keys[:CHUNK]))
    took = (time.perf_counter() - begin) / CHUNK
    slope, mean = (above - below) / (2 * reach), first @ along
    errors = (np.std(each, ddof=1) / len(each) ** 0.5 for each in (slope, mean))
    found = dict(zip(("slope_error", "first_error"), errors, strict=True))
    found |= {
        name: float(np.var(each, axis=0).sum() ** 0.5) for name, each in (("zeroth_sd", zeroth), ("first_sd", first))
    }
    return found | {"slope": slope.mean(), "first": mean.mean(), "seconds": took}


def faithful(family: str) -> dict[str, Any]:
    """What a ball of the throw does: at rest, on a slope, as it lands and slides; and the steps that it bears."""
    task = throw()
    contact, still = member(task, family), study.initial_state(task.scene)

    def way(timestep, tilt, height, velocity):
        model = apply_contact(task.scene.model, contact)
        pull = GRAVITY * jnp.stack([tilt, 0.0, -1.0])
        model = model.replace(opt=model.opt.replace(timestep=timestep, gravity=pull))
        start = State(still.qpos.at[1].set(height), velocity, still.act, still.warmstart)

        def advance(at: State, _: None) -> tuple[State, Any]:
            after = step(task.scene, model, at, jnp.zeros(0))[0]
            return after, (after.qpos, after.qvel)

        return jax.lax.scan(advance, start, None, length=1000)[1]

    cases = [(0.002, 0.0, 0.0, 0, 0), (0.002, SLOPE, 0.0, 0, 0), (0.002, 0.0, 0.05, 0, -SPEED), (0.002, 0, 0, SPEED, 0)]
    cases += [(each, 0.0, 0.01, 0.0, -SPEED) for each in STEPS]
    timestep, tilt, height, *velocity = np.array(cases, float).T
    qpos, qvel = map(np.asarray, jax.jit(jax.vmap(way))(timestep, tilt, height, np.stack(velocity, axis=1)))
    touched = np.argmax(qvel[2, :, 1] > -0.9 * SPEED)
    energy = GRAVITY * qpos[4:, :, 1] + (qvel[4:] ** 2).sum(axis=-1) / 2
    bears = np.all(energy < 2 * (GRAVITY * 0.01 + SPEED**2 / 2), axis=1)  # False where it is NaN
    return {
        "penetration": -qpos[0, -1, 1],
        "creep": qvel[1, -1, 0],
        "creep_gain": qvel[1, -1, 0] - qvel[1, -501, 0],
        "restitution": qvel[2, touched:, 1].max() / (SPEED**2 + 2 * GRAVITY * 0.05) ** 0.5,
        "way": qpos[3, -1, 0],
        "rest": abs(qvel[3, -1, 0]),
        "first_bad_step": min((each for each, good in zip(STEPS, bears, strict=True) if not good), default=np.inf),
    }


@cache
def _motion(scene: str) -> tuple[Task, Any]:
    """A scene's task, and the states of a number's rollout under a contact, by steps and their number."""
    task = SCENES[scene]()

    def rollout(contact: ContactModel, start: State, control: jax.Array, steps: int) -> tuple[jax.Array, jax.Array]:
        model = apply_contact(task.scene.model, contact)
        model = model.replace(opt=model.opt.replace(timestep=FINE))

        def advance(at: State, _: None) -> tuple[State, Any]:
            after = step(task.scene, model, at, control)[0]
            return after, (after.qpos, after.qvel)

        return jax.lax.scan(advance, start, length=steps)[1]

    return task, jax.jit(rollout, static_argnums=3)


def followed(scene: str, family: str, number: float, seconds: float, *, still: bool = False) -> tuple[Any, Any]:
    """Positions and velocities [steps, nq], [steps, nv] of a scene at one number, in steps of `FINE`; of the C engine's
    rigid limit in steps of `SHORT`. `still`: without the velocities that the scene starts with."""
    task, rollout = _motion(scene)
    policy, rest, theta = task.policy, task.start, jnp.full(1, number)
    assert isinstance(rest, State)
    noise = jnp.zeros(policy.noise_shape)
    start, control = policy.place(theta, noise, rest), policy.feedforward(theta, noise)[0]
    start = dataclasses.replace(start, qvel=jnp.zeros_like(start.qvel)) if still else start
    if family != RIGID:
        return jax.tree.map(np.asarray, rollout(member(task, family), start, control, round(seconds / FINE)))
    host = copy.copy(engine_model(task.scene, member(task, "mujoco_default")))
    host.geom_solref[:], host.opt.timestep = STIFF, SHORT
    data, found = mujoco.MjData(host), []
    data.qpos[:], data.qvel[:], data.ctrl[:] = start.qpos, start.qvel, control
    for _ in range(round(seconds / SHORT)):
        mujoco.mj_step(host, data)
        found.append((data.qpos.copy(), data.qvel.copy()))
    qpos, qvel = zip(*found, strict=True)
    return np.array(qpos), np.array(qvel)


def bodies(family: str) -> dict[str, Any]:
    """What a law does with a ball that rolls, a stack at rest, and a quadruped that stands and lands."""
    rolling = followed("roll", family, SPEED, 1.0)[1]
    stacked, moving = followed("stack", family, 0.0, 2.0, still=True)
    standing, drifting = followed("quadruped standing", family, 0.0, 2.0)
    landed = followed("quadruped landing", family, 0.05, 0.4)[0]
    return {
        "rolling": rolling[-1, 0],
        "rolling_loss": rolling[len(rolling) // 2, 0] - rolling[-1, 0],
        "lower": -stacked[-1, 1],
        "upper": -stacked[-1, 3],
        "stack_speed": np.abs(moving[-1]).max(),
        "stands_at": standing[-1, 2],
        "drift": np.linalg.norm(drifting[-1, :2]),
        "lowest": landed[:, 2].min(),
        "way": landed[-1, 0],
    }


def trained(name: str, family: str, onset: str, estimator: str, times: int = 1) -> dict[str, Any]:
    """Costs of the policies that descents reach under a law, and of the same in the C engine with MuJoCo's default;
    `times` multiplies the iterations."""
    task = make_task(name)
    given: dict[str, Any] = TRAINED[name] | {"iterations": times * TRAINED[name]["iterations"]}
    if stiff := as_stiff(task, family):
        given |= stiff | {"stiffness": (stiff["stiffness"],)}
    about = StudyConfig(
        kind="descents", tasks=(name,), contact=(family,), estimators=(estimator,), seeds=SEEDS, onset=onset, **given
    )
    begin = time.perf_counter()
    found = run_study(about)
    took = time.perf_counter() - begin
    engine = [executed(task, each) for each in np.asarray(found["theta"]).reshape(SEEDS, -1)]
    own = np.asarray(found["final_cost"]).ravel().tolist()
    return {"own": own, "engine": engine, "start": executed(task, np.asarray(task.theta)), "seconds": took}


def executed(task: Task, theta: Any) -> float:
    """Mean cost over noise of a policy without feedback, executed by the C engine with MuJoCo's default."""
    host = engine_model(task.scene, member(task, "mujoco_default"))
    drawn = task.sigma * np.random.default_rng(0).standard_normal((DRAWS, *task.policy.noise_shape))
    start: Any = task.start
    first, inputs = jax.vmap(
        lambda noise: (task.policy.place(theta, noise, start), task.policy.feedforward(theta, noise))
    )(jnp.asarray(drawn))
    qpos = np.zeros((DRAWS, task.horizon + 1, host.nq))
    qvel, controls = np.zeros((DRAWS, task.horizon + 1, host.nv)), np.asarray(inputs)
    for draw in range(DRAWS):
        data = mujoco.MjData(host)
        data.qpos[:], data.qvel[:] = first.qpos[draw], first.qvel[draw]
        for index in range(task.horizon + 1):
            qpos[draw, index], qvel[draw, index] = data.qpos, data.qvel
            if index < task.horizon:
                data.ctrl[:] = controls[draw, index]
                mujoco.mj_step(host, data)
    running, final = task.costs()

    def cost(qpos, qvel, controls):
        states = jax.vmap(lambda q, v: State(q, v, task.start.act, task.start.warmstart))(qpos, qvel)
        each = jax.vmap(running)(jax.tree.map(lambda leaf: leaf[:-1], states), controls)
        return each.sum() + final(jax.tree.map(lambda leaf: leaf[-1], states))

    return float(jax.jit(jax.vmap(cost))(qpos, qvel, controls).mean())


def checked(name: str, family: str, cone: str) -> dict[str, Any]:
    """Verdict and largest errors of `gradcheck` under a law, at the task's middle stiffness."""
    task = make_task(name, **({"cone": cone} if cone else {}))
    swept = (task.defaults.middle_stiffness,) if FAMILIES[family].swept else None
    report = gradcheck(plan_gradcheck(task, (family,), swept, seed=0))
    (of_cost,), (of_step,) = report.costs, report.steps
    return {
        "verdicts": [of_cost.verdict, of_step.verdict],
        "failing": [each.line() for each in report.findings if each.fails],
        "stiffness": of_cost.stiffness,
        "of_cost": of_cost.difference,
        "of_step": of_step.differences,
        "of_parameters": of_step.parameters,
        "exercised": of_step.coverage.line(),
    }


def compared(name: str, family: str, cone: str, smoothing: float | None = None) -> dict[str, Any]:
    """What `compare` says of first order's mean under a law, at the task's middle stiffness."""
    given: dict[str, Any] = {"cone": (cone,)} if cone else {}
    given |= {"smoothing": smoothing, "samples": (BATCH,), "reference_samples": BATCH}
    if FAMILIES[family].swept:
        given["stiffness"] = (make_task(name).defaults.middle_stiffness,)
    about = StudyConfig(tasks=(name,), contact=(family,), estimators=("zobg", "fobg"), **given)
    zeroth, first = rows_of(run_study(about))
    return {
        "verdict": first.bias_verdict,
        "p": first.bias_p_value,
        "error": first.relative_error,
        "uncertainty": first.reference_uncertainty,
        "variances": first.variance / zeroth.variance,
        "norm": first.gradient_norm,
        "residual": first.residual,
        "bad": first.unconverged + first.nonfinite + zeroth.nonfinite,
    }


def afloat(family: str, smoothing: float | None = None) -> dict[str, Any]:
    """Under a law with a smoothing [J], what `compare` says of `sliding_box`, how high its block floats [m], and in
    which share of `AFLOAT` rollouts with noise it ends above its box."""
    task = make_task("sliding_box", cone="pyramidal")
    contact, rollout = single_contact(task, family, smoothing=smoothing)[0].contact, compiled_rollout(task)
    assert task.metrics is not None

    def states(key: Any, noise_scale: float) -> Any:
        return rollout(task.theta, contact, key, jnp.full((), noise_scale))[0]

    keys = jax.random.split(jax.random.key(0), AFLOAT)
    aboard = [float(task.metrics(states(key, 1.0))["aboard"]) for key in keys]
    height = float(states(keys[0], 0.0).qpos[-1, 1])
    return compared(task.name, family, "pyramidal", smoothing) | {"height": height, "aboard": np.mean(aboard)}


def corner(friction: float | None = None, timestep: float = 0.002, scale: float = 1.0) -> dict[str, Any]:
    """Where Kelvin-Voigt's cost on `ball_wall` is steepest: the share of its mean's slope between three points of the
    grid there, and the share of this change of the cost that lies in `NARROW`."""
    task = make_task("ball_wall", timestep=timestep, horizon=round(DURATION / timestep))
    contact, position, costs = member(task, "kelvin_voigt", scale), np.asarray(task.theta, float), Line(task)
    if friction is not None:
        contact = dataclasses.replace(contact, friction=jnp.array([friction, *task.scene.host.geom_friction[0, 1:]]))
    points = grid(position[0], position[0], task.sigma, POINTS, task.noise)
    values, slopes = costs(points, contact)
    slope = means(points, values, slopes, position, task.sigma, task.noise).slope[0]
    density = NOISES[task.noise].density((points - position[0]) / task.sigma) / task.sigma
    shares = density[1:-1] * (values[2:] - values[:-2]) / slope
    worst = 1 + int(np.argmax(np.abs(np.diff(values, 2)) * density[1:-1]))
    inside = np.linspace(points[worst - 1], points[worst + 1], POINTS + 1)
    fine = costs(inside, contact)[0]
    across = round(NARROW / (inside[1] - inside[0]))
    narrow = np.abs(fine[across:] - fine[:-across]).max() / abs(fine[-1] - fine[0])
    return {"share": shares[worst - 1], "narrow": narrow, "at": points[worst], "slope": slope}
