"""Learning to walk with each gradient: docs/robots.md's comparison, at equal samples and with tuned learning rates.

    python -m experiments.learning tune walk zobg >> learning.jsonl                   # the grid, 3 seeds of each pair
    python -m experiments.learning learn walk zobg learning.jsonl >> learning.jsonl   # its best pair, 12 new seeds
    python -m experiments.learning spread hopper fobg_law                             # its samples at the start
    python -m experiments.learning ppo walk ppo 1e-3 0 >> learning.jsonl              # pip install stable-baselines3
    python -m experiments.learning report learning.jsonl                              # its tables and figure

All descents of a method run in one program, on one device. An iteration takes `SAMPLES` rollouts, differentiated or
not. The adjoint of first-order gradients is cut every few steps, as in analytic policy gradients.
"""

import dataclasses
import json
import math
import sys
import time
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import optax
from jaxtyping import Array, Float
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from scipy import stats

import mjx_study
from estimators import Differentiation, Estimator, Evaluation, GradientEstimate, make_estimator, noise
from estimators.interpolation import apply_choice, constrained_alpha
from estimators.sampling import draw
from experiments import DOCS, read_lines
from experiments.figures.rollouts import INK
from experiments.pages import DPI, write_tables
from mjx_study.objective.cost import before_each_step, last_of, rollout_cost
from mjx_study.plots.style import style_of
from mjx_study.simulation.contact import ContactModel, effective_mass, family_model
from mjx_study.table import markdown_table, number
from mjx_study.tasks.network import with_network
from mjx_study.tasks.task import Task

METHODS: Final[dict[str, Estimator]] = {
    "zobg": make_estimator("zobg_antithetic", baseline="leave_one_out"),
    "fobg": make_estimator("fobg"),
    "fobg_onset": make_estimator("fobg_onset"),
    "ivw": make_estimator("ivw", baseline="leave_one_out"),
    "aobg": make_estimator("aobg", baseline="leave_one_out"),
    "ivw_onset": make_estimator("aobg_onset", baseline="leave_one_out"),
    "fobg_law": make_estimator("fobg"),
}
LAW: Final = "hunt_crossley"
"""Contact law through which `fobg_law` learns, at the static stiffness of MuJoCo's default contact; its policies are
tested in the default contact like all others."""
TASKS: Final = {"walk": "experiments.quadruped:walk", "hopper": "experiments.hopper:hopper"}
NETWORKS: Final = {"walk": (), "hopper": (32, 32)}  # hidden widths of the networks that replace the tasks' policies
SAMPLES: Final = 128  # rollouts per iteration, of both orders together
ITERATIONS: Final = 150
RATES: Final = (2e-3, 5e-3, 1e-2)  # learning rates of Adam
PIECES: Final = {"walk": 8, "hopper": 4}  # pieces of a rollout
WINDOWS: Final[dict[str, tuple[int, ...]]] = {"walk": (2, 4, 8), "hopper": (4,)}  # pieces between cuts of the adjoint
GAMMAS: Final[dict[str, tuple[float, ...]]] = {"walk": (100.0, 200.0, 400.0), "hopper": (40.0, 80.0, 160.0)}
"""AoBG's bounds: about half, once and twice the radius of the zeroth-order mean at the start."""
FOOT: Final = {"walk": "front_left_foot", "hopper": "foot"}
TITLES: Final = {"walk": "quadruped", "hopper": "hopper"}
SEEDS: Final = 3  # descents of each pair of the grid
LEARN_SEEDS: Final = 12  # descents of the best pair, with other seeds
MOST_NORM: Final = 3.0  # norm to which the gradient of a batch is clipped, for all methods


@dataclasses.dataclass(frozen=True, eq=False)
class Pieces:
    """An objective inside a compiled program, whose rollouts are differentiated piece by piece.

    Attributes:
        window: pieces between cuts of the adjoint.
        contact: contact of the rollouts; None for the model's own.
    """

    task: Task
    window: Any
    contact: ContactModel | None = None

    @property
    def num_params(self) -> int:
        return self.task.policy.num_params

    def cost(self, theta, key, sign: float, onset: str, scored: bool):
        """Cost of a rollout; its score or None, and its largest residual."""
        task = self.task
        start_key, noise_key = noise.split_sample_key(key)
        drawn = sign * task.sigma * noise.standard_noise(noise_key, task.policy.noise_shape, theta.dtype)
        pieces = PIECES[task.name]
        steps = task.horizon // pieces
        policy: Any = task.policy
        shorter = dataclasses.replace(policy, horizon=steps)
        piece = dataclasses.replace(task, horizon=steps, policy=shorter, final_cost=_none)
        ends = jnp.arange(1, pieces + 1)
        cut = (ends % self.window == 0) & (ends < pieces)

        def advance(start, inputs):
            drawn, cut = inputs
            cost, (states, _, residual, _) = rollout_cost(piece, theta, self.contact, start, drawn, onset)
            score = None
            if scored:
                score = task.policy.score(
                    theta, before_each_step(states), noise.noise_score(drawn, task.sigma, "gaussian")
                )
            last = jax.tree.map(lambda leaf: jnp.where(cut, jax.lax.stop_gradient(leaf), leaf), last_of(states))
            return last, (cost, score, residual)

        first = task.draw_start(start_key)
        last, (costs, scores, residuals) = jax.lax.scan(advance, first, (drawn.reshape(pieces, steps, -1), cut))
        total = jnp.sum(costs) + task.costs()[1](last)
        return total, (None if scores is None else jnp.sum(scores, axis=0), jnp.max(residuals))

    def _evaluate(self, theta, keys, sign: float) -> Evaluation:
        found: Any = jax.vmap(lambda key: self.cost(theta, key, sign, "none", scored=True))(keys)
        value, (score, residual) = found
        return Evaluation(value, score, jnp.zeros_like(value), residual)

    def evaluate(self, theta, keys) -> Evaluation:
        return self._evaluate(theta, keys, 1.0)

    def evaluate_pair(self, theta, keys) -> tuple[Evaluation, Evaluation]:
        return self._evaluate(theta, keys, 1.0), self._evaluate(theta, keys, -1.0)

    def differentiate(self, theta, keys, onset: str = "none") -> Differentiation:
        function = jax.value_and_grad(partial(self.cost, sign=1.0, onset=onset, scored=False), has_aux=True)
        (value, (_, residual)), gradient = jax.vmap(function, (None, 0))(theta, keys)
        return Differentiation(value, gradient, residual)

    def differentiate_corrected(self, theta, keys) -> Differentiation:
        return self.differentiate(theta, keys, "linear")


def _none(state) -> Float[Array, ""]:
    return jnp.zeros(())


def make(name: str) -> Task:
    """The task with its network, by its name in `TASKS`."""
    task = mjx_study.make_task(TASKS[name])
    return with_network(task, NETWORKS[name], jax.random.key(0)) if NETWORKS[name] else task


OPTIMIZER: Final = optax.chain(optax.clip_by_global_norm(MOST_NORM), optax.scale_by_adam())


def law_contact(task: Task) -> ContactModel:
    """The contact of `LAW` as stiff as MuJoCo's default, solref = (0.02, 1) and dmax = 0.95, is under a foot."""
    mass = effective_mass(task.scene, "floor", FOOT[task.name])
    return family_model(LAW, task.scene, stiffness=mass / (0.95 * 0.02) ** 2, effective_mass=mass)


def _contact(task: Task, method: str) -> ContactModel | None:
    return law_contact(task) if method == "fobg_law" else None


def iteration(task: Task, method: str):
    """One iteration of all descents, as a function of (theta, optimiser's state, learning rate, second setting, key).

    The second setting is AoBG's bound or, for other methods, the window.
    """
    estimator, contact = METHODS[method], _contact(task, method)
    rollouts = 1 if len(estimator.needs) == 1 and estimator.needs[0] != "pair" else 2

    def one(theta, state, rate, second, key):
        window = PIECES[task.name] if method == "aobg" else second
        batches = draw(estimator.needs, Pieces(task, window, contact), theta, key, SAMPLES // rollouts)
        estimate = bounded(batches, second) if method == "aobg" else estimator(batches)
        usable = jnp.all(jnp.isfinite(estimate.mean))
        updates, following = OPTIMIZER.update(jnp.where(usable, estimate.mean, 0.0), state, theta)
        first = jax.tree.leaves(batches[estimator.needs[0]])[0]
        alpha = jnp.nan if estimate.alpha is None else estimate.alpha.alpha
        return theta - rate * updates, following, (jnp.nanmean(first), alpha, usable, estimate.num_nonfinite)

    return jax.jit(jax.vmap(one))


def bounded(batches: Any, gamma: Any) -> GradientEstimate:
    """AoBG with a bound that is a value of the program, so that one program serves the grid."""
    estimator: Any = METHODS["aobg"]
    parts = estimator.parts(*estimator.pick(batches))
    choice = estimator.choose(*parts)
    variances = choice.variance_zeroth, choice.variance_first
    alpha = constrained_alpha(*variances, choice.discrepancy, choice.epsilon, gamma)
    return apply_choice(dataclasses.replace(choice, alpha=alpha), *parts)


def descend(task: Task, method: str, settings: list[tuple[float, float, int]], iterations: int = ITERATIONS):
    """Run descents with (learning rate, second setting, seed) each, together; return thetas, and curves."""
    count = len(settings)
    rates, settled, seeds = (jnp.array(column) for column in zip(*settings, strict=True))
    keys = jax.vmap(lambda seed: jax.random.fold_in(jax.random.key(7), seed))(seeds)
    theta = jnp.broadcast_to(task.theta, (count, task.theta.size))
    state = jax.vmap(OPTIMIZER.init)(theta)
    step = iteration(task, method)
    fold = jax.jit(jax.vmap(jax.random.fold_in, (0, None)))
    began = time.perf_counter()
    jax.block_until_ready(step(theta, state, rates, settled, fold(keys, 0)))
    built, records, seconds = time.perf_counter() - began, [], []
    began = time.perf_counter()
    for index in range(iterations):
        theta, state, record = step(theta, state, rates, settled, fold(keys, index))
        records.append(jax.device_get(record))
        seconds.append(time.perf_counter() - began)
    costs, alphas, usable, nonfinite = (np.array(column).T for column in zip(*records, strict=True))
    found = {"cost": costs, "alpha": alphas, "usable": usable.mean(), "nonfinite": nonfinite.mean()}
    return np.asarray(theta), {**found, "seconds": seconds, "built": built}


def final_costs(task: Task, thetas: Float[np.ndarray, "policies params"]) -> Float[np.ndarray, " policies"]:
    """Mean costs of policies with noise, over the same 1,000 samples for all."""
    keys = jax.random.split(jax.random.key(2**31 - 1), 1000)
    one = lambda theta, key: Pieces(task, 1).cost(theta, key, 1.0, "none", scored=False)[0]  # noqa: E731
    all_samples = jax.jit(jax.vmap(one, (None, 0)))
    return np.array([np.nanmean(all_samples(theta, keys)) for theta in thetas])


def execute(task: Task, thetas: Float[np.ndarray, "policies params"], seconds: float = 4.0, starts: int = 8):
    """Run policies without noise in MuJoCo's C engine, from the same starts for all.

    Returns:
        Cost per second and distance forward [m], each (policies, starts).
    """
    host, steps = task.scene.host, round(seconds / task.scene.timestep)
    first = jax.vmap(task.draw_start)(jax.random.split(jax.random.key(11), starts))
    datas = [[mujoco.MjData(host) for _ in range(starts)] for _ in thetas]
    for row in datas:
        for data, qpos, qvel in zip(row, np.asarray(first.qpos), np.asarray(first.qvel), strict=True):
            data.qpos[:], data.qvel[:] = qpos, qvel
    running_cost, _ = task.costs()

    def act(theta, qpos, qvel):
        state = mjx_study.State(qpos, qvel, jnp.zeros(0), jnp.zeros(host.nv))
        control: Any = task.policy.feedback(theta, state)
        return control, running_cost(state, control)

    act_all = jax.jit(jax.vmap(jax.vmap(act, (None, 0, 0))))
    total = np.zeros((len(thetas), starts))
    for _ in range(steps):
        qpos, qvel = (np.array([[getattr(data, name) for data in row] for row in datas]) for name in ("qpos", "qvel"))
        controls, costs = jax.device_get(act_all(thetas, qpos, qvel))
        total += costs
        for row, commands in zip(datas, controls, strict=True):
            for data, command in zip(row, commands, strict=True):
                data.ctrl[:] = command
                mujoco.mj_step(host, data)
    distance = np.array([[data.qpos[0] for data in row] for row in datas]) - np.asarray(first.qpos)[:, 0]
    return total / seconds, distance


def executed(task: Task, thetas: Float[np.ndarray, "policies params"]) -> dict[str, Any]:
    """What policies do in the C engine, for the time that they were trained for and for four seconds."""
    found = {}
    for name, seconds in (("trained", task.horizon * task.scene.timestep), ("longer", 4.0)):
        cost, distance = execute(task, thetas, seconds)
        found |= {f"cost_{name}": cost.mean(axis=1), f"distance_{name}": distance.mean(axis=1)}
    return found


def grid(name: str, method: str) -> list[tuple[float, float]]:
    """Learning rates and windows, or bounds of AoBG, to choose from, nine pairs for every method."""
    if method == "aobg":
        return list(product(RATES if name == "walk" else (1.5e-3, 2.6e-3, 4.5e-3), GAMMAS[name]))
    if method == "zobg" or len(WINDOWS[name]) == 1:
        return [(float(rate), PIECES[name]) for rate in np.geomspace(RATES[0] / 4, 4 * RATES[-1], 9)]
    return list(product(RATES, WINDOWS[name]))


def tune(name: str, method: str, iterations: int = ITERATIONS) -> dict[str, Any]:
    """Each pair of the grid, and the final costs of its seeds."""
    task, pairs = make(name), grid(name, method)
    settings = [(*pair, seed) for pair in pairs for seed in range(SEEDS)]
    thetas, found = descend(task, method, settings, iterations)
    final = final_costs(task, thetas).reshape(len(pairs), SEEDS)
    kept = {name: found[name] for name in ("seconds", "built", "usable")}
    return {"pairs": pairs, "final": final, **kept}


def learn(name: str, method: str, rate: float, window: float) -> dict[str, Any]:
    """Descents of new seeds with a learning rate and a window, or AoBG's bound."""
    task = make(name)
    settings = [(rate, window, 100 + seed) for seed in range(LEARN_SEEDS)]
    thetas, found = descend(task, method, settings)
    kept = {name: each for name, each in found.items() if name != "alpha"} | {"alpha": np.nanmean(found["alpha"])}
    return {"rate": rate, "window": window, "final": final_costs(task, thetas), **kept, **executed(task, thetas)}


def spread(name: str, method: str) -> dict[str, Any]:
    """First-order samples at the start: quantiles of their norms, and the cosines of the means of batches with the mean
    of all but the largest hundredth."""
    task, batches = make(name), 16
    objective = Pieces(task, PIECES[task.name], _contact(task, method))
    program = jax.jit(lambda keys: objective.differentiate(task.theta, keys).gradient)
    keys = jax.random.split(jax.random.key(0), (batches, SAMPLES))
    samples = np.stack([program(each) for each in keys])
    norms = np.linalg.norm(samples, axis=-1)
    usual = samples[norms < np.quantile(norms, 0.99)].mean(axis=0)
    means = samples.mean(axis=1)
    cosines = means @ usual / (np.linalg.norm(means, axis=1) * np.linalg.norm(usual))
    return {"quantiles": np.quantile(norms, (0.5, 0.99, 1)), "cosines": cosines}


def proximal(name: str, rate: float, seed: int) -> dict[str, Any]:
    """Proximal policy optimisation with as many steps."""
    from experiments.ppo import train

    task = make(name)
    theta, costs, seconds, built = train(task, rate, seed, ITERATIONS * SAMPLES * task.horizon)
    found = {"rate": rate, "seed": seed, "cost": costs, "seconds": seconds, "built": built}
    return {**found, "final": final_costs(task, theta[None]), **executed(task, theta[None])}


def best(lines: list[dict[str, Any]], name: str, method: str) -> tuple[float, int]:
    """The pair with the lowest mean final cost; of a method with an onset term not tuned itself, that without it."""
    tuned = {line["method"]: line for line in lines if (line["what"], line["task"]) == ("tune", name)}
    found = tuned.get(method) or tuned[method.removesuffix("_onset")]
    return found["pairs"][int(np.argmin(np.mean(found["final"], axis=1)))]


HEADINGS: Final = ("method", "rate, window", "cost", "in C: cost", "4 s in C: cost", "distance [m]")
TICKS: Final = (0.15, 0.2, 0.3, 0.5, 1.0, 2.0)  # of the quadruped's cost, which is positive
HIGHEST: Final = 0.2  # of the hopper's cost in the figure


def figure(lines: list[dict[str, Any]]) -> Figure:
    """Mean cost with noise of both tasks against rollouts and seconds, with the range of the seeds' middle half."""
    drawn = Figure(figsize=(9.0, 6.4), dpi=DPI, layout="constrained")
    for (left, right), name in zip(drawn.subplots(2, 2, sharey="row"), ("hopper", "walk"), strict=True):
        for method in [*METHODS, "ppo"]:
            seeds = _new_seeds(lines, name, method)
            if not seeds:
                continue
            cost = np.concatenate([np.atleast_2d(each["cost"]) for each in seeds])
            label, colour, _ = style_of({"zobg": "zobg_antithetic", "ivw_onset": "aobg_onset"}.get(method, method))
            label, colour = {
                "ppo": ("PPO", INK),
                "ivw_onset": ("IVW (onset)", colour),
                "fobg_law": ("FoBG, Hunt-Crossley", "gold"),
            }.get(method, (label, colour))
            rollouts = np.arange(1, cost.shape[1] + 1) * SAMPLES * ITERATIONS / cost.shape[1]
            times = np.mean([each["seconds"] for each in seeds], axis=0)
            for axes, along in ((left, rollouts), (right, times)):
                axes.plot(along, np.median(cost, axis=0), color=colour, label=label)
                axes.fill_between(along, *np.quantile(cost, (0.25, 0.75), axis=0), color=colour, alpha=0.2, linewidth=0)
        left.set(xlabel="rollouts", ylabel=f"{TITLES[name]}: cost of a batch", xticks=range(0, 20_001, 5_000))
        if name == "walk":
            left.set_yscale("log")
            left.set_yticks(TICKS, [f"{tick:g}" for tick in TICKS], minor=False)
            left.yaxis.set_minor_locator(NullLocator())
        else:
            left.set_ylim(top=HIGHEST)
        right.set(xlabel="seconds, with the other seeds beside on one GPU", xscale="log")
        for axes in (left, right):
            axes.grid(alpha=0.25, which="major")
            axes.spines[["top", "right"]].set_visible(False)
        left.legend(frameon=False, fontsize=8.5)
    return drawn


def _new_seeds(lines: list[dict[str, Any]], name: str, method: str) -> list[dict[str, Any]]:
    """The lines of seeds that no learning rate was chosen by."""
    found = [each for each in lines if (each["task"], each["method"]) == (name, method)]
    found = [each for each in found if each["what"] in ("learn", "ppo")]
    return [each for each in found if each.get("seed", 100) >= 100]


def table(lines: list[dict[str, Any]], name: str) -> str:
    """Final costs of the new seeds, with 95 % intervals by Student's t, and what their policies do in the C engine."""
    columns = ("final", "cost_trained", "cost_longer", "distance_longer")
    rows = []
    for method in [*METHODS, "ppo"]:
        if seeds := _new_seeds(lines, name, method):
            numbers = [np.concatenate([np.ravel(each[column]) for each in seeds]) for column in columns]
            window = seeds[0].get("window")
            second = _second(name, method).format(window) if window and method != "zobg" else ""
            chosen = f"{seeds[0]['rate']:.2g}{second}"
            rows.append((f"`{method}`" if method != "ppo" else "PPO", chosen, *map(_with_interval, numbers)))
    return markdown_table(rows, HEADINGS)


def grid_table(lines: list[dict[str, Any]], name: str) -> str:
    """Mean final cost of each setting's seeds, and the setting: Adam's learning rate, and the adjoint's window."""
    rows = []
    for line in lines:
        if (line["what"], line["task"]) == ("tune", name):
            windows = {window for _, window in line["pairs"]}
            second = _second(name, line["method"]) if len(windows) > 1 else ""
            cells = [
                f"{number(float(np.mean(final)))} ({rate:.2g}{second.format(window)})"
                for (rate, window), final in zip(line["pairs"], line["final"], strict=True)
            ]
            rows.append((f"`{line['method']}`", *cells))
    return markdown_table(sorted(rows), ["method", *map(str, range(1, 10))])


def _second(name: str, method: str) -> str:
    """Format of a window as a share of the rollout, or of AoBG's bound."""
    return ", gamma {:g}" if method == "aobg" else f", {{:g}}/{PIECES[name]}"


def _with_interval(values: Float[np.ndarray, " seeds"]) -> str:
    half = stats.t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / math.sqrt(len(values))
    return f"{np.mean(values):.3f} ± {half:.3f}"


def report(path: str) -> None:
    """Write the tables of docs/robots.md and its figure."""
    lines = read_lines(Path(path))
    tables = {name: table(lines, name) for name in TASKS}
    write_tables(DOCS / "robots.md", tables | {f"{name}, grid": grid_table(lines, name) for name in TASKS})
    figure(lines).savefig(DOCS / "learning.png")


def main(what: str, name: str, method: str, *arguments: str) -> None:
    """Compute one line of the results, and print it."""
    mjx_study.configure()
    if what == "learn":
        found = learn(name, method, *best(read_lines(Path(arguments[0])), name, method))
    else:
        found = {"tune": tune, "spread": spread, "ppo": lambda name, method, *rest: proximal(name, *rest)}[what](
            name, method, *map(json.loads, arguments)
        )
    line = {"what": what, "task": name, "method": method, **found}
    print(json.dumps(line, default=lambda array: np.asarray(array).round(5).tolist()))


if __name__ == "__main__":
    report(sys.argv[2]) if sys.argv[1] == "report" else main(*sys.argv[1:])
