"""Table of docs/onset-correction.md on contacts that chatter: bias and deviation with no term, all, chosen, and shifts.

    python -m experiments.chatter    # three minutes on one core

A box slides to rest, two robots land and walk, the latter untrained and after 120 iterations of plain first order.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any, Final
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

from experiments import DOCS
from experiments.engines.scenes import SCENES, mjcf, mjcf_state
from experiments.pages import write_tables
from experiments.quadruped import walk
from experiments.starts import task_of_start
from mjx_study.objective import Simulator
from mjx_study.objective.programs import SamplePrograms
from mjx_study.runtime import configure
from mjx_study.simulation import onset, touch
from mjx_study.simulation.contact import ContactModel, family_model
from mjx_study.simulation.dynamics import State
from mjx_study.table import markdown_table
from mjx_study.tasks import make_task
from mjx_study.tasks.task import Task

SLOTS: Final = 192  # slots for events here, so that all get a term
KINDS: Final = {
    "none": ("none", 0.0),
    "all": ("linear", 0.0),
    "chosen": ("linear", touch.CHATTER),
    "shift": ("shift", 0.0),
}
"""Terms by name: the kind of onset, and the time between events below which contacts chatter."""


def slide(timestep: float) -> Task:
    """Return the box of docs/engines.md that slides to rest: its last position by its speed."""
    numbers = SCENES["slide"]
    qpos, qvel = mjcf_state(numbers, numbers.center)

    def start_at(start: State, parameters: jax.Array) -> State:
        return dataclasses.replace(start, qpos=jnp.array(qpos), qvel=jnp.array(qvel).at[0].set(parameters[0]))

    text, horizon, cost = mjcf(numbers, timestep), numbers.steps(timestep), lambda state: state.qpos[0]
    return task_of_start("slide", text, horizon, start_at, numbers.center, numbers.sigma, cost)


def trained(task: Task, iterations: int, samples: int = 64, rate: float = 0.003) -> Task:
    """Return the task after Adam with plain first order."""
    objective, theta = Simulator(task, samples).objective(None), task.theta
    first = second = jnp.zeros_like(theta)
    for index in range(iterations):
        keys = jax.random.split(jax.random.key(1000 + index), samples)
        gradient = jnp.asarray(np.mean(np.asarray(objective.differentiate(theta, keys).gradient), axis=0))
        first, second = 0.9 * first + 0.1 * gradient, 0.999 * second + 0.001 * gradient**2
        debiased = first / (1 - 0.9 ** (index + 1)), second / (1 - 0.999 ** (index + 1))
        theta = theta - rate * debiased[0] / (jnp.sqrt(debiased[1]) + 1e-8)
    return task.replace(theta=theta)


def gradients(task: Task, contact: ContactModel | None, samples: int, chunk: int) -> Iterator[tuple[str, Any, Any]]:
    """Gradients of samples, and counts of events, with each kind of term."""
    keys = jax.random.key_data(jax.random.split(jax.random.key(0), samples))
    for name, (kind, chatter) in KINDS.items():
        programs = SamplePrograms(task.replace(onset=kind))

        def sample(theta: Any, key: Any, programs: SamplePrograms = programs) -> Any:
            _, gradient, _, counts = programs.by_name["gradient"](theta, contact, jnp.array(task.sigma), key, 1.0)
            return gradient, jnp.zeros(6) if counts is None else counts

        with (
            mock.patch.object(touch, "CHATTER", chatter),
            mock.patch.object(onset, "SLOTS", SLOTS),
        ):
            program = jax.jit(jax.vmap(sample, (None, 0)))
            parts = [jax.device_get(program(task.theta, keys[at : at + chunk])) for at in range(0, samples, chunk)]
        yield name, np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])


def row(
    name: str, task: Task, contact: ContactModel | None, samples: int, chunk: int, pairs: int, reach: float
) -> list[str]:
    """A row of the table."""
    found = {kind: (each, counts) for kind, each, counts in gradients(task, contact, samples, chunk)}
    mean = found["none"][0].mean(axis=0)
    along = mean / np.linalg.norm(mean)
    objective, keys = Simulator(task, chunk).objective(contact), jax.random.split(jax.random.key(1), pairs)
    above, below = (np.asarray(objective.evaluate(task.theta + t * along, keys).value) for t in (reach, -reach))
    cells = [_with_error((above - below) / (2 * reach))]
    cells += [_with_error(each @ along) for each, _ in found.values()]
    cells += [", ".join(f"{np.sqrt(each.var(axis=0).sum()):.2g}" for each, _ in found.values())]
    cells += [f"{found['chosen'][1][:, 2].mean():.1f}"]
    print(name, cells, flush=True)
    return [name, *cells]


def _with_error(samples: np.ndarray) -> str:
    error = np.std(samples, ddof=1) / len(samples) ** 0.5
    digits = max(0, 1 - int(np.floor(np.log10(error))))
    return f"{np.mean(samples):.{digits}f} ± {error:.{digits}f}"


def main() -> None:
    """Write the table."""
    configure(cpu_devices=1)
    landing = make_task("landing")
    contact = family_model("mujoco_default", landing.scene, effective_mass=landing.effective_mass)
    robot = walk(128)
    lines = [row(f"box slides, {1e3 * h:g} ms", slide(h), None, 2000, 100, 8000, 0.02) for h in (0.005, 0.002)]
    lines += [row("`landing`", landing, contact, 2000, 100, 20_000, 0.02)]
    lines += [row("quadruped", robot, None, 320, 16, 1600, 0.02)]
    lines += [row("quadruped, walking", trained(robot, 120), None, 640, 16, 1600, 0.005)]
    names = (
        "",
        "slope",
        "E[FoBG]",
        "all terms",
        "chosen",
        "shift",
        "deviation: none, all, chosen, shift",
        "events left out",
    )
    write_tables(DOCS / "onset-correction.md", {"chatter": markdown_table(lines, names)})


if __name__ == "__main__":
    main()
