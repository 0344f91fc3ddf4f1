"""Tables of docs/in-the-wild.md: gradients through environments of MuJoCo Playground.

    pip install playground
    python -m experiments.wild HopperHop >> found.jsonl            # one rollout: stock, here, finite differences
    python -m experiments.wild HopperHop none >> found.jsonl       # means without the onset term, or "linear": with it
    python -m experiments.wild table found.jsonl

The function is the distance that a body moves forward under a constant action. Means run until stopped, one line
per batch.
"""

import json
import sys
from collections.abc import Iterable, Iterator
from importlib import import_module
from itertools import count
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Array, Float, Key
from scipy import stats

import mjx_study
from estimators import Differentiation, Evaluation, FirstOrder, circulations
from mjx_study import differentiable_mjx
from mjx_study.table import markdown_table

STEPS: Final = 100  # steps of a single rollout
MEAN_STEPS: Final = 50  # steps of each rollout of a mean
SIGMA: Final = 0.1  # standard deviation of the noise on actions, for means
SIZES: Final = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8)  # steps of finite differences, in the unit of the action
REACH: Final = 0.05  # half the length of the path of integration, in the unit of the action
NODES: Final = 3
BATCH: Final = 100
CONFIDENCE: Final = 0.99
CONVERGED: Final[dict[str, Any]] = {"iterations": 50, "ls_iterations": 20, "tolerance": 1e-12}


def environment(name: str) -> Any:
    """Load an environment with MJX's JAX implementation.

    Go1's meshes are not in the package. They are only drawn, so an icosahedron takes their place.
    """
    overrides = {"impl": "jax"}
    if name != "Go1Joystick":
        return import_module("mujoco_playground._src.dm_control_suite").load(name, config_overrides=overrides)
    go1 = "mujoco_playground._src.locomotion.go1"
    base: Any = import_module(f"{go1}.base")
    own = base.get_assets
    mesh = trimesh.creation.icosahedron().export(file_type="stl")
    parts = ("trunk", "hip", "thigh", "thigh_mirror", "calf")
    base.get_assets = lambda: own() | {f"{part}.stl": mesh for part in parts}
    return import_module(f"{go1}.joystick").Joystick(config_overrides=overrides)


class Distance:
    """Distance forward under a constant action, with random initial states and noise, as an objective.

    Attributes:
        environment: an environment of MuJoCo Playground.
        onset: argument of `differentiable_mjx`.
    """

    def __init__(self, environment: Any, onset: str = "none", chunk: int = BATCH):
        self.environment, self.onset = environment, onset
        self._values, self._gradients = (
            jax.jit(lambda theta, keys, of=of: jax.lax.map(lambda key: of(theta, key), keys, batch_size=chunk))
            for of in (self.sample, jax.value_and_grad(self.sample))
        )

    @property
    def num_params(self) -> int:
        return self.environment.action_size

    def of(self, action: Float[Array, " params"], start: Any, noise: Float[Array, "steps params"]) -> Float[Array, ""]:
        """Return the distance from a state of the environment [m]."""

        def advance(state, noise):
            state = self.environment.step(state, action + noise)
            return jax.tree.map(lambda new, old: new.astype(old.dtype), state, start), None

        last, _ = jax.lax.scan(advance, start, noise)
        return last.data.xpos[1, 0] - start.data.xpos[1, 0]

    def start(self, key: Key[Array, ""]) -> Any:
        """Draw a state of the environment, with the types that a step returns."""
        state = self.environment.reset(jax.random.key_data(key))
        following = jax.eval_shape(self.environment.step, state, jnp.zeros(self.num_params))
        return jax.tree.map(lambda leaf, like: jnp.asarray(leaf, like.dtype), state, following)

    def sample(self, action: Float[Array, " params"], key: Key[Array, ""]) -> Float[Array, ""]:
        start, noise = jax.random.split(key)
        drawn = SIGMA * jax.random.normal(noise, (MEAN_STEPS, self.num_params))
        return self.of(action, jax.lax.stop_gradient(self.start(start)), drawn)

    def evaluate(self, theta: Float[Array, " params"], keys: Key[Array, " samples"]) -> Evaluation:
        """Evaluate through stock MJX; without a score, since no zeroth-order estimate is needed."""
        value = self._values(theta, keys)
        return Evaluation(value, jnp.full((len(keys), self.num_params), jnp.nan), jnp.zeros_like(value))

    def differentiate(self, theta: Float[Array, " params"], keys: Key[Array, " samples"]) -> Differentiation:
        with differentiable_mjx(onset=self.onset):
            return Differentiation(*self._gradients(theta, keys))


def with_options(environment: Any, options: dict[str, Any]) -> None:
    """Set options of the solver in the environment's model."""
    model = environment._mjx_model
    environment._mjx_model = model.replace(opt=model.opt.replace(**options))


def single(environment: Any) -> dict[str, Any]:
    """Differentiate one rollout without noise through stock MJX and this step, against finite differences."""
    budget = environment.mj_model.opt.iterations, environment.mj_model.opt.ls_iterations
    found: dict[str, Any] = {"nv": environment.mj_model.nv, "steps": STEPS * environment.n_substeps, "budget": budget}
    objective = Distance(environment)
    action = 0.1 * jnp.ones(objective.num_params)
    start = jax.jit(objective.start)(jax.random.key(0))
    still = jnp.zeros((STEPS, objective.num_params))
    direction = np.random.default_rng(0).standard_normal(objective.num_params)
    direction /= np.linalg.norm(direction)

    def differences():
        value = jax.jit(objective.of)
        ends = [[value(action + sign * size * direction, start, still) for sign in (1, -1)] for size in SIZES]
        return [float((up - down) / (2 * size)) for (up, down), size in zip(ends, SIZES, strict=True)]

    def slope():
        return float(jax.jit(jax.grad(objective.of))(action, start, still) @ direction)

    found["differences_own"] = differences()
    try:
        found["stock_own"] = slope()
    except ValueError as error:
        found["stock_own"] = str(error).split(".")[0]
    with differentiable_mjx():
        found["ours_own"] = slope()
    with_options(environment, {"iterations": 1})
    found["stock_one"] = slope()
    with_options(environment, CONVERGED)
    found["differences"] = differences()
    with differentiable_mjx():
        found["ours"] = slope()
    return found


def means(environment: Any, onset: str, samples: int) -> Iterator[dict[str, float]]:
    """Integrate first-order gradients along a random direction, against the difference of the distance, by batch."""
    with_options(environment, CONVERGED)
    action = 0.1 * jnp.ones(environment.action_size)
    along = np.random.default_rng(1).standard_normal(environment.action_size)
    along *= REACH / np.linalg.norm(along)
    objective, ends = Distance(environment, onset), (action - along, action + along)
    for seed in count():
        (number,) = circulations([FirstOrder()], objective, *ends, jax.random.key(seed), samples, nodes=NODES)
        yield {"seed": seed, "samples": samples} | {name: float(value) for name, value in vars(number).items()}


def tables(lines: Iterable[dict[str, Any]]) -> str:
    """Format the results of both kinds of runs as two Markdown tables."""
    lines = list(lines)
    singles, batches = ([line for line in lines if bool(line["onset"]) == mean] for mean in (False, True))
    rows = []
    for line in singles:
        stock = line["stock_own"] if isinstance(line["stock_own"], str) else f"{line['stock_own']:.4g}"
        off = ", ".join(f"{abs(found / line['ours'] - 1):.0e}" for found in line["differences"][2:])
        slopes = (line["stock_one"], line["ours_own"], line["differences_own"][-1], line["ours"])
        cells = [f"`{line['name']}`", f"{line['nv']}, {line['steps']}", str(line["budget"]), stock]
        rows.append([*cells, *(f"{slope:.4g}" for slope in slopes), off])
    header = ("environment", "DoF, steps", "budget", "stock", "at one iteration", "here", "differences")
    first = markdown_table(rows, (*header, "converged: here", "off differences of 1e-6, 1e-7, 1e-8 by"))
    rows = []
    for name, onset in dict.fromkeys((line["name"], line["onset"]) for line in batches):
        group = [line for line in batches if (line["name"], line["onset"]) == (name, onset)]
        intervals = []
        for field in ("difference", "gap"):
            values = np.array([line[field] for line in group])
            half = stats.t.ppf((1 + CONFIDENCE) / 2, len(group) - 1) * stats.sem(values)
            intervals.append(f"{np.mean(values):.3g} ± {half:.2g}")
        least = min(line["effective"] for line in group)
        rows.append([f"`{name}`", onset, BATCH * len(group), *intervals, f"{least:.1f}"])
    header = ("environment", "onset", "N", "difference [m]", "gap [m]", "smallest effective N")
    return f"{first}\n\n{markdown_table(rows, header)}"


def main() -> None:
    name, *rest = sys.argv[1:]
    if name == "table":
        found = [line for path in rest for line in Path(path).read_text().splitlines() if line.startswith("{")]
        print(tables(map(json.loads, found)))
        return
    mjx_study.configure(cpu_devices=1)
    onset = rest[0] if rest else ""
    for found in means(environment(name), onset, BATCH) if onset else [single(environment(name))]:
        print(json.dumps({"name": name, "onset": onset} | found), flush=True)


if __name__ == "__main__":
    main()
