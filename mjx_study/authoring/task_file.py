"""The text of a task file: Python that a user goes on with, with the reasons for its numbers."""

import json
import keyword
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import mujoco
import numpy as np

from mjx_study.authoring.proposal import HELD, ITERATIONS, SAMPLES, TRIALS, WEIGHT, Proposal
from mjx_study.authoring.trial import Touch
from mjx_study.simulation.contact_pair import geom_label
from mjx_study.table import number

IMPORTED: Final = frozenset({"Path", "jnp", "replace", "study"})
"""Names of the file's imports."""
_JOINT: Final = int(mujoco.mjtTrn.mjTRN_JOINT)
AXES: Final = ("x", "y", "z")
MOST_LISTED: Final = 8
"""Maximum number of contacts listed."""


def function_name(mjcf: Path) -> str:
    """A Python name for the task of an MJCF."""
    name = re.sub(r"\W", "_", mjcf.stem, flags=re.ASCII)
    usable = name.isidentifier() and not keyword.iskeyword(name) and name not in IMPORTED
    return name if usable else f"model_{name}"


def module_name(mjcf: Path) -> str:
    """Name of the module with the task of an MJCF."""
    return f"{function_name(mjcf)}_task"


def source_of_task(mjcf: Path, found: Proposal) -> str:
    """Python source of a module with a task, to be written beside the MJCF."""
    host, drive, name = found.scene.host, found.drive, function_name(mjcf)
    place, swept = f"{module_name(mjcf)}:{name}", found.load is not None and found.pair is not None
    lines = [
        f'"""A task for {_comment(mjcf.name)}, proposed by mjx-study init. Everything here is meant to be changed.',
        "",
        f"mjx-study rollout {place}     a film of what happens by itself",
        f"mjx-study compare {place}     which gradient estimator{', at which contact stiffness' if swept else ''}?",
        f"mjx-study optimise {place}    reach the goal",
        '"""',
        "",
        *(["from dataclasses import replace"] if drive.at_start else []),
        "from pathlib import Path",
        "",
        "import jax.numpy as jnp",
        "",
        "import mjx_study as study",
        "",
        *_findings(found),
        "",
        "",
        f"def {name}(horizon={found.horizon}, model=Path(__file__).with_name({_quoted(mjcf.name)}), **options):",
        "    scene = study.load_scene(model, **options)",
        *_start(host),
        *(_velocities(found) if drive.at_start else _controls(found)),
        *_costs(found),
        "    return study.Task(",
        f"        name={_quoted(mjcf.stem)},",
        f"        description={_quoted(_description(found))},",
        "        scene=scene,",
        "        horizon=horizon,",
        "        policy=policy,",
        "        theta=theta,",
        f"        # The noise's standard deviation: {drive.meaning}.",
        "        # More spreads contact over more steps, and smooths the cost that is optimised.",
        f"        sigma={drive.scale!r},",
        "        start=start,",
        *([] if drive.at_start else ["        running_cost=running_cost,"]),
        "        final_cost=final_cost,",
        *_contact(found),
        "    )",
    ]
    return "\n".join(lines) + "\n"


def _findings(found: Proposal) -> Iterator[str]:
    """Comments: what the test rollouts showed."""
    host, timestep = found.scene.host, found.scene.timestep
    yield (
        f"# Test rollouts in MuJoCo's C engine, with the MJCF's contact, one without and {TRIALS} with noise, "
        f"{found.horizon} steps of {timestep:g} s:"
    )
    by_time = sorted(found.touches.items(), key=lambda item: item[1].first)
    for pair, touch in by_time[:MOST_LISTED]:
        yield f"#   {_touch(host, pair, touch, timestep, found.shares[pair])}"
    if len(by_time) > MOST_LISTED:
        yield f"#   and {len(by_time) - MOST_LISTED} more contacts"
    if not by_time:
        yield "#   nothing touches"
    if found.limits:
        yield f"#   at their limits: {_comment(', '.join(found.limits))}"


def _touch(host: mujoco.MjModel, pair: tuple[int, int], touch: Touch, timestep: float, share: float) -> str:
    names = " and ".join(geom_label(host, geom) for geom in pair)
    begin = "touch from the start" if touch.first <= 1 else f"touch after {number(touch.first * timestep, 2)} s"
    speed = f" at {number(touch.speed, 2)} m/s" if touch.first > 1 else ""
    often = "" if share == 1 else f", in {share:.0%} of the rollouts"
    return _comment(f"{names}: {begin}{speed}, up to {number(1e3 * touch.depth, 2)} mm deep{often}")


def _start(host: mujoco.MjModel) -> Iterator[str]:
    if host.nkey:
        yield "    qpos, qvel = jnp.array(scene.host.key_qpos[0]), jnp.array(scene.host.key_qvel[0])"
        yield "    start = study.initial_state(scene, qpos, qvel)  # the first keyframe"
    else:
        yield "    start = study.initial_state(scene)  # the reference pose, at rest"


def _controls(found: Proposal) -> Iterator[str]:
    """Policy over the actuators, and the cost of their controls."""
    host, drive = found.scene.host, found.drive
    names = ", ".join(_actuator(host, index) for index in range(host.nu))
    source = "the first keyframe's" if host.nkey else "zero, or as near to it as their ranges allow"
    yield f"    neutral = jnp.array({_numbers(drive.neutral)})  # controls at the start: {source}"
    yield f"    # theta: the controls of every step ({_comment(names)})"
    yield "    policy = study.OpenLoop(horizon, scene.host.nu)"
    yield "    theta = jnp.tile(neutral, horizon)"
    yield ""
    most = f"{HELD * drive.scale:g}"
    yield f"    def running_cost(state, control):  # effort: {WEIGHT:g} if all controls stay {most} from neutral"
    yield f"        return {WEIGHT:g} * jnp.mean(((control - neutral) / {most}) ** 2) / horizon"
    yield ""


def _actuator(host: mujoco.MjModel, index: int) -> str:
    """An actuator's name, or else its joint's, or its number."""
    joint = host.joint(host.actuator_trnid[index, 0]).name if host.actuator_trntype[index] == _JOINT else ""
    return host.actuator(index).name or joint or f"actuator {index}"


def _velocities(found: Proposal) -> Iterator[str]:
    """Policy over initial velocities."""
    yield ""
    yield "    def start_at(start, change):  # theta: added to the initial velocities, since there are no actuators"
    yield "        return replace(start, qvel=start.qvel + change)"
    yield ""
    yield "    policy = study.InitialStatePolicy(scene.host.nv, horizon, 0, start_at)"
    yield "    theta = jnp.zeros(scene.host.nv)"
    yield ""


def _costs(found: Proposal) -> Iterator[str]:
    """The final cost."""
    host, aim = found.scene.host, found.aim
    distance = f"{aim.distance:g}"
    if aim.body is None:
        yield f"    # By itself qpos[{aim.axis}] ends at {number(aim.end[0], 3)}. The goal is {distance} away."
        yield f"    goal = {aim.goal[0]!r}"
        yield ""
        yield f"    def final_cost(state):  # 1 if it ends {distance} from the goal"
        yield f"        return ((state.qpos[{aim.axis}] - goal) / {distance}) ** 2"
    else:
        name = host.body(aim.body).name
        index = f"scene.body({_quoted(name)})" if name else str(aim.body)
        where = ", ".join(number(value, 3) for value in aim.end)
        yield f"    body = {index}  # the {aim.role}"
        yield f"    # By itself its centre of mass ends at ({where}) m."
        yield f"    # The goal is {distance} m {'further' if aim.side > 0 else 'back'} along {AXES[aim.axis]}."
        yield f"    goal = jnp.array({_numbers(aim.goal)})"
        yield ""
        yield f"    def final_cost(state):  # squared distance from the goal: 1 at {distance} m"
        yield f"        return jnp.sum((state.xipos[body] - goal) ** 2) / {distance}**2"
    yield ""


def _contact(found: Proposal) -> Iterator[str]:
    """The swept contact, and defaults for studies."""
    recipe = (
        "# The learning rate is half of the best step down the slopes over held controls in MuJoCo's C engine;",
        "# iterations and samples are a first try: watch whether the cost still falls at the end, and smoothly.",
        f"recipe=study.Recipe(learning_rate={found.learning_rate!r}, iterations={ITERATIONS}, samples={SAMPLES}),",
    )
    if found.load is None or found.pair is None:
        if found.touches:
            yield "        # To sweep a contact's stiffness, name its geoms in the MJCF and here, and remove families."
        yield "        contact_pair=None,"
        yield "        defaults=study.StudyDefaults("
        yield '            families=("mjcf",),  # contact as the MJCF has it'
        yield from (f"            {line}" for line in recipe)
        yield "        ),"
        return
    low, high = found.stiffnesses[0], found.stiffnesses[-1]
    pair = ", ".join(map(_quoted, found.pair))
    yield f"        contact_pair=({pair}),  # its stiffness is swept; all contacts of the scene share the model"
    yield "        defaults=study.StudyDefaults("
    depth = number(1e3 * found.load.depth(low), 2)
    yield f"            # [N/m] At {low:g} impact or weight sink in {depth} mm; the timestep resolves up to {high:g}."
    yield f"            stiffnesses={found.stiffnesses!r},"
    yield f"            damping={found.damping!r},  # [N s/m] in families without a damping ratio; friction needs some"
    yield from (f"            {line}" for line in recipe)
    yield "        ),"


def _description(found: Proposal) -> str:
    aim, host = found.aim, found.scene.host
    subject = f"qpos[{aim.axis}]" if aim.body is None else host.body(aim.body).name or f"body {aim.body}"
    unit = "" if aim.body is None else f" m along {AXES[aim.axis]}"
    means = "initial velocities" if found.drive.at_start else "open-loop controls"
    return f"move {_comment(subject)} by {aim.distance:g}{unit}; {means}"


def _numbers(values: np.ndarray | tuple[float, ...]) -> str:
    return f"[{', '.join(repr(float(value)) for value in values)}]"


def _quoted(text: str) -> str:
    """A string literal in double quotes."""
    return json.dumps(text, ensure_ascii=False)


def _comment(text: str) -> str:
    """A name in one line of a comment or docstring."""
    return " ".join(text.split()).replace("\\", "/").replace('"""', "'''")
