"""Computes the atlas: where first-order gradients are worth having, over more than 10,000 cells, for docs/atlas.md.

    python -m experiments.atlas run --output DIR [--workers N] [--seconds S]    # cells missing in DIR/atlas.npz
    python -m experiments.atlas page [DIR/atlas.npz]    # data/atlas.npz, the figures and the tables of docs/atlas.md

A cell is one task at one timestep under one contact model, with one sigma and one theta, on random numbers of its own.
All that differs between the cells of a task and timestep is traced, so that they share two compiled programs; several
cells run in one call. The contact models, sigmas and thetas of each family are a scrambled Sobol sequence, so any
prefix covers them evenly: a run that ends early is a coarser atlas, not a partial one.
"""

import argparse
import concurrent.futures
import dataclasses
import json
import math
import multiprocessing
import os
import time
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy.stats import qmc

from estimators import Evaluation, antithetic, effective_samples, squared_bias_of_means, variance_interval, zeroth_order
from estimators.noise import batch_noise, noise_score
from estimators.statistics import summarise
from experiments.pages import DATA
from mjx_study.compiled import Compiled
from mjx_study.diagnose.setting import touch_of
from mjx_study.disk import write_whole
from mjx_study.experiment.reference_gradient import estimate_reference
from mjx_study.experiment.resolution import direction_of
from mjx_study.experiment.sampling import unconverged
from mjx_study.experiment.tally import onset_numbers
from mjx_study.objective import SamplePrograms, rollout_cost, spread
from mjx_study.results.variables import ONSETS
from mjx_study.runtime import configure, environment, local_devices
from mjx_study.simulation.contact import ContactModel, stable
from mjx_study.simulation.dynamics import State, initial_state
from mjx_study.simulation.engine import engine_model
from mjx_study.simulation.onset import as_row
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import family_grid
from mjx_study.tasks.task import Task

RESULTS: Final = DATA / "atlas.npz"
FAMILIES: Final = ("penalty", "impedance", "mujoco", "mujoco_stiff", "smooth_onset")
UNDAMPED: Final = ("penalty", "impedance")
"""Families that keep the task's own damping; the others' damping ratio varies."""
POINTS: Final = 128
"""Cells of each family at each task and timestep."""
SAMPLES: Final = 64
"""First-order samples of a cell, and pairs of rollouts for zeroth order and the reference."""
BATCHES: Final = 8
"""Into which first-order samples are split for the squared bias."""
DAMPRATIO: Final = (0.1, 2.0)
WIDTH: Final = (3e-4, 3e-2)
"""Depths over which the impedance of `smooth_onset` rises [m]."""
NOISE: Final = (0.1, 3.0)
"""Factors on the task's sigma."""
CHUNK: Final = 256
BLOCK: Final = 16
"""Cells computed together."""
SEED: Final = 0
DIGITS: Final = 10
"""Bits of the mantissa that are kept: a relative error of 5e-4, and a third of the size."""
FEWEST: Final = 60.0
"""Least time that is worth a job's compilation [s]."""
LARGEST: Final = 200.0
"""Of a job, compilation apart [s]; larger ones are split."""
ESTIMATORS: Final = ("zobg", "fobg", "fobg_onset")


@dataclasses.dataclass(frozen=True)
class Setting:
    """What is varied on a task.

    Attributes:
        timesteps: [s].
        stiffness: least and largest stiffness [N/m].
        theta: least and largest t, of theta = t direction.
        cost: computing time of a cell's step, all samples together [s], roughly; it orders and splits jobs.
    """

    timesteps: tuple[float, ...]
    stiffness: tuple[float, float]
    theta: tuple[float, float]
    cost: float


TASKS: Final = {
    "momentum_transfer": Setting((0.001, 0.002, 0.004), (500.0, 3e5), (0.05, 0.8), 1e-3),
    "ball_wall": Setting((0.001, 0.002, 0.004), (500.0, 3e5), (0.1, 1.3), 1e-3),
    "pusher": Setting((0.0025, 0.005, 0.01), (10.0, 1e4), (0.02, 0.4), 6e-4),
    "pusher_apart": Setting((0.0025, 0.005, 0.01), (10.0, 1e4), (0.1, 0.6), 6e-4),
    "sliding_box": Setting((0.005, 0.01), (20.0, 5e3), (0.0, 0.4), 1.5e-3),
    "tennis": Setting((0.005, 0.01), (200.0, 5e4), (0.0, 0.3), 3e-3),
}
"""`pusher_apart` is the pusher whose bodies start 10 cm apart, so that they meet."""
GAP: Final = 0.1
"""Of `pusher_apart` [m]."""
PROGRAMS: Final = tuple((name, timestep) for name, setting in TASKS.items() for timestep in setting.timesteps)
CELLS: Final = len(PROGRAMS) * POINTS * len(FAMILIES)
COLUMNS: Final = ("program", "family", "stiffness", "dampratio", "width", "sigma", "theta")


@dataclasses.dataclass(frozen=True)
class Cell:
    """One cell; `index` is unique and gives its random numbers.

    Attributes:
        program: index into `PROGRAMS`.
        family: index into `FAMILIES`.
        stiffness: [N/m].
        dampratio: of the contact; NaN for the task's own damping.
        width: of the impedance's rise [m].
        sigma: standard deviation of the noise.
        theta: t, of theta = t direction.
    """

    index: int
    program: int
    family: int
    stiffness: float
    dampratio: float
    width: float
    sigma: float
    theta: float


def cells_of(program: int) -> Iterator[Cell]:
    """The cells of a task and timestep, family by family in turn."""
    name, timestep = PROGRAMS[program]
    setting, sigma, own = TASKS[name], task_of(name, timestep).sigma, 0.001
    ranges = [setting.stiffness, DAMPRATIO, WIDTH, [factor * sigma for factor in NOISE]]
    low, high = np.log(ranges).T
    drawn = [
        qmc.Sobol(5, rng=program * len(FAMILIES) + family).random_base2(round(math.log2(POINTS)))
        for family in range(len(FAMILIES))
    ]
    for point in range(POINTS):
        for family, label in enumerate(FAMILIES):
            *unit, along = drawn[family][point]
            stiffness, dampratio, width, noise = np.exp(low + (high - low) * unit)
            yield Cell(
                (program * POINTS + point) * len(FAMILIES) + family,
                program,
                family,
                stiffness,
                math.nan if label in UNDAMPED else dampratio,
                width if label == "smooth_onset" else own,
                noise,
                setting.theta[0] + (setting.theta[1] - setting.theta[0]) * along,
            )


def task_of(name: str, timestep: float) -> Task:
    """A task at a timestep, as long as at its own."""
    base = make_task(name.removesuffix("_apart"))
    steps = round(base.horizon * base.scene.timestep / timestep)
    task = make_task(name.removesuffix("_apart"), timestep=timestep, horizon=steps)
    if name.endswith("_apart"):
        qpos = task.start.qpos.at[0].add(-GAP)
        task = task.replace(name=name, start=initial_state(task.scene, qpos))
    return task


def contact_of(task: Task, cell: Cell) -> ContactModel:
    """The contact model of a cell."""
    damping = None
    if not math.isnan(cell.dampratio):
        damping = 2 * cell.dampratio * math.sqrt(cell.stiffness * task.effective_mass)
    (point,), _ = family_grid(task, [FAMILIES[cell.family]], [cell.stiffness], damping)
    assert point.contact is not None
    return dataclasses.replace(point.contact, solimp=point.contact.solimp.at[2].set(cell.width))


class Programs:
    """The two compiled programs of a task: rollouts, and gradients with and without the onset term."""

    def __init__(self, task: Task):
        self.task, self.direction = task, direction_along(task)
        programs = SamplePrograms(task)
        value = programs.by_name["value"]

        def gradients(theta, contact, sigma, key, scale):
            start, noise = programs.draw(sigma, key, scale)

            def cost(theta, weight):
                value, (_, _, residual, counts) = rollout_cost(task, theta, contact, start, noise, "linear", weight)
                return value, (residual, as_row(counts))

            slopes = jax.vmap(jax.value_and_grad(cost, has_aux=True), (None, 0))
            (values, (residuals, counts)), both = slopes(theta, jnp.array([0.0, 1.0], theta.dtype))
            return values[0], both, residuals[0], counts[0]

        def of_rows(program):
            def run(along, solref, solimp, sigma, key, scale):
                return program(along * self.direction, ContactModel(solref, solimp), sigma, key, scale)

            return Compiled(jax.vmap(run))

        self._warm: set[str] = set()
        self._programs = {"value": of_rows(value), "gradients": of_rows(gradients)}

    def run(self, name: str, settings: Sequence[np.ndarray], keys: np.ndarray, scale: np.ndarray) -> tuple[Any, float]:
        """Outputs `(cells, rows, ...)`, and seconds per row; NaN for a call that compiles.

        Args:
            settings: t, solref, solimp and sigma of every cell.
            keys: key data (cells, rows, 2).
            scale: factor on the noise of each row.
        """
        cells, rows = keys.shape[:2]
        flat = [np.repeat(each, rows, axis=0) for each in settings]
        flat += [keys.reshape(cells * rows, -1), np.tile(scale, cells)]
        begun = time.perf_counter()
        found = spread(self._programs[name], (), flat, CHUNK, local_devices())
        seconds = (time.perf_counter() - begun) / (cells * rows) if name in self._warm else math.nan
        self._warm.add(name)
        return jax.tree.map(lambda leaf: leaf.reshape(cells, rows, *leaf.shape[1:]), found), seconds

    @cached_property
    def control(self) -> Any:
        """Control without noise at a step, from t and the state."""
        policy = self.task.policy
        noise = jnp.zeros(policy.noise_shape)

        def law(along, step, state):
            theta = along * self.direction
            feedback = policy.feedback(theta, state)
            return policy.feedforward(theta, noise)[step] + (0.0 if feedback is None else feedback)

        return jax.jit(law)


def direction_along(task: Task) -> jax.Array:
    """The direction of theta: the same force at every step, or random feedback gains."""
    if task.policy.additive:
        return jnp.ones(task.policy.num_params)
    return jnp.asarray(direction_of("random", task.policy.num_params, SEED))


def first_touch(programs: Programs, cell: Cell, contact: ContactModel, key: jax.Array) -> dict[str, float]:
    """Whether bodies touch at the start, and the first contact that begins in the rollout without noise."""
    task = programs.task
    policy, host = task.policy, engine_model(task.scene, contact)
    theta, still = cell.theta * programs.direction, jnp.zeros(policy.noise_shape)
    data, start = mujoco.MjData(host), policy.place(theta, still, task.draw_start(key))
    data.qpos[:], data.qvel[:] = start.qpos, start.qvel
    forces = np.asarray(policy.feedforward(theta, still))
    at_start, before, speed = False, None, math.nan
    for step in range(task.horizon):
        mujoco.mj_step1(host, data)
        now = {tuple(each.geom): each for each in data.contact if each.dist < each.includemargin}
        if before is None:
            at_start, before = bool(now), now.keys()
        if begun := now.keys() - before:
            speed = touch_of(host, data, now[begun.pop()], data.time, task.scene.timestep).speed
            break
        if not policy.additive:
            state = State(jnp.asarray(data.qpos), jnp.asarray(data.qvel), jnp.asarray(data.act), start.warmstart)
            data.ctrl[:] = programs.control(cell.theta, step, state)
        else:
            data.ctrl[:] = forces[step]
        before = now.keys()
        mujoco.mj_step2(host, data)
    return {"at_start": at_start, "speed": speed}


@jax.jit
def _statistics(plus: Evaluation, minus: Evaluation, pilot: Evaluation | None, gradients, sigma):
    """Numbers of one cell.

    The slope along a direction d is compared, since that is where a descent step goes. With one parameter d is 1.
    Otherwise it is the direction of the median first-order gradient of one half of the samples, along which the other
    half and the reference are projected; both halves take their turn.

    Args:
        plus, minus: evaluations with opposite noise.
        pilot: evaluation of the first-order samples; None for a feedback policy, whose reference is of pairs.
        gradients: (samples, 2, params), without and with the onset term.
    """
    zeroth = zeroth_order(plus, "zero_noise")
    plain, corrected = (summarise(gradients[:, which]) for which in range(2))
    kept = jnp.where(jnp.isfinite(plain.per_sample).all(axis=1)[:, None], plain.per_sample, jnp.nan)
    if pilot is None:
        reference = antithetic(plus, minus, "zero_noise")
    else:
        odd = dataclasses.replace(plus, value=(plus.value - minus.value) / 2, baseline=jnp.zeros_like(plus.value))
        reference = estimate_reference(odd, pilot, [jnp.nanmedian(kept, axis=0)], sigma)
    half = len(kept) // 2
    parts = slice(half), slice(half, None)
    medians = [jnp.nanmedian(kept[part], axis=0) for part in parts]
    if kept.shape[1] == 1:
        medians = [jnp.ones(1)] * 2
    across = [median / jnp.linalg.norm(median) for median in medians]
    mean = (across[0] + across[1]) / 2
    along = reference.per_sample @ mean
    found = {"slope": jnp.mean(along), "slope_se": jnp.std(along, ddof=1) / jnp.sqrt(len(along))}
    found |= {"norm": jnp.linalg.norm(reference.mean)}
    found |= {"norm_se": jnp.linalg.norm(reference.standard_error)}
    for name, estimate in zip(ESTIMATORS, (zeroth, plain, corrected), strict=True):
        lower, upper = variance_interval(estimate, 0.95)
        found |= {f"{name}_variance": estimate.variance, f"{name}_lower": lower, f"{name}_upper": upper}
        found |= {f"{name}_effective": effective_samples(estimate).count}
        found |= {f"{name}_lost": len(estimate.per_sample) - estimate.num_finite}
        if name == "zobg":
            continue
        others = [
            summarise((estimate.per_sample[part] @ each)[:, None])
            for part, each in zip(parts, across[::-1], strict=True)
        ]
        found |= {f"{name}_bias": (others[0].mean[0] + others[1].mean[0]) / 2 - found["slope"]}
        found |= {f"{name}_bias_se": jnp.sqrt(sum(each.standard_error[0] ** 2 for each in others) / 4)}
        means = jnp.mean(estimate.per_sample.reshape(BATCHES, -1, kept.shape[1]), axis=1)
        found |= dict(
            zip((f"{name}_square", f"{name}_square_se"), squared_bias_of_means(means, reference), strict=True)
        )
    return found


def measure(programs: Programs, cells: Sequence[Cell]) -> dict[str, np.ndarray]:
    """All columns of some cells of one task and timestep."""
    task, additive = programs.task, programs.task.policy.additive
    contacts = [contact_of(task, cell) for cell in cells]
    stacked = [np.stack([np.asarray(getattr(each, name)) for each in contacts]) for name in ("solref", "solimp")]
    sigmas = np.array([cell.sigma for cell in cells])
    settings = [np.array([cell.theta for cell in cells]), *stacked, sigmas]
    root = jax.random.key(SEED)
    pairs, firsts = zip(*(jax.random.split(jax.random.fold_in(root, cell.index)) for cell in cells), strict=True)
    pairs, firsts = (
        np.stack([jax.random.key_data(jax.random.split(key, SAMPLES)) for key in each]) for each in (pairs, firsts)
    )
    still = pairs if task.random_start else pairs[:, :1]
    scale = np.repeat([1.0, -1.0, 0.0], [SAMPLES, SAMPLES, still.shape[1]])
    (values, scores, residuals), value_seconds = programs.run(
        "value", settings, np.concatenate([pairs, pairs, still], axis=1), scale
    )
    (gained, gradients, more, events), seconds = programs.run("gradients", settings, firsts, np.ones(SAMPLES))
    ends = jnp.split(values, [SAMPLES, 2 * SAMPLES], axis=1)
    baseline = jnp.broadcast_to(ends[2], ends[0].shape)
    plus = Evaluation(ends[0], jnp.asarray(scores[:, :SAMPLES]), baseline)
    minus = Evaluation(ends[1], jnp.asarray(scores[:, SAMPLES : 2 * SAMPLES]), baseline)
    pilot = None
    if additive:
        flat = jax.random.wrap_key_data(jnp.asarray(firsts.reshape(-1, firsts.shape[-1])))
        _, noise = batch_noise(flat, task.policy.noise_shape, task.noise)
        scores = noise_score(noise.reshape(len(cells), SAMPLES, -1), 1.0, task.noise) / sigmas[:, None, None]
        pilot = Evaluation(jnp.asarray(gained), scores, baseline)
    found = jax.device_get(jax.vmap(_statistics)(plus, minus, pilot, gradients, jnp.asarray(sigmas)))
    columns = {name: np.asarray(each, float) for name, each in found.items()}
    onsets = np.stack([onset_numbers(each) for each in events])
    keys = jax.random.wrap_key_data(jnp.asarray(pairs[:, 0]))
    touched = [first_touch(programs, *each) for each in zip(cells, contacts, keys, strict=True)]
    touched = {name: [each[name] for each in touched] for name in touched[0]}
    solved = [unconverged(np.concatenate(each, axis=None), "float64") for each in zip(residuals, more, strict=True)]
    columns |= dict(zip(ONSETS, onsets.T, strict=True)) | touched | {"unconverged": solved}
    columns |= {"k": -stacked[0][:, 0], "b": -stacked[0][:, 1], "impedance": stacked[1][:, 0]}
    columns |= {"stable": [stable(each.tolist(), task.scene.timestep) for each in stacked[0]]}
    columns |= {name: [getattr(cell, name) for cell in cells] for name in ("index", *COLUMNS)}
    columns |= {"value_seconds": [value_seconds] * len(cells), "gradient_seconds": [seconds] * len(cells)}
    return {name: np.asarray(each, float) for name, each in columns.items()}


@dataclasses.dataclass(frozen=True)
class Job:
    """Every `parts`-th cell of a task and timestep."""

    program: int
    part: int
    parts: int

    @property
    def name(self) -> str:
        return f"{self.program:02d}-{self.part}-of-{self.parts}"

    @property
    def label(self) -> str:
        name, timestep = PROGRAMS[self.program]
        return f"{name} at {timestep:g} s, {self.part + 1} of {self.parts}"

    @property
    def seconds(self) -> float:
        """Computing time, roughly."""
        name, timestep = PROGRAMS[self.program]
        steps = task_of(name, timestep).horizon
        return TASKS[name].cost * steps * POINTS * len(FAMILIES) / self.parts


def jobs() -> list[Job]:
    """All of them, longest first."""
    whole = [Job(program, 0, 1) for program in range(len(PROGRAMS))]
    counts = [math.ceil(job.seconds / LARGEST) for job in whole]
    split = [Job(job.program, part, parts) for job, parts in zip(whole, counts, strict=True) for part in range(parts)]
    return sorted(split, key=lambda job: -job.seconds)


def compute(job: Job, folder: Path, done: frozenset[int], end: float, core: int | None, most: int | None) -> int:
    """Compute what is missing of a job until the end, in a process of its own; the number of cells.

    Args:
        done: indices of cells that are there.
        end: as `time.time`.
        core: to run on; None for any.
        most: cells of each job; None for all.
    """
    if core is not None and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {core})
    configure(cpu_devices=1)
    mujoco.set_mju_user_warning(lambda message: None)
    mine = list(cells_of(job.program))[job.part :: job.parts][:most]
    missing = [cell for cell in mine if cell.index not in done]
    if not missing or time.time() > end - FEWEST:
        return 0
    programs, parts, longest = Programs(task_of(*PROGRAMS[job.program])), [], 0.0
    for at in range(0, len(missing), BLOCK):
        begun = time.time()
        if begun + 1.5 * longest > end:
            break
        parts.append(measure(programs, (missing[at : at + BLOCK] * BLOCK)[:BLOCK]))
        parts[-1] = {name: each[: len(missing) - at] for name, each in parts[-1].items()}
        write(folder / f"part-{job.name}-{os.getpid()}.npz", parts)
        longest = max(longest, time.time() - begun) if at else 0.0  # the first one compiles
    return sum(len(part["index"]) for part in parts)


def write(path: Path, parts: Sequence[dict[str, np.ndarray]], **more: Any) -> None:
    """Columns one below another, as float32 with `DIGITS` bits, in the order of the cells, each once."""
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    _, kept = np.unique(joined["index"], return_index=True)
    whole = joined["index"][kept].astype(np.int32)
    columns = {name: rounded(each[kept]) for name, each in joined.items()} | {"index": whole}
    write_whole(path, lambda file: np.savez_compressed(file, **columns, **more))


def rounded(values: np.ndarray) -> np.ndarray:
    """As float32, the rest of the mantissa zero."""
    with np.errstate(over="ignore"):
        single = np.asarray(values, np.float32)
    finite = np.isfinite(single)
    bits = single.view(np.uint32)
    half = np.uint32(1 << (22 - DIGITS))
    cut = ((bits + half) & ~np.uint32((1 << (23 - DIGITS)) - 1)).view(np.float32)
    return np.where(finite, cut, single)


def read(path: Path) -> dict[str, np.ndarray]:
    """Columns of a file, without what it says about itself."""
    with np.load(path) as file:
        return {name: file[name] for name in file.files if name != "about"}


def about(path: Path) -> dict[str, Any]:
    """What a file says about itself."""
    with np.load(path) as file:
        return json.loads(str(file["about"]))


def condense(folder: Path) -> int:
    """Join what the folder holds into atlas.npz, in place of its parts; the number of cells.

    The column `environment` says on which of `environments` a cell was computed.
    """
    joined = folder / RESULTS.name
    found, environments = [], []
    if joined.exists():
        found.append(read(joined))
        environments += about(joined)["environments"]
    if parts := sorted(path for path in folder.glob("*.npz") if path != joined):
        here = json.loads(json.dumps(environment()))
        if here not in environments:
            environments.append(here)
        for columns in map(read, parts):
            found.append(columns | {"environment": np.full(len(columns["index"]), environments.index(here))})
    if not found:
        return 0
    tasks = [task_of(*program) for program in PROGRAMS]
    told = {"environments": environments, "samples": SAMPLES, "seed": SEED, "programs": PROGRAMS, "families": FAMILIES}
    told |= {"durations": [task.horizon * task.scene.timestep for task in tasks]}
    told |= {"params": [task.policy.num_params for task in tasks]}
    write(joined, found, about=json.dumps(told))
    for path in parts:
        path.unlink()
    return len(read(joined)["index"])


def run(folder: Path, workers: int, seconds: float, most: int | None = None, only: Sequence[str] = ("",)) -> None:
    """Compute in as many processes as workers, each on a core of its own where there are enough, until time is up."""
    end = time.time() + seconds
    folder.mkdir(parents=True, exist_ok=True)
    os.environ["JAX_PLATFORMS"] = "cpu"
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_enable_x64", True)  # as in the workers, for `environment`
    before = condense(folder)
    done = frozenset(read(folder / RESULTS.name)["index"].tolist()) if before else frozenset()
    chosen = [job for job in jobs() if any(part in job.label for part in only)]
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    context = multiprocessing.get_context("spawn")
    with (
        context.Manager() as manager,
        concurrent.futures.ProcessPoolExecutor(workers, context, max_tasks_per_child=1) as pool,
    ):
        free = manager.Queue()
        for worker in range(workers):
            free.put(cores[worker] if workers <= len(cores) else None)
        waiting = {pool.submit(_on_a_core, free, job, folder, done, end, most): job for job in chosen}
        for future in concurrent.futures.as_completed(waiting):
            left = max(0.0, end - time.time())
            told = future.exception() or f"{future.result()} cells"
            print(f"{waiting[future].label}: {told}; {left:.0f} s left", flush=True)
    print(f"{condense(folder)} of {CELLS} cells in {folder / RESULTS.name}; {before} were there", flush=True)


def _on_a_core(free: Any, job: Job, folder: Path, done: frozenset[int], end: float, most: int | None) -> int:
    core = free.get()
    try:
        return compute(job, folder, done, end, core, most)
    finally:
        free.put(core)


def main() -> None:
    parser = argparse.ArgumentParser()
    commands = parser.add_subparsers(dest="command", required=True)
    runner = commands.add_parser("run")
    runner.add_argument("--output", type=Path, required=True)
    runner.add_argument("--workers", type=int, default=os.cpu_count())
    runner.add_argument("--seconds", type=float, default=math.inf)
    runner.add_argument("--cells", type=int, help="of each job, for a pilot; all unless given")
    runner.add_argument("--only", nargs="*", default=[""], help="parts of jobs' names, such as 'pusher at 0.01'")
    page = commands.add_parser("page")
    page.add_argument("results", type=Path, nargs="?", default=RESULTS)
    options = parser.parse_args()
    if options.command == "page":  # imported here, since matplotlib takes a second in every worker
        from experiments.atlas.page import make_page

        if options.results != RESULTS:
            write_whole(RESULTS, lambda file: file.write(options.results.read_bytes()))
        make_page(RESULTS)
        return
    run(options.output, options.workers, options.seconds, options.cells, options.only)
