"""Tables of docs/which-contact.md: what each contact law's first-order gradients cost and buy.

    python -m experiments.laws             # measure what data/laws*.jsonl lack, with the extra `laws`
    python -m experiments.laws gradcheck   # the same of one scene, or kind of scene
    python -m experiments.laws page        # write the tables

All at MuJoCo's default stiffness: K is that of solref (0.02, 1) for the contact's effective mass. In `SCENES` noise
acts on one number, and means are quadrature; in `SAMPLED` they are means over samples, along a direction of theta.
"""

import dataclasses
import itertools
import json
import sys
import time
from collections.abc import Callable
from functools import cache, partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy import stats

import mjx_study as study
from estimators import NOISES, first_order, zeroth_order
from experiments import DATA, DOCS
from experiments.pages import write_tables
from mjx_study.choices import DEFAULT_SOLREF, FAMILIES, TASK_DESCRIPTIONS
from mjx_study.execution.run import run_study
from mjx_study.experiment.quadrature import Line, grid, means
from mjx_study.gradcheck import gradcheck, plan_gradcheck
from mjx_study.objective import Simulator
from mjx_study.options.configuration import StudyConfig
from mjx_study.runtime import configure
from mjx_study.simulation.contact import (
    ContactModel,
    apply_contact,
    cone_edges,
    family_model,
    stiffness_from_solref,
)
from mjx_study.simulation.dynamics import State, step
from mjx_study.simulation.engine import engine_model
from mjx_study.simulation.law import LAWS as OTHERS
from mjx_study.simulation.scene import put_scene
from mjx_study.table import markdown_table
from mjx_study.tasks import make_task
from mjx_study.tasks.task import Task

CELLS, CHECKS = DATA / "laws.jsonl", DATA / "laws_checks.jsonl"
LAWS: Final = {
    "MuJoCo's default": ("mujoco_default", "none"),
    "with the onset term": ("mujoco_default", "linear"),
    **{name: (name, "none") for name in ("smooth_onset", "penalty", *OTHERS)},
}
"""Contact family and onset term by the name of a row."""
POINTS, CHUNK = 4000, 250
"""Points, samples and pairs; samples per call."""
TIMESTEP, GAP, SPREAD = 0.005, 0.05, 0.005  # [s], [m], [m]
SPEED, FRICTION, GRAVITY = 1.0, 1.0, 9.81  # [m/s], -, [m/s^2]
SLOPE: Final = 0.5
"""Of the ground on which a ball of friction 1 rests."""
STEPS: Final = (0.001, 0.002, 0.004, 0.006, 0.008, 0.01, 0.015, 0.02, 0.03, 0.04, 0.06, 0.08)
MEANS: Final = ("toss", "ball_wall", "slide", "corners", "box", "pusher", "tennis", "landing")
KAPPAS: Final = ("toss, kappa 0.1", "toss", "toss, kappa 10")
ZEROTH: Final = "MuJoCo's default, zeroth order"
THROWN: Final = """<mujoco><option timestep="{}"/><worldbody><geom name="floor" type="plane" size="20 20 1" condim="3"/>
  <body pos="0 0 0.1"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>{}</body></worldbody>
  </mujoco>"""
GEOMS: Final = {
    "ball": '<geom name="thrown" size="0.1" mass="1" condim="3"/>',
    "box": '<joint axis="0 1 0"/><geom name="thrown" type="box" size="0.2 0.2 0.1" mass="1" condim="3"/>',
    "corners": '<joint axis="0 1 0"/><inertial pos="0 0 0" mass="1" diaginertia="0.0167 0.0167 0.0267"/>'
    + "".join(
        f'<geom name="{name}" size="0.001" pos="{x} {y} -0.099" condim="3"/>'
        for name, x, y in (("thrown", 0.199, 0.199), ("b", -0.199, 0.199), ("c", 0.199, -0.199), ("d", -0.199, -0.199))
    ),
}
"""The corners are spheres in place of the box's lower four."""


def thrown(name: str, geom: str, horizon: int, start: Callable[[State, Any], State], at: float, sigma: float, cost):
    """Return a task of one number that sets the start of a ball or box above the ground."""
    scene = put_scene(mujoco.MjModel.from_xml_string(THROWN.format(TIMESTEP, GEOMS[geom])), name)
    return study.Task(
        name=name,
        scene=scene,
        horizon=horizon,
        policy=study.InitialStatePolicy(1, horizon, 0, start),
        theta=jnp.full(1, at),
        sigma=sigma,
        start=study.initial_state(scene),
        final_cost=cost,
        contact_pair=("thrown", "floor"),
    )


def toss() -> Task:
    """A ball falls through a gap [m] at 1 m/s down and along."""
    moving = jnp.array([SPEED, -SPEED])
    start = lambda rest, gap: State(rest.qpos.at[1].set(gap[0]), moving, rest.act, rest.warmstart)  # noqa: E731
    return thrown("toss", "ball", 80, start, GAP, SPREAD, lambda last: 100 * last.qpos[1] ** 2 + last.qpos.sum())


def box(geom: str = "box") -> Task:
    """A box tilted by 0.2 rad falls onto an edge, then the other; the gap [m] is below the first."""
    lower = 0.2 * np.sin(0.2) + 0.1 * np.cos(0.2) - 0.1
    moving = jnp.array([SPEED / 2, -SPEED, 0.0])

    def start(rest: State, gap: jax.Array) -> State:
        return State(jnp.stack([0.0, gap[0] + lower, 0.2]), moving, rest.act, rest.warmstart)

    return thrown(geom, geom, 80, start, GAP, SPREAD, lambda last: 100 * last.qpos[1] ** 2 + last.qpos.sum())


def slide() -> Task:
    """A ball that cannot turn slides to rest from a speed [m/s]; the cost is its way [m]."""
    start = lambda rest, speed: State(rest.qpos, rest.qvel.at[0].set(speed[0]), rest.act, rest.warmstart)  # noqa: E731
    return thrown("slide", "ball", 60, start, SPEED, 0.1 * SPEED, lambda last: last.qpos[0])


SCENES: Final[dict[str, Callable[[], Task]]] = {
    **{"toss": toss, "slide": slide, "box": box, "corners": partial(box, "corners")},
    "ball_wall": partial(make_task, "ball_wall"),
}
SAMPLED: Final = ("pusher", "tennis", "landing")
TRAINED: Final = {
    "pusher": {"iterations": 200, "samples": (10,)},
    "ball_wall": {"iterations": 40, "samples": (30,), "learning_rate": 1.0},
}
SEEDS, DRAWS = 3, 1000
CORNER: Final[dict[str, dict[str, float]]] = {
    "the task": {},
    **{f"friction {each:g}": {"friction": each} for each in (2.0, 1.0, 0.5)},
    **{f"steps of {1e3 * each:g} ms": {"timestep": each} for each in (1e-3, 5e-4)},
    **{f"kappa x {each:g}": {"scale": each} for each in (0.1, 10.0)},
}
"""Changes of `ball_wall` and of Kelvin-Voigt on it."""
DURATION, NARROW = 0.8, 1e-6  # [s], [rad]
PYRAMIDAL: Final = {*itertools.product(("sliding_box", "ball_wall", "gripper", "landing"), ("log_barrier", "conic"))}
"""Tasks and laws that need pyramidal cones."""
CHECKED: Final = tuple(name for name in TASK_DESCRIPTIONS if not name.endswith((":dome", ":published")))


def member(task: Task, family: str, scale: float = 1.0) -> ContactModel:
    """Return the contact model of a family at MuJoCo's default stiffness; `scale` multiplies its smoothing."""
    of = FAMILIES[family]
    assert task.contact_pair is not None
    given: dict[str, Any] = {"effective_mass": task.effective_mass, "edges": cone_edges(task.scene, *task.contact_pair)}
    if of.swept:
        given["stiffness"] = stiffness_from_solref(DEFAULT_SOLREF, effective_mass=task.effective_mass)[0]
        given["damping"] = None if of.dampratio or of.smoothing else task.defaults.damping
    return family_model(family, task.scene, smoothing=of.smoothing * scale or None, **given)


@cache
def line(scene: str, onset: str) -> tuple[Task, Line]:
    """A scene's task, and its cost and derivative, compiled once for all contacts of a law."""
    task = SCENES[scene]().replace(onset=onset)
    return task, Line(task)


def integrated(scene: str, family: str, onset: str, scale: float = 1.0) -> dict[str, Any]:
    """Slope of the mean cost, mean of the derivative, their errors, deviations of one sample, and time."""
    task, costs = line(scene, onset)
    contact, position = member(task, family, scale), np.asarray(task.theta, float)
    points = grid(position[0], position[0], task.sigma, POINTS, task.noise)
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
    """What a ball of the toss does: at rest, on a slope, as it lands and slides; and the steps that it bears."""
    task = toss()
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


def trained(name: str, family: str, onset: str, estimator: str) -> dict[str, Any]:
    """Costs of the policies that descents reach under a law, and of the same in the C engine with MuJoCo's default."""
    task, of = make_task(name), FAMILIES[family]
    given: dict[str, Any] = dict(TRAINED[name])
    if of.swept:
        given["stiffness"] = (stiffness_from_solref(DEFAULT_SOLREF, effective_mass=task.effective_mass)[0],)
        given["damping"] = None if of.dampratio or of.smoothing else task.defaults.damping
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
    stiffnesses = task.defaults.stiffnesses
    swept = (float(stiffnesses[len(stiffnesses) // 2]),) if FAMILIES[family].swept else None
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


def cells() -> dict[tuple[str, str], Callable[[], dict[str, Any]]]:
    """What is measured, by scene and row."""
    found: dict[tuple[str, str], Callable[[], dict[str, Any]]] = {}
    for scene, (row, each) in itertools.product(("toss", "faithful", "ball_wall"), LAWS.items()):
        found[scene, row] = partial(faithful, each[0]) if scene == "faithful" else partial(integrated, scene, *each)
    for name in TRAINED:
        for row, each in LAWS.items():
            found[f"train {name}", row] = partial(trained, name, *each, "fobg")
        found[f"train {name}", ZEROTH] = partial(trained, name, *LAWS["MuJoCo's default"], "zobg")
        for row, each in LAWS.items() if name == "ball_wall" else ():
            found["pusher", row] = partial(sampled, "pusher", *each)
    for row, scale in itertools.product(("log_barrier", "hunt_crossley"), (0.1, 10.0)):
        found[f"toss, kappa {scale:g}", row] = partial(integrated, "toss", row, "none", scale)
    for scene, (row, each) in itertools.product(("slide", "tennis", "landing", "box", "corners"), LAWS.items()):
        found[scene, row] = partial(sampled if scene in SAMPLED else integrated, scene, *each)
    for row, scale in itertools.product(("kelvin_voigt", "conic"), (0.1, 10.0)):
        found[f"toss, kappa {scale:g}", row] = partial(integrated, "toss", row, "none", scale)
    found |= {("corner", row): partial(corner, **changes) for row, changes in CORNER.items()}
    for name, law, cone in itertools.product(CHECKED, OTHERS, ("", "pyramidal")):
        if not cone or (name, law) in PYRAMIDAL:
            found[f"gradcheck {name}{' ' * bool(cone)}{cone}", law] = partial(checked, name, law, cone)
    return found


def measured() -> dict[tuple[str, str], dict[str, Any]]:
    """The numbers of both files by scene and row."""
    lines = [line for path in (CELLS, CHECKS) if path.exists() for line in path.read_text().splitlines()]
    return {(each.pop("scene"), each.pop("row")): each for each in map(json.loads, lines)}


def measure(only: list[str]) -> None:
    """Append what is missing, of the scenes named or all."""
    known = measured()
    for (scene, row), compute in cells().items():
        if (scene, row) in known or (only and not {scene, scene.partition(" ")[0]} & set(only)):
            continue
        begin = time.perf_counter()
        try:
            numbers = compute()
        except ValueError as error:
            numbers = {"refused": str(error)}
        numbers = {
            name: float(each) if np.ndim(each) == 0 and not isinstance(each, str | None) else each
            for name, each in numbers.items()
        }
        with (CHECKS if scene.startswith(("gradcheck", "corner")) else CELLS).open("a") as file:
            file.write(json.dumps({"scene": scene, "row": row, **numbers}) + "\n")
        print(f"{scene}, {row}: {time.perf_counter() - begin:.0f} s", flush=True)


def tables() -> dict[str, str]:
    """The tables of the page; a dash where nothing was measured."""
    found = measured()

    def cell(scene: str, row: str, say: Callable[[dict[str, Any]], str]) -> str:
        numbers = found.get((scene, row), {})
        return "refused" if "refused" in numbers else say(numbers) if numbers else "-"

    def bias(of: dict[str, Any]) -> str:
        error = 100 * (of["first_error"] + of["slope_error"]) / abs(of["slope"])
        shown = f"{100 * (of['first'] / of['slope'] - 1):.1f}".replace("-0.0", "0.0")
        return f"{shown} %" if error < 0.05 else f"{shown} ± {float(f'{error:.1g}'):g} %"

    def deviation(of: dict[str, Any]) -> str:
        return f"{of['first_sd'] / of['zeroth_sd']:.2g}"

    def share(row: str) -> str:
        return cell("toss", row, lambda of: f"{1e3 * of['seconds']:.2g}")

    def interval(costs: list[float], scale: float) -> str:
        half = stats.t.ppf(0.975, len(costs) - 1) * np.std(costs, ddof=1) / len(costs) ** 0.5
        return f"{scale * np.mean(costs):.4g} ± {scale * half:.1g}"

    means = [[row, *(cell(scene, row, bias) for scene in MEANS), share(row)] for row in LAWS]
    spreads = [[row, *(cell(scene, row, deviation) for scene in MEANS)] for row in LAWS]
    says: dict[str, Callable[[dict[str, Any]], str]] = {
        "depth at rest [mm]": lambda of: f"{1e3 * of['penetration']:.2g}",
        "creep [mm/s]": lambda of: "slides" if of["creep_gain"] > 0.1 else f"{1e3 * of['creep']:.2g}",
        "restitution": lambda of: f"{abs(of['restitution']):.2f}",
        "way [mm]": lambda of: "slides" if of["rest"] > 0.1 else f"{1e3 * of['way']:.1f}",
        "stable below [ms]": lambda of: "> 80" if of["first_bad_step"] > 1 else f"{1e3 * of['first_bad_step']:.0f}",
    }
    plain = [row for row, (_, onset) in LAWS.items() if onset == "none"]
    fidelity = [[row, *(cell("faithful", row, say) for say in says.values())] for row in plain]
    descents = [
        [row]
        + [
            cell(f"train {name}", row, lambda of, key=key, scale=scale: interval(of[key], scale))
            for name, scale in (("pusher", 1.0), ("ball_wall", 1e3))
            for key in ("own", "engine")
        ]
        + [cell("train pusher", row, lambda of: f"{of['seconds']:.0f}")]
        for row in (*LAWS, ZEROTH)
    ]
    kappas = [
        [row, *(cell(scene, row, lambda of: f"{of['first_sd'] / of['zeroth_sd']:.3g}") for scene in KAPPAS)]
        for row in OTHERS
    ]

    def verdict(of: dict[str, Any]) -> str:
        errors = (of[name] for name in ("of_cost", "of_step", "of_parameters") if of[name] is not None)
        kinds = {kind: f", {kind}s" for kind in ("kink", "jump") if kind in of["verdicts"]}
        return "wrong" if of["failing"] else f"right{''.join(kinds.values())} ({max(errors):.0e})"

    def of_task(name: str, law: str) -> str:
        turned = f"gradcheck {name} pyramidal"
        marked = lambda of: f"{verdict(of)} *"  # noqa: E731
        return cell(turned, law, marked) if (name, law) in PYRAMIDAL else cell(f"gradcheck {name}", law, verdict)

    checks = [[f"`{name}`", *(of_task(name, law) for law in OTHERS)] for name in CHECKED]
    shares: dict[str, Callable[[dict[str, Any]], str]] = {
        "share of the slope": lambda of: f"{100 * of['share']:.1f} %",
        "of it in 1e-6 rad": lambda of: f"{100 * of['narrow']:.2g} %",
    }
    corners = [[row, *(cell("corner", row, say) for say in shares.values())] for row in CORNER]
    ways = "pusher: own", "in C", "ball_wall: own [1e-3]", "in C [1e-3]", "pusher [s]"
    rows = {
        "means": (("law", *MEANS, "ms per gradient"), means),
        "deviations": (("law", *MEANS), spreads),
        "fidelity": (("law", *says), fidelity),
        "descents": (("law", *ways), descents),
        "smoothing": (("law", "kappa / 10", "kappa", "10 kappa"), kappas),
    }
    rows |= {"gradcheck": (("task", *OTHERS), checks), "corner": (("`ball_wall`", *shares), corners)}
    return {name: markdown_table(lines, header) for name, (header, lines) in rows.items()}


def main() -> None:
    """Run the command line."""
    if sys.argv[1:] == ["page"]:
        write_tables(DOCS / "which-contact.md", tables())
        return
    configure(cpu_devices=1)
    measure(sys.argv[1:])


if __name__ == "__main__":
    main()
