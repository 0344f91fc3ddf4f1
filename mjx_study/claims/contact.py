"""Claims about simulated contact: stiffness, chaos, geometry, friction, and the bias where contact begins."""

import dataclasses
import math
from typing import Any, Final

import jax
import numpy as np
import xarray as xr

from estimators import FirstOrder
from mjx_study.choices import REFERENCE
from mjx_study.claims.laboratory import (
    RELAXATIONS,
    TIMED,
    Laboratory,
    Slopes,
    Statistic,
    batches,
    exact,
    mean_of,
    times_of,
)
from mjx_study.claims.ledger import REAL, Claim, above, below, within
from mjx_study.claims.theory import (
    EDGE,
    FACTOR,
    FIVE,
    HIT,
    NEGLIGIBLE_BIAS,
    SHORT,
    STIFFNESS,
    WALL,
    at,
    bias,
    compared,
    errors_of,
    relative_bias,
    variances_of,
)
from mjx_study.options.configuration import StudyConfig
from mjx_study.runtime import local_devices

STIFFNESSES: Final = (10.0, 100.0, 1000.0, 1200.0)
"""Contact stiffnesses of the pusher [N/m]."""
SWEPT: Final = tuple(family for family in REAL if family != "mujoco_default")
"""Families that take a stiffness."""
CRITICAL: Final = 14.14
"""Critical damping of 1000 N/m between the pusher's bodies, of effective mass 0.05 kg [N s/m]."""
HALF_STEP: Final = {"pusher": 0.0025, "momentum_transfer": 0.001}
"""Half of the tasks' timesteps [s]."""
DOME: Final = "ball_wall:dome, 0.65 rad"
DOME_SIGMA: Final = 0.03
"""Noise of the claims on the dome [rad]."""
DAMPED: Final = ("impedance", "mujoco_default", "mujoco_stiff")
"""Families whose force sets in with a jump."""
RELAXED: Final[dict[str, tuple[str, ...]]] = {f"{HIT}, {name}": DAMPED for name in RELAXATIONS}
"""Systems with derivatives of a relaxed contact."""


def study(lab: Laboratory, task: str, **changes: Any) -> xr.Dataset:
    """Return a study of ZoBG and FoBG at a task's initial theta, without use of its reference gradient."""
    effort, common = lab.effort, {"estimators": ("zobg", "fobg"), "reference_samples": 3}
    common |= {"samples": (effort.samples,), "seeds": effort.seeds}
    return lab.study(StudyConfig(tasks=(task,), **common | changes))


def pusher(lab: Laboratory, *, half: bool = False, damping: float | None = None) -> xr.Dataset:
    """Return the pusher study shared by most claims, at half the timestep, or critically damped at 1000 N/m."""
    if damping is not None:
        return study(lab, "pusher", contact=("penalty", "impedance"), stiffness=(1000.0,), damping=damping)
    if half:
        return study(lab, "pusher", contact=REAL, stiffness=STIFFNESSES[2:], timestep=(HALF_STEP["pusher"],))
    return study(lab, "pusher", contact=(REFERENCE, *REAL), stiffness=STIFFNESSES)


def logs(dataset: xr.Dataset, family: str, stiffness: float | None, estimator: str) -> np.ndarray:
    """log10 of each batch's variance for one contact model; 300 if all samples overflowed."""
    models = dataset["contact"].values == family
    if stiffness is not None and family != "mujoco_default":
        models &= np.isclose(dataset["stiffness"].values, stiffness)
    (model,) = np.flatnonzero(models)
    found = dataset["variance"].isel(model=model, task=0, timestep=0, cone=0, sigma=0, samples=0)
    variances = np.atleast_1d(found.sel(estimator=estimator).values)
    return np.nan_to_num(np.log10(variances), nan=300.0, posinf=300.0)


def ratio(dataset: xr.Dataset, family: str, stiffness: float | None) -> Statistic:
    """Mean over batches of log10 of FoBG's variance over ZoBG's."""
    one, other = (logs(dataset, family, stiffness, name) for name in ("fobg", "zobg"))
    return mean_of(one - other, "batches")


def stiff(lab: Laboratory, system: str, family: str) -> Statistic:
    return ratio(pusher(lab), family, STIFFNESSES[3])


def rate(lab: Laboratory, system: str, family: str) -> Statistic:
    ends = [logs(pusher(lab), family, stiffness, "fobg") for stiffness in STIFFNESSES[::2]]
    return mean_of((ends[1] - ends[0]) / 2, "batches")


def finer(lab: Laboratory, system: str, family: str) -> Statistic:
    fine, usual = (logs(pusher(lab, half=half), family, STIFFNESSES[3], "fobg") for half in (True, False))
    return mean_of(fine - usual, "batches")


def gradient_cost(lab: Laboratory, system: str, family: str) -> Statistic:
    objective, theta = lab.objective(system, family, STIFFNESS), lab.task(system).theta
    keys = jax.random.split(jax.random.key(0), TIMED * len(local_devices()) - 1)  # leaves room for a baseline
    methods = (objective.differentiate, objective.evaluate)
    one, other = (times_of(lambda method=method: method(theta, jax.random.clone(keys))) for method in methods)
    return mean_of(np.log10(one / other), "batches")


def implicit(lab: Laboratory, system: str, family: str) -> Statistic:
    spring = pusher(lab) if system == "pusher, undamped" else pusher(lab, damping=CRITICAL)
    ours = spring if family == "impedance" else pusher(lab)
    one, other = logs(ours, family, 1000.0, "fobg"), logs(spring, "penalty", 1000.0, "fobg")
    return mean_of(one - other, "batches")


def chaos(lab: Laboratory, system: str, family: str) -> Statistic:
    """Variance ratio at a horizon."""
    horizon = int(system.partition(", ")[2].removesuffix(" steps"))
    half = (lab.effort.samples // 2,)
    return ratio(study(lab, "double_pendulum", contact=(family,), horizon=horizon, samples=half), family, None)


def dome(lab: Laboratory, system: str, family: str) -> Statistic:
    names = system, system.replace(":dome", "")
    return variances_of(lab, *(at(lab, name, family, sigma=DOME_SIGMA) for name in names))


def biases_of(one: Slopes, other: Slopes) -> Statistic:
    """Relative bias on one landscape as a share of that on another."""
    share = one.relative / other.relative
    slack = (sum(one.errors) + abs(share) * sum(other.errors)) / abs(other.relative)
    return exact(share, slack, other.points)


def timestep(lab: Laboratory, system: str, family: str) -> Statistic:
    half = at(lab, system, family, timestep=HALF_STEP["momentum_transfer"])
    return biases_of(half, at(lab, system, family))


def cure_cost(lab: Laboratory, system: str, family: str) -> Statistic:
    return variances_of(lab, at(lab, system, family, onset="linear"), at(lab, system, family))


def _relaxed(lab: Laboratory, system: str, family: str, onset: str = "none") -> tuple[Slopes, Slopes]:
    """Return a landscape with the derivatives of the relaxation named by the system, and one with exact ones."""
    where, _, relaxed = system.rpartition(", ")
    return at(lab, where, family, relaxed=relaxed), at(lab, where, family, onset=onset)


def relaxed_bias(lab: Laboratory, system: str, family: str) -> Statistic:
    where, _, relaxed = system.rpartition(", ")
    return relative_bias(lab, where, family, relaxed=relaxed)


def relaxed_share(lab: Laboratory, system: str, family: str) -> Statistic:
    share = biases_of(*_relaxed(lab, system, family))
    return dataclasses.replace(share, estimate=abs(share.estimate))


def onset_or_relaxed(lab: Laboratory, system: str, family: str) -> Statistic:
    relaxed, corrected = _relaxed(lab, system, family, onset="linear")
    (one,), (other,) = (batches([FirstOrder()], each, 200, 2 * lab.effort.batches) for each in (corrected, relaxed))
    return errors_of(one, other, corrected.gradient)


def softened(lab: Laboratory, system: str, family: str) -> Statistic:
    one, other = (at(lab, system, family, stiffness=stiffness) for stiffness in (3e3, 3e4))
    share = one.gradient / other.gradient
    return exact(abs(share - 1), one.errors[0] * abs(share) + abs(share) * other.errors[0], one.points)


STIFFNESS_COMMAND: Final = "mjx-study compare pusher --stiffness 10,100,1000,1200 --contact penalty,mujoco,smooth_onset"
RATIO: Final = "mean over batches of log10 Var[FoBG] / Var[ZoBG]"
CLAIMS: Final = (
    Claim(
        "soft-favours-fobg",
        "section 3.3, pushing with stiff contact",
        "While contact is soft (10 N/m), the first-order estimate has the lower variance.",
        below(RATIO, -FACTOR, FACTOR),
        {"pusher, 10 N/m": (REFERENCE, *SWEPT)},
        lambda lab, system, family: ratio(pusher(lab), family, STIFFNESSES[0]),
        STIFFNESS_COMMAND,
    ),
    Claim(
        "stiffness-raises-variance",
        "section 3.3, pushing with stiff contact",
        "The first-order variance rises with the contact's stiffness.",
        above("mean over batches of log10 Var[FoBG] per decade of stiffness, 10 to 1000 N/m", FACTOR, -FACTOR),
        {"pusher": (REFERENCE, *SWEPT)},
        rate,
        STIFFNESS_COMMAND,
    ),
    Claim(
        "stiffness-crossover",
        "section 3.3, pushing with stiff contact",
        "At 1200 N/m, where the step is still stable, the zeroth-order estimate has the lower variance.",
        above(RATIO, FACTOR, -FACTOR),
        {"pusher, 1200 N/m": (REFERENCE, *SWEPT)},
        stiff,
        STIFFNESS_COMMAND,
    ),
    Claim(
        "default-contact-is-soft",
        "section 3.3, for MuJoCo's default contact (125 N/m here)",
        "At MuJoCo's default contact, too, the zeroth-order estimate has the lower variance.",
        above(RATIO, FACTOR, -FACTOR),
        {"pusher": ("mujoco_default",)},
        stiff,
        "mjx-study compare pusher --contact mujoco_default",
    ),
    Claim(
        "smaller-step-mends",
        "section 3.3",
        "At 1200 N/m half the timestep lowers the first-order variance.",
        below("mean over batches of log10 Var[FoBG], at 2.5 ms over at 5 ms", -FACTOR, FACTOR),
        {"pusher, 1200 N/m": SWEPT},
        finer,
        "mjx-study sweep pusher --stiffness 1200 --timestep 0.0025,0.005 --output out",
    ),
    Claim(
        "fobg-costs-more",
        "section 6, computation time",
        "A first-order sample takes longer than a zeroth-order one.",
        above("mean over batches of log10 of their time, FoBG's over ZoBG's", math.log10(1.1), 0.0),
        {"pusher": (REFERENCE,), "sliding_box": (REFERENCE,)},
        gradient_cost,
        "mjx-study bench momentum_transfer",
    ),
    Claim(
        "chaos-early",
        "section 3.3, chaos of the double pendulum",
        "At 0.4 s the first-order estimate has the lower variance.",
        below(RATIO, -FACTOR, FACTOR),
        {"double_pendulum, 400 steps": (REFERENCE, "mjcf")},
        chaos,
        "mjx-study compare double_pendulum --horizon 400",
    ),
    Claim(
        "chaos-crossover",
        "section 3.3, chaos of the double pendulum",
        "As the horizon grows (to 2 s) the zeroth-order estimate has the lower variance.",
        above(RATIO, FACTOR, -FACTOR),
        {"double_pendulum, 2000 steps": (REFERENCE, "mjcf")},
        chaos,
        "mjx-study compare double_pendulum --horizon 2000",
    ),
    Claim(
        "dome-raises-variance",
        "section 3.2, geometric discontinuity",
        "A dome in place of the wall's corner raises the first-order variance.",
        above("log10 Var[FoBG], the dome's over the box's, sigma = 0.03 rad", FACTOR, -FACTOR),
        {DOME: FIVE},
        dome,
        "mjx-study landscape ball_wall:dome --contact penalty,smooth_onset",
    ),
    Claim(
        "dome-unbiased",
        "section 3.2, geometric discontinuity",
        "On the dome the first-order estimate is unbiased.",
        within("(E[FoBG] - grad F) / grad F, sigma = 0.03 rad", -NEGLIGIBLE_BIAS, NEGLIGIBLE_BIAS),
        {DOME: FIVE},
        lambda lab, system, family: relative_bias(lab, system, family, sigma=DOME_SIGMA),
        "mjx-study landscape ball_wall:dome --contact penalty,smooth_onset",
    ),
    Claim(
        "implicit-less-stiff",
        "section 6, implicit time-stepping (left open)",
        "An implicit contact suffers less from stiffness than a spring as stiff and as damped.",
        below("mean over batches of log10 Var[FoBG], over the spring's, 1000 N/m and 5 ms", -FACTOR, FACTOR),
        {"pusher, undamped": ("impedance",), "pusher, damped": tuple(name for name in SWEPT if name != "penalty")},
        implicit,
        "mjx-study compare pusher --stiffness 1000 --contact penalty,impedance --damping 14.14",
    ),
    Claim(
        "implicit-geometry",
        "section 6, implicit time-stepping (left open)",
        "At the edge of a wall or a bar first order remains the less accurate of the two, implicit contact or not.",
        above("log10 of the mean squared error, FoBG's over ZoBG's, in batches of 200", FACTOR, -FACTOR),
        {WALL: (REFERENCE, *FIVE), EDGE: (REFERENCE, *FIVE)},
        lambda lab, system, family: compared(lab, system, family, "fobg", "zobg"),
        "mjx-study compare ball_wall --contact penalty,mujoco_default,mujoco_stiff",
    ),
    Claim(
        "analytic-smoothing-moves",
        "section 6, analytic smoothing",
        "Smoothing by a softer contact moves the gradient of the mean cost, which noise alone leaves where it is.",
        above("|grad F at 3 kN/m over that at 30 kN/m - 1|", NEGLIGIBLE_BIAS),
        {HIT: ("penalty", "impedance", "mujoco_stiff", "smooth_onset")},
        softened,
        "mjx-study landscape momentum_transfer --stiffness 3000,30000 --contact penalty",
    ),
    Claim(
        "onset-bias",
        "this project",
        "Where contact sets in with a jump of its force, first order is biased, though the cost has no jump.",
        above("|E[FoBG] - grad F| / |grad F|", NEGLIGIBLE_BIAS),
        {HIT: DAMPED, SHORT: DAMPED},
        bias,
        "mjx-study gradcheck momentum_transfer --mean --contact mujoco_default --estimators fobg",
    ),
    Claim(
        "onset-sign",
        "this project",
        "That bias can turn the sign of the mean.",
        below("(E[FoBG] - grad F) / grad F", -1.0),
        {HIT: DAMPED},
        relative_bias,
        "mjx-study landscape momentum_transfer --contact mujoco_default",
    ),
    Claim(
        "onset-any-timestep",
        "this project",
        "That bias does not shrink with the timestep.",
        within("bias at 1 ms over bias at 2 ms", 0.8, 1.25),
        {HIT: ("mujoco_default", "mujoco_stiff")},
        timestep,
        "mjx-study sweep momentum_transfer --contact mujoco --points 3 --timestep 0.001,0.002 --output slopes",
    ),
    Claim(
        "onset-cure",
        "this project",
        "With the onset term the first-order estimate is unbiased.",
        within("(E[FoBG with the term] - grad F) / grad F", -NEGLIGIBLE_BIAS, NEGLIGIBLE_BIAS),
        {HIT: FIVE},
        lambda lab, system, family: relative_bias(lab, system, family, onset="linear"),
        "mjx-study gradcheck momentum_transfer --mean --contact mujoco_default --estimators fobg,fobg_onset",
    ),
    Claim(
        "onset-cure-free",
        "this project",
        "The onset term costs no variance.",
        below("log10 Var[FoBG], with the term over without", FACTOR),
        {HIT: DAMPED},
        cure_cost,
        "mjx-study compare momentum_transfer --contact mujoco_default --estimators zobg,fobg,fobg_onset",
    ),
    Claim(
        "relaxed-backward-helps",
        "section 6, implicit time-stepping and smoothing (left open)",
        "Relaxing the contact in the backward pass alone removes more than half of the onset bias.",
        below("|E[FoBG] - grad F|, with relaxed derivatives over with exact ones", 0.5, 1.0),
        RELAXED,
        relaxed_share,
        "mjx-study landscape momentum_transfer --contact mujoco_default --backward none,smooth_onset",
    ),
    Claim(
        "relaxed-backward-unbiased",
        "section 6, implicit time-stepping and smoothing (left open)",
        "Relaxing the contact in the backward pass alone leaves no bias.",
        within("(E[FoBG with relaxed derivatives] - grad F) / grad F", -NEGLIGIBLE_BIAS, NEGLIGIBLE_BIAS),
        RELAXED,
        relaxed_bias,
        "mjx-study landscape momentum_transfer --contact mujoco_default --backward none,smooth_onset",
    ),
    Claim(
        "relaxed-backward-costs",
        "section 6, implicit time-stepping and smoothing (left open)",
        "Relaxed derivatives vary more than exact ones.",
        above("log10 Var[FoBG], with relaxed derivatives over with exact ones", FACTOR, -FACTOR),
        RELAXED,
        lambda lab, system, family: variances_of(lab, *_relaxed(lab, system, family)),
        "mjx-study compare momentum_transfer --contact mujoco_default --backward none,smooth_onset",
    ),
    Claim(
        "onset-term-or-relaxing",
        "this project",
        "The onset term is more accurate than derivatives of a relaxed contact.",
        below("log10 of the mean squared error in batches of 200, the onset term's over the relaxed", -FACTOR, FACTOR),
        RELAXED,
        onset_or_relaxed,
        "mjx-study gradcheck momentum_transfer --mean --contact mujoco_default --estimators fobg,fobg_onset",
    ),
    Claim(
        "smooth-onset-costs",
        "this project",
        "A smooth onset, unbiased as it is, costs variance against MuJoCo's default impedance.",
        above("log10 Var[FoBG], smooth onset's over the default impedance's", FACTOR, -FACTOR),
        {HIT: ("smooth_onset",), SHORT: ("smooth_onset",)},
        lambda lab, system, family: variances_of(lab, *(at(lab, system, name) for name in (family, "mujoco"))),
        "mjx-study compare momentum_transfer --contact mujoco,smooth_onset",
    ),
)
