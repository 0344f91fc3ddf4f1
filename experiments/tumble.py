"""Table of docs/in-the-wild.md: gradients on bodies that tumble, through whole rollouts.

    pip install playground
    python -m experiments.tumble    # twenty minutes on two cores; to data/tumble.jsonl, and the page
    python -m experiments.tumble page

The function is that of `experiments.wild`: the distance forward under a constant action with noise, from the
environment's own random initial states, with a converged solver. A scene makes the rollouts, whose onset term knows
later steps, and so which contacts chatter.
"""

import copy
import dataclasses
import sys
from typing import Any, Final
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

import mjx_study
from estimators import zeroth_order
from experiments import DATA, DOCS, append_line, read_lines
from experiments.pages import write_tables
from experiments.wild import CONVERGED, MEAN_STEPS, REACH, SIGMA, environment
from mjx_study.objective import Simulator
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.dynamics import State, initial_state
from mjx_study.simulation.scene import put_scene
from mjx_study.table import markdown_table, number, with_error
from mjx_study.tasks.policy import NoisyControls
from mjx_study.tasks.task import Task

CASES: Final = (
    *((name, steps, 1) for name in ("HopperHop", "WalkerRun") for steps in (10, 25, MEAN_STEPS)),
    *(("CheetahRun", MEAN_STEPS, substeps) for substeps in (1, 2, 4)),
)
"""Environments, numbers of their steps, and parts into which each timestep of their simulation is divided."""
SAMPLES: Final = 2000
PAIRS: Final = 8000  # pairs of rollouts behind a slope
STARTS: Final = 4096  # initial states to draw from
RESULTS: Final = DATA / "tumble.jsonl"


@dataclasses.dataclass(frozen=True)
class Constant(NoisyControls):
    """One action for all steps, with noise on each step of the environment.

    Attributes:
        repeats: steps of the simulation per step of the environment.
    """

    repeats: int
    additive: bool = dataclasses.field(default=False, init=False)

    @property
    def num_params(self) -> int:
        return self.controls

    @property
    def noise_shape(self) -> tuple[int, int]:
        return self.horizon // self.repeats, self.controls

    def feedforward(self, theta: Array, noise: Array) -> Float[Array, "horizon nu"]:
        return jnp.repeat(theta + noise, self.repeats, axis=0)

    def feedback(self, theta: Array, state: State) -> None:
        return None

    def score(self, theta: Array, states: State, noise_gradient: Array) -> Float[Array, " nu"]:
        return jnp.sum(noise_gradient, axis=0)


def tumbling(name: str, steps: int, substeps: int = 1) -> Task:
    """The task of an environment of MuJoCo Playground, of so many of its steps, each timestep in substeps."""
    playground = environment(name)
    host = copy.copy(playground.mj_model)
    for option, value in CONVERGED.items():
        setattr(host.opt, option, value)
    host.opt.timestep /= substeps
    scene = put_scene(host, name)
    drawn = jax.random.split(jax.random.key(2), STARTS)
    with mock.patch.object(mjx, "forward", lambda model, data: data):  # only positions are needed
        pool = jax.jit(jax.vmap(lambda key: playground.reset(jax.random.key_data(key)).data.qpos))(drawn)

    def start(key: Key[Array, ""]) -> State:
        return initial_state(scene, pool[jax.random.randint(key, (), 0, STARTS)])

    repeats = substeps * playground.n_substeps
    policy = Constant(steps * repeats, host.nu, repeats)
    return Task(
        name=name,
        scene=scene,
        horizon=policy.horizon,
        policy=policy,
        theta=jnp.full(host.nu, 0.1),
        sigma=SIGMA,
        start=start,
        final_cost=lambda state: state.qpos[0],
        contact_pair=None,
    )


def measured(name: str, steps: int, substeps: int) -> dict[str, Any]:
    """Slope of the mean along the diagonal, and mean and deviation of each gradient."""
    task = tumbling(name, steps, substeps)
    objective = Simulator(task, chunk_size=201).objective(None)
    keys = lambda: jax.random.split(jax.random.key(0), SAMPLES)  # noqa: E731
    pairs = lambda: jax.random.split(jax.random.key(1), PAIRS)  # noqa: E731
    along = np.ones(task.policy.num_params) / task.policy.num_params**0.5
    above, below = (np.asarray(objective.evaluate(task.theta + t * along, pairs()).value) for t in (REACH, -REACH))
    zeroth = zeroth_order(objective.evaluate(task.theta, keys()), "zero_noise").per_sample
    plain = objective.differentiate(task.theta, keys())
    corrected = objective.differentiate_corrected(task.theta, keys())
    found: dict[str, Any] = {
        "name": name,
        "steps": steps,
        "substeps": substeps,
        "slope": _mean((above - below) / (2 * REACH)),
    }
    for kind, samples in (("zobg", zeroth), ("fobg", plain.gradient), ("fobg_onset", corrected.gradient)):
        array = np.asarray(samples)
        found[kind] = {"mean": _mean(array @ along), "deviation": float(np.sqrt(array.var(axis=0).sum()))}
    found_events, _, missed = np.asarray(corrected.events)[:, :3].mean(axis=0)
    return found | {"events": float(found_events), "missed": float(missed)}


def _mean(samples: np.ndarray) -> list[float]:
    """Mean and its standard error."""
    return [float(np.mean(samples)), float(np.std(samples, ddof=1) / len(samples) ** 0.5)]


def table() -> str:
    """The page's table, from the stored results."""
    lines = []
    for each in read_lines(RESULTS):
        kinds = [each[kind] for kind in ("zobg", "fobg", "fobg_onset")]
        means = [with_error(*mean) for mean in (each["slope"], *(kind["mean"] for kind in kinds))]
        deviations = [number(kind["deviation"]) for kind in kinds]
        events = f"{number(each['events'])}, {number(each['missed'])}"
        divided = f", each timestep in {each['substeps']}" if each["substeps"] > 1 else ""
        lines.append([f"`{each['name']}`, {each['steps']}{divided}", *means, ", ".join(deviations), events])
    header = ["environment, steps", "slope", "zeroth order", "plain", "with the term", "deviations", "events, without"]
    return markdown_table(lines, header)


def main() -> None:
    """Measure, and write the page."""
    if sys.argv[1:] != ["page"]:
        mjx_study.configure()
        RESULTS.write_text("")
        for case in CASES:
            append_line(RESULTS, measured(*case))
    write_tables(DOCS / "in-the-wild.md", {"tumble": table()})


if __name__ == "__main__":
    main()
