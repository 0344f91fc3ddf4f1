"""Statistics of studies: the variance of first order by stiffness, timestep and horizon, and its cost."""

from typing import Any, Final

import jax
import numpy as np
import xarray as xr

from mjx_study.choices import REFERENCE
from mjx_study.claims.laboratory import REAL, TIMED, Laboratory, Statistic, mean_of, times_of
from mjx_study.claims.theory import STIFFNESS
from mjx_study.options.configuration import StudyConfig
from mjx_study.runtime import local_devices

STIFFNESSES: Final = (10.0, 100.0, 1000.0, 1200.0)  # contact stiffnesses of the pusher [N/m]
CRITICAL: Final = 14.14
"""Critical damping of 1000 N/m between the pusher's bodies, of effective mass 0.05 kg [N s/m]."""
HALF_STEP: Final = 0.0025  # half of the pusher's timestep [s]


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
        return study(lab, "pusher", contact=REAL, stiffness=STIFFNESSES[2:], timestep=(HALF_STEP,))
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


def pusher_ratio(lab: Laboratory, system: str, family: str, stiffness: float | None = None) -> Statistic:
    return ratio(pusher(lab), family, stiffness)


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
