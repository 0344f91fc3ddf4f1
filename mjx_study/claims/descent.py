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
from mjx_study.claims.ledger import Claim, above, below
from mjx_study.claims.theory import FACTOR, FIVE, STIFFNESS
from mjx_study.options.configuration import StudyConfig

BALL, BAR, SOFT, STIFF = "ball_wall", "momentum_transfer", "pusher, 10 N/m", "pusher, 1000 N/m"
SLIDE, GAME = "sliding_box", "tennis"
SPANS: Final = {BALL: (0.0, 1.5), BAR: (0.0, 1.0)}
"""Range of angles that a descent may reach [rad]."""
STARTS: Final = {"stiffness_schedule": 0.01, "sigma_schedule": 3.0}
"""Initial factors of the schedules."""
CELL: Final = ("task", "timestep", "cone", "model", "sigma", "samples")
"""Singleton dimensions of a study with one cell."""
GAMES: Final = 12
"""Number of descents per estimator on tennis, at any effort, with half the usual samples: they take the longest."""
DIVERGED: Final = 10.0
"""Cost of a diverged descent, as a multiple of the best one's gain."""


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
    share = 1.0 if system == BALL else effort.iterations
    iterations = max(10, round(share * recipe.iterations))
    common = {
        "iterations": iterations,
        "seeds": effort.seeds_of_descents,
        "samples": (effort.samples if many else recipe.samples,),
    }
    if system == GAME:
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
        dataset: study of descents.
        variable: "final_cost", or "cost", which is averaged over the iterations.
        estimator: name of the estimator.
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


def behind(lab: Laboratory, system: str, family: str) -> Statistic:
    return gap(lab, system, family, "fobg", "zobg")


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


GAIN: Final = "as a share of what the best gained"
EVERYWHERE: Final = {
    BALL: (REFERENCE, "penalty", "mujoco_default", "smooth_onset"),
    BAR: (REFERENCE, *FIVE),
    SOFT: (REFERENCE, "penalty"),
    STIFF: (REFERENCE, "penalty"),
    SLIDE: (REFERENCE, "penalty", "mujoco_default", "mujoco_stiff"),
    GAME: ("penalty", "mujoco_default"),
}
CLAIMS: Final = (
    Claim(
        "ball-over-wall",
        "section 5.1, ball with wall",
        "First-order descent stays short of the wall, which zeroth order clears.",
        above(f"final cost, FoBG's less ZoBG's, {GAIN}", 0.1, -0.1),
        {BALL: EVERYWHERE[BALL]},
        behind,
        "mjx-study optimise ball_wall --reference",
    ),
    Claim(
        "bar-off-the-cliff",
        "section 5.1, angular momentum transfer",
        "First-order descent goes over the edge past which the bar is missed, or ends behind zeroth order otherwise.",
        above(f"final cost, FoBG's less ZoBG's, {GAIN}", 0.1, -0.1),
        {BAR: EVERYWHERE[BAR]},
        behind,
        "mjx-study optimise momentum_transfer --reference",
    ),
    Claim(
        "different-minima",
        "section 5.1, bias-variance leads to different minima",
        "The two estimators end at different policies, not at one of them sooner.",
        above("distance of the final angles, FoBG's from ZoBG's, in standard deviations of the noise", 1.0),
        {BALL: EVERYWHERE[BALL], BAR: EVERYWHERE[BAR]},
        apart,
        "mjx-study optimise momentum_transfer --contact mujoco_default",
    ),
    Claim(
        "soft-push",
        "section 5.2, pushing",
        "For soft springs (10 N/m) first order outperforms zeroth order.",
        above(f"final cost, ZoBG's less FoBG's, {GAIN}", 0.001, -0.001),
        {SOFT: EVERYWHERE[SOFT]},
        lambda lab, system, family: gap(lab, system, family, "zobg", "fobg"),
        "mjx-study optimise pusher --contact penalty --stiffness 10",
    ),
    Claim(
        "stiff-push",
        "section 5.2, pushing",
        "For stiff springs (1000 N/m) zeroth order outperforms first order.",
        above(f"final cost, FoBG's less ZoBG's, {GAIN}", 0.001, -0.001),
        {STIFF: EVERYWHERE[STIFF]},
        behind,
        "mjx-study optimise pusher --contact penalty --stiffness 1000",
    ),
    Claim(
        "slides-off",
        "section 5.2, friction",
        "First-order descent does not see the edge that the block slides off, and ends behind zeroth order.",
        above(f"final cost, FoBG's less ZoBG's, {GAIN}", 0.001, -0.001),
        {SLIDE: EVERYWHERE[SLIDE]},
        behind,
        "mjx-study optimise sliding_box --reference",
    ),
    Claim(
        "misses-balls",
        "section 5.2, tennis",
        "First-order descent suffers from the discontinuities of geometry and ends behind zeroth order.",
        above(f"final cost, FoBG's less ZoBG's, {GAIN}", 0.001, -0.001),
        {GAME: EVERYWHERE[GAME]},
        behind,
        "mjx-study optimise tennis --contact mujoco_default --samples 200",
    ),
    Claim(
        "onset-plays",
        "this project",
        "With the onset term first-order descent ends where zeroth order does.",
        below(f"final cost, FoBG's with onset less ZoBG's, {GAIN}", 0.02),
        {GAME: EVERYWHERE[GAME]},
        lambda lab, system, family: gap(lab, system, family, "fobg_onset", "zobg"),
        "mjx-study optimise tennis --contact mujoco_default --samples 200 --estimators zobg,fobg,fobg_onset",
    ),
    Claim(
        "aobg-as-good",
        "sections 5.1 and 5.2; conclusion",
        "The interpolation ends where the better of the two does.",
        below(f"final cost, AoBG's less the better one's, {GAIN}", 0.02),
        EVERYWHERE,
        regret,
        "mjx-study optimise pusher --contact penalty --stiffness 1000",
    ),
    Claim(
        "aobg-faster",
        "section 5.2: slightly faster convergence",
        "At equal iterations the interpolation is ahead of the better of the two on the way.",
        below(f"cost averaged over the iterations, AoBG's less the better one's, {GAIN}", -0.001, 0.001),
        EVERYWHERE,
        lambda lab, system, family: regret(lab, system, family, "cost"),
        "mjx-study optimise sliding_box --reference",
    ),
    Claim(
        "curriculum-helps",
        "section 6: a curriculum from soft to stiff contact (left open)",
        "Contact that stiffens on the way, from a hundredth, lets first order end lower than stiff contact throughout.",
        above(f"final cost, FoBG's at constant stiffness less the scheduled, {GAIN}", 0.001, -0.001),
        {STIFF: EVERYWHERE[STIFF]},
        lambda lab, system, family: gained(lab, system, family, "stiffness_schedule", "fobg"),
        "mjx-study optimise pusher --stiffness 1000 --stiffness-schedule 'linear_schedule(0.01, 1, 250)'",
    ),
    Claim(
        "annealing-helps",
        "section 6: a schedule of the noise (left open)",
        "Noise that shrinks on the way, from three times sigma, lets the interpolation end lower.",
        above(f"final cost, AoBG's at constant sigma less the scheduled, {GAIN}", 0.001, -0.001),
        {BALL: (REFERENCE,), BAR: (REFERENCE,)},
        lambda lab, system, family: gained(lab, system, family, "sigma_schedule", "aobg"),
        "mjx-study optimise ball_wall --reference --sigma-schedule 'linear_schedule(3, 1, 100)'",
    ),
    Claim(
        "robot-favours-fobg",
        "this project",
        "Of a neural network that lands a robot on two legs, the first-order estimate has the lower variance.",
        below("log10 Var[FoBG] / Var[ZoBG]", -FACTOR, FACTOR),
        {"landing": ("penalty", "mujoco_default", "smooth_onset")},
        robot_variances,
        "mjx-study compare landing --contact penalty,mujoco_default,smooth_onset",
    ),
)
