"""Rollouts as mjx-study rollout simulates, draws and describes them."""

import argparse
import dataclasses
from collections.abc import Callable
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_study import objective
from mjx_study.choices import CONES, is_file, laws_of, takes_stiffness
from mjx_study.cli.options import configure_process, given_options, task_of, theta_and_policy, usage_errors
from mjx_study.cli.output import attempt, computing, print_report
from mjx_study.disk import prepare_folder, write_whole
from mjx_study.experiment.resolution import at_theta
from mjx_study.limits import LARGEST_COORDINATE, MOST_STEPS, check_count
from mjx_study.options.configuration import BUILDER_OPTIONS, SCENE_OPTIONS, as_arguments
from mjx_study.options.option import OptionError, reject_unused
from mjx_study.options.parser import UsageError
from mjx_study.plots.style import save_figure
from mjx_study.render import Motion, RenderError, animate, check_format, resolve_renderer, strip, stroboscope
from mjx_study.simulation.names import coordinates
from mjx_study.simulation.scene import load_model
from mjx_study.table import format_table, number
from mjx_study.tasks.contact_grid import ContactPoint, single_contact
from mjx_study.tasks.network import with_network
from mjx_study.tasks.task import Task

FILE_SECONDS: Final = 2.0  # duration of a file's rollout without --horizon [s]
OF_TASKS: Final = ("contact", "stiffness", "damping", "smoothing", "noisy", "sigma", "theta", "model", "seed")
"""Options that a file does not read."""
MOST_BODIES_LISTED: Final = 12  # maximum number of bodies, and of joints, whose final positions are printed


@dataclasses.dataclass(frozen=True, eq=False)
class Rollout:
    """A simulated rollout, with one control fewer than states.

    Attributes:
        source: what was simulated and at what cost, as JSON data.
        focus: geoms to keep in view.
    """

    title: str
    model: mujoco.MjModel
    qpos: np.ndarray
    qvel: np.ndarray
    controls: np.ndarray
    source: dict[str, Any]
    focus: tuple[int, ...] = ()

    @cached_property
    def time(self) -> np.ndarray:
        """Time of each state [s]."""
        return np.arange(len(self.qpos)) * self.model.opt.timestep

    @cached_property
    def motion(self) -> Motion:
        """The states before the first nonfinite one; UsageError if there are none."""
        good = np.all(np.abs(np.concatenate([self.qpos, self.qvel], axis=1)) < LARGEST_COORDINATE, axis=1)
        lasting = len(good) if good.all() else int(np.argmin(good))
        if lasting == 0:
            raise UsageError(f"{self.title}: the first state is not finite")
        return Motion(self.model, self.time[:lasting], self.qpos[:lasting], self.focus)

    @cached_property
    def facts(self) -> dict[str, Any]:
        """The source with steps, duration [s], the last finite joint coordinates, and where bodies are then, by their
        centres of mass [m]."""
        model, motion, steps = self.model, self.motion, len(self.controls)
        joints = [name for name, _ in coordinates(model)]
        bodies = {model.body(body).name or f"body {body}": body for body in np.flatnonzero(motion.moving)}
        return self.source | {
            "steps": steps,
            "duration": steps * model.opt.timestep,
            "finite": len(motion.time) > steps,
            "qpos": dict(zip(joints, motion.qpos[-1].tolist(), strict=True)),
            "bodies": {name: motion.poses.centre[-1, body].tolist() for name, body in bodies.items()},
        }


def run_rollout(options: argparse.Namespace) -> int:
    with usage_errors():
        configure_process(options)
        check_format(options.format)
        reject_unused(
            given_options(options, *OF_TASKS),
            (OF_TASKS, not is_file(options.task), f"is for a task: {options.task} moves as its MJCF says"),
            (["sigma"], options.noisy, "has an effect only with --noisy"),
        )
        simulate, messages = _plan_file(options) if is_file(options.task) else _plan_task(options)
        resolve_renderer(options.renderer)
        stem = (Path(options.task).stem if is_file(options.task) else options.task).replace(":", "-")
        folder = prepare_folder(options.output or Path("results") / f"{stem}-rollout")
    with computing() as progress:
        progress(0, 2, "simulating")
        rollout = simulate()
        progress(1, 2, "drawing")
        written, unwritten = attempt(lambda: _write(rollout, folder, options))
    if (lasting := len(rollout.motion.time)) < len(rollout.time):
        messages += (f"the state is not finite from {rollout.time[lasting]:g} s on; pictures end before",)
    document = rollout.facts | {"warnings": list(messages), "written": [str(path) for path in written]}
    return print_report(options, document, _lines(rollout, messages, written), unwritten)


def _plan_file(options: argparse.Namespace) -> tuple[Callable[[], Rollout], tuple[str, ...]]:
    """Return a function that runs the requested simulation, and warnings."""
    model = load_model(options.task, **as_arguments(given_options(options, "timestep", "cone", *SCENE_OPTIONS)))
    steps = options.horizon or max(1, round(min(FILE_SECONDS / model.opt.timestep, 1e15)))
    check_count(steps, "steps", MOST_STEPS, "give --horizon, or a longer timestep")
    return partial(_simulate_passive, model, Path(options.task).stem, steps), ()


def _plan_task(options: argparse.Namespace) -> tuple[Callable[[], Rollout], tuple[str, ...]]:
    theta, found = theta_and_policy(options)
    if family := options.contact or found.get("contact"):
        found = _taken(found, family)
    for name in ("contact", "stiffness", "damping", "smoothing", "timestep", *BUILDER_OPTIONS):
        if getattr(options, name) is None:
            setattr(options, name, found.get(name))
    task = task_of(options)
    cone = CONES[int(task.scene.host.opt.cone)]
    if options.cone is None and found.get("cone", cone) != cone:
        options.cone = found["cone"]  # only if it differs: a user's task need not take the option
        task = task_of(options)
    if "network" in found:
        task = with_network(task, tuple(found["network"]), jax.random.key(0))  # theta replaces its weights
    if options.seed and not (options.noisy or task.random_start):
        raise OptionError("seed", "has an effect only with --noisy, as the initial state is fixed")
    contact, messages = single_contact(task, options.contact, options.stiffness, options.damping, options.smoothing)
    return partial(_simulate_task, at_theta(task, theta), contact, options.seed or 0, options.noisy), messages


def _taken(policy: dict[str, Any], family: str) -> dict[str, Any]:
    """Options of a policy's file without those that a contact family, the policy's or another, does not take."""
    spring = takes_stiffness([family])
    takes = {"stiffness": spring, "damping": spring, "smoothing": bool(laws_of([family]))}
    return {name: value for name, value in policy.items() if takes.get(name, True)}


def _simulate_task(task: Task, cell: ContactPoint, seed: int, noisy: bool) -> Rollout:
    theta = task.theta
    program = objective.compiled_rollout(task)
    outputs = program(theta, cell.contact, jax.random.key(seed), jnp.asarray(float(noisy), theta.dtype))
    states, controls, cost, residual = jax.device_get(outputs)
    source = {
        "task": task.name,
        "contact": cell.family,
        "stiffness": cell.stiffness_or_zero,
        "theta": np.asarray(theta, float).tolist(),
        "sigma": task.sigma if noisy else 0.0,
        "seed": seed,
        "cost": float(cost) if np.isfinite(cost) else None,
        "residual": float(residual) if np.isfinite(residual) else None,
    }
    noise = f"noise {task.sigma:g}, seed {seed}" if noisy else "no noise"
    at = f"theta {float(theta[0]):g}, " if theta.size == 1 else ""
    title = f"{task.name}: {cell.label}, {at}{noise}"
    focus = tuple(task.scene.geom(name) for name in task.contact_pair or ())
    qpos, qvel = np.asarray(states.qpos, float), np.asarray(states.qvel, float)
    return Rollout(title, task.scene.host, qpos, qvel, np.asarray(controls), source, focus)


def _simulate_passive(model: mujoco.MjModel, name: str, steps: int) -> Rollout:
    """Simulate with MuJoCo's C engine from the first keyframe or the reference pose, with constant controls."""
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # show bad states rather than reset them
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    qpos, qvel = np.empty((steps + 1, model.nq)), np.empty((steps + 1, model.nv))
    qpos[0], qvel[0] = data.qpos, data.qvel
    for index in range(steps):
        mujoco.mj_step(model, data)
        qpos[index + 1], qvel[index + 1] = data.qpos, data.qvel
    controls = np.tile(data.ctrl, (steps, 1))
    return Rollout(f"{name}: C engine", model, qpos, qvel, controls, {"task": name})


def _write(rollout: Rollout, folder: Path, options: argparse.Namespace) -> list[Path]:
    """Write all files of a rollout; what can fail comes first, so that a failure leaves nothing."""
    motion, view, renderer = rollout.motion, options.view, options.renderer
    try:
        pictures = strip(motion, frames=options.frames, view=view, renderer=renderer)
        ghosts = stroboscope(motion, view=view)
        film = animate(motion, folder / f"rollout.{options.format}", slow=options.slow, view=view, renderer=renderer)
    except RenderError as error:
        raise UsageError(str(error)) from error
    arrays = {"time": rollout.time, "qpos": rollout.qpos, "qvel": rollout.qvel, "controls": rollout.controls}
    numbers = write_whole(folder / "trajectory.npz", lambda file: np.savez_compressed(file, **arrays))  # type: ignore[arg-type]
    return [*save_figure(pictures, folder, "strip"), *save_figure(ghosts, folder, "stroboscope"), film, numbers]


def _lines(rollout: Rollout, messages: tuple[str, ...], written: list[Path]) -> list[str]:
    facts, model = rollout.facts, rollout.model
    lines = [rollout.title]
    if "cost" in facts:
        noise = "with" if facts["sigma"] else "without"
        lines.append(
            f"cost {noise} noise {number(facts['cost'], 6)}, largest solver residual {number(facts['residual'], 2)}"
        )
    lines.append(f"{facts['steps']} steps of {1e3 * model.opt.timestep:g} ms, {facts['duration']:g} s")
    rows = [[name, *(f"{value:.4f}" for value in place)] for name, place in facts["bodies"].items()]
    if rows:
        lines += format_table(rows[:MOST_BODIES_LISTED], ["centres of mass at the end", "x [m]", "y [m]", "z [m]"])
    if len(rows) > MOST_BODIES_LISTED:
        lines.append(f"and {len(rows) - MOST_BODIES_LISTED} more: --json lists them all")
    if 0 < model.njnt <= MOST_BODIES_LISTED:
        ends = zip(coordinates(model), facts["qpos"].values(), strict=False)
        lines += format_table([[name, f"{end:.4f}", unit] for (name, unit), end in ends], ["joints at the end", "", ""])
    lines += [f"warning: {message}" for message in messages]
    return lines + [f"written to {path.parent}: {', '.join(each.name for each in written)}" for path in written[:1]]
