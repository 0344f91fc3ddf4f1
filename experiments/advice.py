"""Test of the advice of `mjx-study diagnose` on models that were not used to make it, for docs/diagnose.md.

    python -m experiments.advice [PART OF A CASE'S NAME ...]    # cases missing in data/advice.jsonl, then the page
    python -m experiments.advice --page                         # only the page

Each case compares the estimator that a diagnosis recommends with the best of the five by an independent measurement:
other random numbers, many batches of the advised size, and a reference gradient from values alone. It compares root
mean squared errors after one second of computing on this machine.
"""

import argparse
import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from estimators import GradientEstimate, make_estimator, oracles_of, squared_bias_of_means
from estimators.confidence import coverage_interval
from estimators.mean_check import TOLERANCE
from experiments import DATA, DOCS, append_line, read_lines
from experiments.pages import write_tables
from mjx_study.choices import DEFAULT_SOLIMP, DEFAULT_SOLREF, STIFF_SOLIMP
from mjx_study.diagnose.measurement import ESTIMATORS, measure
from mjx_study.experiment.reference_gradient import candidates_of, reference_of
from mjx_study.experiment.sampling import cell_keys, draw_batches
from mjx_study.objective import MjxObjective, Simulator, chunk_for
from mjx_study.runtime import configure, local_devices
from mjx_study.simulation.contact import contact_model
from mjx_study.simulation.scene import load_scene
from mjx_study.table import markdown_table, percent
from mjx_study.tasks import make_task
from mjx_study.tasks.mjcf import scene_task
from mjx_study.tasks.task import Task

RESULTS: Final = DATA / "advice.jsonl"
HELD_OUT: Final = DATA / "held_out"
PAGE: Final = DOCS / "diagnose.md"
KNOWN: Final = ("momentum_transfer",)
"""Tasks on which the rules of `diagnose` were developed; every other model is held out."""
CONTACTS: Final = {
    "default": (DEFAULT_SOLREF, DEFAULT_SOLIMP),
    "soft": ((0.06, 1.0), DEFAULT_SOLIMP),
    "stiff": ((-1e4, -100.0), STIFF_SOLIMP),
    "bouncy": ((-5e3, -10.0), DEFAULT_SOLIMP),
    "ringing": ((0.03, 0.2), DEFAULT_SOLIMP),
    "half": (DEFAULT_SOLREF, (0.5, 0.95, 0.001, 0.5, 2.0)),
    "smooth": (DEFAULT_SOLREF, (1e-4, 0.95, 0.02, 0.5, 2.0)),
}
LATER: Final = ("sled", "edge", "stops", "hull", "arm", "slope", "margin")
"""Models that were added after all rules had been made, with half of the contacts."""
LIMITS: Final = ("pendulum", "stops")  # models whose joints reach their limits, without contact
FINE: Final = ("cart", "balls")  # models that are also run at half the timestep, with the default contact
HORIZON: Final = 80
SAMPLES: Final = 300  # samples per batch of a diagnosis
TOTAL: Final = 20_000  # samples per estimator in the independent measurement
SIZES: Final = (20, 200)  # smallest and largest batch size in the independent measurement
PARTS: Final = (8_000, 100, 500)
"""Pairs of rollouts of the reference, and numbers of samples for its control variates."""
FACTOR: Final = 2.0
DRAWS: Final = 1000
SEEDS: Final = (0, 1)  # seeds of the diagnosis and of the independent measurement


@dataclasses.dataclass(frozen=True)
class Case:
    """One model at one timestep, under one contact."""

    model: str
    contact: str
    halved: bool = False

    @property
    def name(self) -> str:
        """Name of the case in the results."""
        return f"{self.model}, {self.contact}{', half the timestep' if self.halved else ''}"


def cases() -> Iterator[Case]:
    """Yield all cases, grouped by compiled program."""
    held_out = sorted(path.stem for path in HELD_OUT.glob("*.xml"))
    for model in held_out + list(KNOWN):
        contacts = ("default",) if model in LIMITS else tuple(CONTACTS)[::2] if model in LATER else CONTACTS
        yield from (Case(model, contact) for contact in contacts)
    for model in (*FINE, "pendulum"):
        yield Case(model, "default", halved=True)


def task_of(case: Case) -> Task:
    """Return the task of a case."""
    if case.model in KNOWN:
        return make_task(case.model)
    scene, horizon = load_scene(HELD_OUT / f"{case.model}.xml"), HORIZON
    if case.halved:
        scene, horizon = load_scene(HELD_OUT / f"{case.model}.xml", timestep=scene.timestep / 2), 2 * HORIZON
    return scene_task(scene, horizon=horizon)


def reference(objective: MjxObjective, key: Any) -> GradientEstimate:
    """Return the gradient from values; medians of first-order gradients only serve as control variates."""
    odd, candidate, pilot = (
        jax.random.split(part, size) for part, size in zip(jax.random.split(key, 3), PARTS, strict=True)
    )
    task = objective.simulator.task
    other = jnp.median(objective.differentiate_corrected(task.theta, jax.random.clone(candidate)).gradient, axis=0)
    candidates = candidates_of(task, objective, candidate, other)
    return reference_of(task, objective, odd, objective.evaluate(task.theta, pilot), candidates)


def measured(objective: MjxObjective, size: int) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Return the means of many batches by estimator (batches, params), and seconds per sample."""
    task, count = objective.simulator.task, TOTAL // size
    chosen = [make_estimator(name, gamma=task.defaults.gamma, sigma=task.sigma) for name in ESTIMATORS]
    keys = cell_keys(SEEDS[1], count)
    drawn, seconds, _ = draw_batches(objective, task.theta, keys, oracles_of(chosen), size, slice(count))
    means = {each.name: np.asarray(jax.jit(jax.vmap(lambda part, e=each: e(part).mean))(drawn)) for each in chosen}
    return means, {each.name: sum(seconds[need] for need in each.needs) / (size * count) for each in chosen}


def factors(
    means: dict[str, np.ndarray], seconds: dict[str, float], size: int, truth: GradientEstimate, advised: str
) -> dict[str, Any]:
    """Return the advised estimator's error over the smallest one, after one second each, and all relative biases, with
    95 % intervals.

    The noise of the reference and of the means is subtracted from the squared bias. The interval resamples both,
    jointly for all estimators, and subtracts their noise twice, since it enters twice.
    """
    rng, count = np.random.default_rng(0), len(next(iter(means.values())))
    noise = np.asarray(jnp.atleast_2d(jnp.cov(truth.per_sample, rowvar=False))) / len(truth.per_sample)
    gradients = rng.multivariate_normal(np.asarray(truth.mean), noise, DRAWS, method="svd")
    picked = rng.integers(count, size=(DRAWS, count))

    def error(biases: Any, variance: Any, name: str) -> Any:
        return np.sqrt(np.maximum(biases, 0.0) + variance * size * seconds[name])

    norm, found, drawn, biases = float(jnp.linalg.norm(truth.mean)), {}, {}, {}
    for name, each in means.items():
        spread = np.sum(np.var(each, axis=0, ddof=1))
        bias, _ = squared_bias_of_means(jnp.asarray(each), truth)
        found[name] = float(error(float(bias), spread, name))
        again = [(np.mean(each[draw], axis=0), np.sum(np.var(each[draw], axis=0, ddof=1))) for draw in picked]
        gaps = np.sum((np.array([mean for mean, _ in again]) - gradients) ** 2, axis=1)
        spreads = np.array([variance for _, variance in again])
        gaps -= 2 * (np.trace(noise) + spread / count)
        drawn[name] = error(gaps, spreads, name)
        squares = [float(bias), *np.quantile(gaps, (0.025, 0.975))]
        biases[name] = [_short(math.sqrt(max(square, 0.0)) / norm) for square in squares]
    least = np.min(list(drawn.values()), axis=0)
    low, high = np.quantile(drawn[advised] / least, (0.025, 0.975))
    best = min(found, key=lambda name: found[name])
    return {
        "best": best,
        "factor": _short(found[advised] / found[best]),
        "interval": [_short(low), _short(high)],
        "errors": {name: _short(value / norm) for name, value in found.items()},
        "biases": biases,
        "milliseconds": {name: _short(1e3 * value) for name, value in seconds.items()},
        "pairs": PARTS[0],
        "reference_error": _short(math.sqrt(np.trace(noise)) / norm),
    }


def _short(value: float) -> float:
    return float(f"{value:.3g}")


def result(case: Case, simulator: Simulator) -> dict[str, Any]:
    """Measure a case; return one line of the results."""
    solref, solimp = CONTACTS[case.contact]
    contact = contact_model(solref, solimp, scene=simulator.task.scene) if case.model not in LIMITS else None
    advice = measure(simulator, contact, SAMPLES, SEEDS[0])
    needed = advice.samples_needed
    size = int(np.clip(needed, *SIZES)) if math.isfinite(needed) else SIZES[1]
    objective = simulator.objective(contact)
    means, seconds = measured(objective, size)
    truth = reference(objective, jax.random.key(SEEDS[1] + 1))
    line = {
        "case": case.name,
        "model": case.model,
        "held_out": case.model not in KNOWN,
        "advised": advice.best.estimator,
    }
    verdicts = {each.estimator: each.verdict for each in advice.estimators if each.paths}
    return line | {"size": size, **factors(means, seconds, size, truth, advice.best.estimator), "means": verdicts}


def read() -> list[dict[str, Any]]:
    """Return the results so far, in the order of the cases."""
    by_name = {each["case"]: each for each in read_lines(RESULTS)}
    return [by_name[case.name] for case in cases() if case.name in by_name]


def verdict(each: dict[str, Any]) -> str:
    """Classify the factor by whether its interval lies below the limit, above it, or on both sides."""
    low, high = each["interval"]
    return "good" if high <= FACTOR else "bad" if low > FACTOR else "undecided"


def table(results: list[dict[str, Any]]) -> str:
    """Format the table of the page."""
    rows = []
    for label, held_out in (("held out", True), ("known", False)):
        group = [each for each in results if each["held_out"] is held_out]
        if not group:
            continue
        decided = [each for each in group if verdict(each) != "undecided"]
        good = [verdict(each) == "good" for each in decided]
        share, low, high = coverage_interval(jnp.array(good), 0.95)
        names = ", ".join(f"`{name}`" for name in dict.fromkeys(each["model"] for each in group))
        row = [f"{label}: {names}", len(group), len(group) - len(decided), f"{sum(good)} of {len(good)}"]
        row += [f"{percent(share)} ({percent(low)} to {percent(high)})", max(each["factor"] for each in decided)]
        rows.append(row)
    factors = [each["factor"] for each in results]
    within, worst = sum(each <= FACTOR for each in factors), max(factors)
    note = (
        f"{len(results)} of the {len(list(cases()))} cases of the script were run. By the factor without its interval, "
    )
    note += f"{within} of {len(results)} are within two, undecided ones included; the largest is {worst}."
    header = ("models", "cases", "undecided", "within a factor of two", "share, 95 % interval", "largest factor")
    return f"{markdown_table(rows, header)}\n\n*{note}*"


def against(each: dict[str, Any], name: str) -> str:
    """How an estimator's verdict, which needs no reference, compares with the independent measurement."""
    stated, (_, low, high) = each["means"][name], each["biases"][name]
    if stated == "undecided":
        return "undecided"
    contradicted = low > TOLERANCE if stated == "right" else low == 0 and high <= TOLERANCE
    confirmed = high <= 2 * TOLERANCE if stated == "right" else low > 0
    return "contradicted" if contradicted else "confirmed" if confirmed else "open"


def verdicts(results: list[dict[str, Any]]) -> str:
    """Format the table of verdicts on means."""
    rows = []
    for label, later in (("before", False), ("after", True)):
        group = [each for each in results if (each["model"] in LATER) is later]
        for name in ("fobg", "fobg_onset"):
            for stated in ("right", "biased", "undecided"):
                some = [against(each, name) for each in group if each["means"][name] == stated]
                counts = [some.count(what) for what in ("confirmed", "contradicted", "open")]
                rows.append([label, name, stated, len(some), *(counts if stated != "undecided" else ["-"] * 3)])
    header = ("models chosen", "estimator", "verdict", "cases", "confirmed", "contradicted", "open")
    return markdown_table(rows, header)


def bodies(results: list[dict[str, Any]]) -> str:
    """Format the bias of first order with and without the onset term, through MuJoCo's default contact."""
    rows = []
    for each in results:
        if each["case"] == f"{each['model']}, default":
            shown = [_interval(each["biases"][name]) for name in ("fobg", "fobg_onset")]
            rows.append([f"`{each['model']}`", *shown, each["means"]["fobg_onset"]])
    return markdown_table(rows, ("model", "plain", "with the onset term", "verdict on the latter, without a reference"))


def _interval(bias: Sequence[float]) -> str:
    _, low, high = bias
    least, most = (percent(end, 1 if high < 1 else 0) for end in (low, high))
    return f"at most {most}" if low == 0 else f"{least} to {most}"


def write_page() -> None:
    """Write the tables into the pages."""
    results = read()
    write_tables(PAGE, {"advice": table(results), "verdicts": verdicts(results)})
    write_tables(DOCS / "onset-correction.md", {"bodies": bodies(results)})


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("parts", nargs="*")
    parser.add_argument("--page", action="store_true")
    options = parser.parse_args()
    configure(cpu_devices=1)
    mujoco.set_mju_user_warning(lambda message: None)
    done, made = {each["case"] for each in read()}, {}
    for case in cases():
        asked = not options.parts or any(part in case.name for part in options.parts)
        if options.page or case.name in done or not asked:
            continue
        if (key := (case.model, case.halved)) not in made:
            made = {key: Simulator(task_of(case), chunk_size=chunk_for(SAMPLES, local_devices()))}
        line = result(case, made[key])
        append_line(RESULTS, line)
        print(f"{line['case']}: {line['advised']}, {line['factor']:g} {line['interval']}", flush=True)
    write_page()


if __name__ == "__main__":
    main()
