"""Tables of docs/onset-correction.md.

python -m experiments.onset            # momentum_transfer and ball_wall, by quadrature; half an hour on one core
python -m experiments.onset tennis     # means along four directions of the gains; an hour on one core
python -m experiments.onset rule       # error of the linear term over the onset strength, 11 contact laws
python -m experiments.onset stiffness  # bias and deviation against stiffness; two minutes
python -m experiments.onset cost       # time of gradients with the linear term over that without; three minutes
"""

import sys
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from estimators import NOISES, first_order, zeroth_order
from experiments import DOCS
from experiments.atlas.design import task_of
from experiments.pages import markdown_row, write_tables
from experiments.quadruped import walk
from experiments.timing import interleaved
from mjx_study.experiment.quadrature import Line, Means, grid, means
from mjx_study.experiment.resolution import direction_of
from mjx_study.experiment.tally import onset_numbers
from mjx_study.objective import Simulator
from mjx_study.results.variables import ONSETS
from mjx_study.runtime import configure
from mjx_study.simulation.contact import ContactModel, contact_model, family_model
from mjx_study.table import markdown_table, percent
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import family_grid
from mjx_study.tasks.task import Task

ANGLES = {"momentum_transfer": (0.3, 0.5, 0.7), "ball_wall": (0.2, 0.7, 0.9)}
TREATMENTS = ("none", "linear", "shift")
TIMESTEPS = (0.004, 0.002, 0.001, 0.0005)
POINTS = 20_000
CHUNK = 1000
DIRECTIONS, SAMPLES, PAIRS, REACHES = 4, 20_000, 40_000, (0.01, 0.02, 0.04)  # of tennis
TIMED, SAMPLES_AT_ONCE = ("pusher", "ball_wall", "momentum_transfer", "tennis", "sliding_box", "landing"), 201
LAWS = (
    *(((constant, 1.0), (0.9, 0.95)) for constant in (0.01, 0.02, 0.04)),
    *(((0.02, damping), (0.9, 0.95)) for damping in (0.5, 2.0)),
    *(((0.02, 1.0), impedance) for impedance in ((0.5, 0.5), (0.7, 0.7), (0.9, 0.9), (0.95, 0.95), (0.99, 0.99))),
    ((0.02, 1.0), (0.5, 0.95)),
)
"""solref, and the impedances at the surface and at full width; they differ over 1 mm."""
RULED = (
    ("momentum_transfer", 0.001, ANGLES["momentum_transfer"]),
    ("momentum_transfer", 0.002, ANGLES["momentum_transfer"]),
    ("ball_wall", 0.002, ANGLES["ball_wall"][:1]),
)
"""Tasks, timesteps and angles at which the error is compared with the onset strength."""


def measure(task: Task, angles: tuple[float, ...]) -> tuple[Means, list[list[float]]]:
    """Return means at the angles, and standard deviations of one ZoBG and one FoBG sample, with the default contact."""
    contact = family_model("mujoco_default", task.scene, effective_mass=task.effective_mass)
    position = np.array(angles)
    return measured(task, contact, grid(position.min(), position.max(), task.sigma, POINTS, task.noise), position)


def measured(
    task: Task, contact: ContactModel | None, points: np.ndarray, position: np.ndarray
) -> tuple[Means, list[list[float]]]:
    """The same with a contact model, by quadrature at some points."""
    values, slopes = Line(task)(points, contact)
    noise, deviations = NOISES[task.noise], []
    for at in position:
        w = (points - at) / task.sigma
        zeroth = (values - np.interp(at, points, values)) * w / task.sigma  # Gaussian noise
        deviations.append([deviation(each, noise.density(w)) for each in (zeroth, slopes)])
    return means(points, values, slopes, position, task.sigma, task.noise), deviations


def deviation(samples: np.ndarray, weights: np.ndarray) -> float:
    """Standard deviation of weighted samples."""
    mean = np.average(samples, weights=weights)
    return float(np.average((samples - mean) ** 2, weights=weights) ** 0.5)


def tennis() -> None:
    """Print means and deviations along random directions of the gains, and the differences of the mean cost."""
    tasks = {onset: make_task("tennis").replace(onset=onset) for onset in TREATMENTS}
    plain = tasks["none"]
    contact = family_model("mujoco_default", plain.scene, effective_mass=plain.effective_mass)
    objectives = {onset: Simulator(task, CHUNK).objective(contact) for onset, task in tasks.items()}
    keys, pairs = (jax.random.split(jax.random.key(seed), size) for seed, size in enumerate((SAMPLES, PAIRS)))
    along = [direction_of("random", plain.policy.num_params, seed) for seed in range(DIRECTIONS)]
    _print("`tennis`, direction", [str(1 + index) for index in range(DIRECTIONS)])
    for reach in REACHES:
        ends = [
            [objectives["none"].evaluate(plain.theta + t * each, pairs).value for t in (-reach, reach)]
            for each in along
        ]
        _row(f"difference over ± {reach}", [np.asarray(above - below) / (2 * reach) for below, above in ends])
    zeroth = zeroth_order(objectives["none"].evaluate(plain.theta, keys), "zero_noise").per_sample
    found = {"ZoBG": np.asarray(zeroth)}
    for onset, objective in objectives.items():
        differentiate = objective.differentiate if onset == "none" else objective.differentiate_corrected
        found[onset] = np.asarray(first_order(differentiate(plain.theta, keys)).per_sample)
    for name, samples in found.items():
        _row(name, [samples @ each for each in along])
    for name, samples in found.items():
        _print(f"deviation: {name}", [f"{np.std(samples @ each, ddof=1):.0f}" for each in along])


def stiffness() -> None:
    """Write slopes, means and deviations of first-order gradients through springs and smooth onsets."""
    rows = []
    for name, angle in (("momentum_transfer", 0.5), ("ball_wall", 0.2)):
        task, position = make_task(name), np.array([angle])
        points = grid(angle, angle, task.sigma, POINTS, task.noise)
        for family in ("penalty", "smooth_onset"):
            for cell in family_grid(task, (family,))[0]:
                (plain, plain_deviations), (shift, shift_deviations) = (
                    measured(task.replace(onset=onset), cell.contact, points, position) for onset in ("none", "shift")
                )
                off = (percent(abs(each.first[0] / each.slope[0] - 1), 3) for each in (plain, shift))
                deviations = *plain_deviations[0], shift_deviations[0][1]
                slope = f"{plain.slope[0]:.5f} ± {plain.slope_error[0]:.1g}"
                cells = f"{cell.stiffness:g}", slope, *off, *(f"{each:.2g}" for each in deviations)
                rows.append((f"`{name}`, `{family}`", *cells))
                print(rows[-1], flush=True)
    names = "", "K [N/m]", "slope", "E[FoBG] off by", "with shifts", "deviation: ZoBG", "FoBG", "with shifts"
    write_tables(DOCS / "onset-correction.md", {"stiffness": markdown_table(rows, names)})


def rule() -> None:
    """Print the error of the linear term as a share of what it adds, over the onset strength."""
    cases = []
    for name, timestep, angles in RULED:
        task = task_of(name, timestep)
        lines = [Line(task.replace(onset=onset)) for onset in ("none", "linear")]
        simulator, position = Simulator(task.replace(onset="linear"), CHUNK), np.array(angles)
        points = grid(position.min(), position.max(), task.sigma, POINTS, task.noise)
        keys = jax.random.split(jax.random.key(0), 512)
        for solref, impedance in LAWS:
            contact = contact_model(solref, (*impedance, 0.001, 0.5, 2.0), scene=task.scene)
            plain, linear = (means(points, *line(points, contact), position, task.sigma, task.noise) for line in lines)
            share = np.abs(linear.first - linear.slope) / np.abs(linear.first - plain.first)
            unsure = (linear.slope_error + linear.first_error) / np.abs(linear.first - plain.first)
            objective = simulator.objective(contact)
            for at, angle in enumerate(angles):
                events = objective.differentiate_corrected(jnp.array([angle]), keys).events
                strength = dict(zip(ONSETS, onset_numbers(np.asarray(events)), strict=True))["onset_strength"]
                cases.append(share[at] / strength)
                cells = (share[at], unsure[at], strength, cases[-1])
                _print(
                    f"{name}, {1e3 * timestep:g} ms, {angle}, {solref}, {impedance}", [f"{each:.3g}" for each in cells]
                )
    print(f"{len(cases)} cases: {min(cases):.2g} to {max(cases):.2g}, median {np.median(cases):.2g}")


def cost() -> None:
    """Write the ratios of gradients' times, and what the rollouts' events are, in processor time of one device."""
    tasks = {f"`{name}`": (make_task(name), SAMPLES_AT_ONCE) for name in TIMED} | {"quadruped": (walk(128), 16)}
    columns = []
    for task, samples in tasks.values():
        own = task.contact_pair is None
        contact = None if own else family_model("mujoco_default", task.scene, effective_mass=task.effective_mass)
        keys = jax.random.split(jax.random.key(0), samples)
        plain, *corrected = (Simulator(task.replace(onset=each), samples).objective(contact) for each in TREATMENTS)
        calls = {"none": partial(plain.differentiate, task.theta, keys)}
        calls |= {
            name: partial(each.differentiate_corrected, task.theta, keys)
            for name, each in zip(TREATMENTS[1:], corrected, strict=True)
        }
        found, _, missed, *_ = np.asarray([call() for call in calls.values()][1].events).T
        taken = {
            name: np.median(each) for name, each in interleaved(calls, 301, clock=time.process_time, limit=15).items()
        }
        ratios = [f"{taken[name] / taken['none']:.2f}" for name in TREATMENTS[1:]]
        columns.append((*ratios, f"{np.mean(found):.1f}, {np.max(found):.0f}, {np.mean(missed):.1f}"))
        print(columns[-1], flush=True)
    kinds = (f"time with {kind} over time without" for kind in ("the linear term", "shifts"))
    names = *kinds, "onsets: mean, most, without a term"
    rows = [(name, *each) for name, each in zip(names, zip(*columns, strict=True), strict=True)]
    write_tables(DOCS / "onset-correction.md", {"cost": markdown_table(rows, ("", *tasks))})


def main() -> None:
    """Run the command line."""
    configure(cpu_devices=1)
    if chosen := sys.argv[1:]:
        {"tennis": tennis, "rule": rule, "stiffness": stiffness, "cost": cost}[chosen[0]]()
        return
    for name, angles in ANGLES.items():
        found = {onset: measure(make_task(name).replace(onset=onset), angles) for onset in TREATMENTS}
        plain, deviations = found["none"]
        _print(f"`{name}`", [f"{angle} rad" for angle in angles])
        _print("slope", _with_errors(plain.slope, plain.slope_error))
        for onset, (each, _) in found.items():
            _print(onset, _with_errors(each.first, each.first_error))
        _print("deviation: ZoBG", [f"{zeroth:.3g}" for zeroth, _ in deviations])
        each = [[own[index][1] for _, own in found.values()] for index in range(len(angles))]
        _print("FoBG, linear, shift", [", ".join(f"{value:.2g}" for value in row) for row in each])
        for onset in ("linear", "shift"):
            ratios = [(zeroth / own[1]) ** 2 for (zeroth, _), own in zip(deviations, found[onset][1], strict=True)]
            _print(f"variance of ZoBG over {onset}", [f"{ratio:.2g}" for ratio in ratios])
    _print("`momentum_transfer`, h", [f"{angle} rad" for angle in ANGLES["momentum_transfer"]])
    for timestep in TIMESTEPS:
        task = task_of("momentum_transfer", timestep)
        for onset in ("linear", "shift"):
            each, _ = measure(task.replace(onset=onset), ANGLES["momentum_transfer"])
            _print(f"{onset}, {1e3 * timestep:g} ms", [percent(error, 2) for error in abs(each.first / each.slope - 1)])


def _row(name: str, samples: list[np.ndarray]) -> None:
    values = [(np.mean(each), np.std(each, ddof=1) / len(each) ** 0.5) for each in samples]
    _print(name, [f"{mean:.0f} ± {error:.0f}" for mean, error in values])


def _with_errors(values: np.ndarray, errors: np.ndarray) -> list[str]:
    return [f"{value:.5f} ± {error:.1g}" for value, error in zip(values, errors, strict=True)]


def _print(name: str, cells: list[str]) -> None:
    print(markdown_row(name, *cells), flush=True)


if __name__ == "__main__":
    main()
