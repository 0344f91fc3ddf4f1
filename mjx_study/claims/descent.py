"""Claims about gradient descent: the paper's experiments, on the references and in MJX. And one about a robot.

Tasks with one parameter descend on tabulated landscapes of MJX; the others are simulated.
"""

from typing import Final

import jax
import numpy as np
import xarray as xr

import estimators
from estimators import FirstOrder, ZerothOrder
from mjx_study.choices import REFERENCE
from mjx_study.claims.laboratory import Laboratory, Statistic, difference_of, log_variance, mean_of
from mjx_study.claims.theory import STIFFNESS
from mjx_study.options.configuration import StudyConfig

SPANS: Final = {"ball_wall": (0.0, 1.5), "momentum_transfer": (0.0, 1.0)}
"""Range of angles that a descent may reach [rad]."""
STARTS: Final = {"stiffness_schedule": 0.01, "sigma_schedule": 3.0}  # initial factors of the schedules
CELL: Final = ("task", "timestep", "cone", "model", "sigma", "samples")
"""Singleton dimensions of a study with one cell."""
GAMES: Final = 12
"""Number of descents per estimator on tennis, at any effort, with half the usual samples: they take the longest."""
DIVERGED: Final = 10.0  # cost of a diverged descent, as a multiple of the best one's gain


def descents(lab: Laboratory, system: str, family: str, schedule: str | None = None) -> xr.Dataset:
    """Descend with ZoBG, FoBG and AoBG, on tennis also with the onset term, by the task's recipe or a share of it.

    The ball's descents are never cut short: zeroth order clears the wall late. `schedule` names a schedule option: the
    stiffness grows from a hundredth, or sigma shrinks from three times its size, over the first half.
    """
    name, _, stiffness = system.partition(", ")
    task, effort = lab.task(name), lab.effort
    recipe = task.defaults.recipe
    assert recipe is not None
    many = recipe.samples > effort.samples
    share = 1.0 if system == "ball_wall" else effort.iterations
    iterations = max(10, round(share * recipe.iterations))
    common = {
        "iterations": iterations,
        "seeds": effort.seeds_of_descents,
        "samples": (effort.samples if many else recipe.samples,),
    }
    if system == "tennis":
        names = ("zobg", "fobg", "aobg", "fobg_onset")
        common |= {"seeds": GAMES, "samples": (effort.samples // 2,), "estimators": names}
    if schedule is not None:
        common[schedule] = f"linear_schedule({STARTS[schedule]}, 1, {iterations // 2})"
    if name in SPANS:
        contact = (STIFFNESS, *SPANS[name])
        described = lab.tabulated(name, family, *contact) if family != REFERENCE else name
        return lab.study(StudyConfig(tasks=(described,), contact=(REFERENCE,), stiffness=(STIFFNESS,), **common))
    hard = {"stiffness": (float(stiffness.removesuffix(" N/m")),)} if stiffness else {}
    if hard == {} and family != "mujoco_default":
        hard = {"stiffness": (task.defaults.middle_stiffness,)}
    return lab.study(StudyConfig(tasks=(name,), contact=(family,), **hard, **common))


def scaled(dataset: xr.Dataset, variable: str, estimator: str, like: xr.Dataset | None = None) -> np.ndarray:
    """Costs of an estimator by seed, scaled to 0 at the start and -1 at the best estimator's mean final cost.

    Args:
        variable: "final_cost", or "cost", which is averaged over the iterations.
        like: study that sets the scale; None for `dataset`.
    """
    cell, other = (each.isel({name: 0 for name in CELL}) for each in (dataset, dataset if like is None else like))
    ends, start = other["final_cost"], float(other["start_cost"])
    best = float(ends.where(np.isfinite(ends)).mean("seed").min())
    costs = cell[variable].sel(estimator=estimator).transpose(..., "seed").values
    found = np.clip(np.nan_to_num((costs - start) / (start - best), nan=DIVERGED, posinf=DIVERGED), -DIVERGED, DIVERGED)
    return found if found.ndim == 1 else np.mean(found, axis=0)


def gap(lab: Laboratory, system: str, family: str, estimator: str, other: str) -> Statistic:
    """Final cost of an estimator minus that of another."""
    found = descents(lab, system, family)
    return mean_of(scaled(found, "final_cost", estimator) - scaled(found, "final_cost", other), "seeds")


def regret(lab: Laboratory, system: str, family: str, variable: str = "final_cost") -> Statistic:
    """Cost of AoBG, at the end or during descent, minus that of the better of the two; see `scaled`."""
    found = descents(lab, system, family)
    better = min(("zobg", "fobg"), key=lambda name: scaled(found, variable, name).mean())
    return mean_of(scaled(found, variable, "aobg") - scaled(found, variable, better), "seeds")


def apart(lab: Laboratory, system: str, family: str) -> Statistic:
    """Distance between the final policies of FoBG and ZoBG, in standard deviations of the noise."""
    found = descents(lab, system, family)
    theta = found["theta"].isel({name: 0 for name in (*CELL, "param")})
    one, other = (theta.sel(estimator=name).values for name in ("fobg", "zobg"))
    return mean_of(np.abs(one - other) / float(found["sigma"].values[0]), "seeds")


def gained(lab: Laboratory, system: str, family: str, schedule: str, estimator: str) -> Statistic:
    """Gain in an estimator's final cost from a schedule, by seed: both descents draw the same noise."""
    plain, other = descents(lab, system, family), descents(lab, system, family, schedule)
    costs = scaled(plain, "final_cost", estimator), scaled(other, "final_cost", estimator, plain)
    return mean_of(costs[0] - costs[1], "seeds")


def robot_variances(lab: Laboratory, system: str, family: str) -> Statistic:
    """log10 of FoBG's variance over ZoBG's at the task's initial theta, on shared samples."""
    task = lab.task(system)
    objective = lab.objective(system, family, task.defaults.middle_stiffness)
    chosen, samples = (FirstOrder(), ZerothOrder()), 2 * lab.effort.samples
    drawn = estimators.draw(estimators.oracles_of(chosen), objective, task.theta, jax.random.key(0), samples)
    first, zeroth = (log_variance(estimator(drawn)) for estimator in chosen)
    return difference_of(first, zeroth)
