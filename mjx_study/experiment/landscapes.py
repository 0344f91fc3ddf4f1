r"""Landscapes of a cell: the cost along a line, its mean under noise, and each estimator's slope.

At each grid point of a line theta(t) = theta_0 + t * direction (for a scalar parameter, theta = t), compute

    the cost without noise,  F = E V_1,  E[ZoBG] . direction,  E[FoBG] . direction,

each mean with its standard error. Where F has a slope that E[FoBG] lacks, the cost jumps. All points and contact models
use the same keys, so curves are smooth and differences between them are not sampling noise; zeroth- and first-order
means use independent keys. Where `quadrature` applies, the means are also computed without sampling.

Reference: Suh et al. 2022, figure of simple systems, second row.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, Float, Int

from estimators import Estimator
from mjx_study.experiment.gradient_numbers import estimate_of, padded
from mjx_study.experiment.quadrature import QUADRATURE, Line, Means, applies, closed_form, grid, means
from mjx_study.experiment.resolution import line_of
from mjx_study.experiment.sampling import Objectives, cell_keys, draw_batches, rollouts_of
from mjx_study.experiment.study import (
    Arrays,
    Checkpoint,
    Computation,
    StudyCell,
    StudyKind,
    StudyPlan,
    done,
    estimators_of,
)
from mjx_study.experiment.tally import unconverged
from mjx_study.options.option import OptionError
from mjx_study.results.curves import landscape_findings, least_of
from mjx_study.results.kind import Drawing
from mjx_study.results.variables import LANDSCAPES
from mjx_study.runtime import precision


class Landscapes(StudyKind):
    """Costs along a line, and the slopes that the means of estimators have."""

    name = title = "landscapes"
    variables = LANDSCAPES
    optional = tuple(name for name in LANDSCAPES if name.startswith("exact_"))
    columns = ("least_cost", "least_at", "steepest", "nonfinite")
    finite = "cost"
    findings = staticmethod(landscape_findings)
    first_order = True

    def axes(self, config: Mapping[str, Any]) -> dict[str, Sequence[int]]:
        return {"point": range(config.get("points") or 0)}

    def describe(self, plan: StudyPlan) -> str:
        return f"{plan.config.settings.points} points"

    def check(self, plan: StudyPlan, cell: StudyCell) -> None:
        config, task = plan.config, plan.task_of(cell)
        if config.theta is not None and task.policy.num_params == 1:
            raise OptionError("theta", "has one entry, and the line is its range: give {} instead", "span")
        line_of(task, plan.config.settings.points, config.span, config.direction, config.seed)

    def rollouts(self, plan: StudyPlan, cell: StudyCell) -> np.ndarray:
        task = plan.task_of(cell)
        exact = QUADRATURE if not cell.model.analytic and applies(task) else 0
        return plan.config.settings.points * plan.config.seeds * rollouts_of(plan.oracles, cell.samples, task) + exact

    def computation(self, plan: StudyPlan) -> "LandscapeComputation":
        return LandscapeComputation(plan)

    def drawings(self, dataset: xr.Dataset) -> dict[str, Drawing]:
        from mjx_study.plots.descents import landscape

        caption = "Cost along a line through theta, and the slope of each estimator's mean there."
        return {"landscape": Drawing(landscape, caption)}

    def summarised(self, dataset: xr.Dataset) -> xr.Dataset:
        """Add the extremes of each curve."""
        least = least_of(dataset)
        return dataset.assign(
            least_cost=dataset["smoothed"].min("point"),
            least_cost_se=dataset["smoothed_se"].isel(point=least),
            least_at=dataset["position"].isel(point=least),
            steepest=abs(dataset["slope"]).max("point"),
        )


KIND: Final = Landscapes()


class LandscapeComputation(Computation):
    """Computes landscapes, each in a single unit."""

    def __init__(self, plan: StudyPlan):
        self._plan, self._objectives = plan, Objectives(plan)
        self._lines: dict[int, Line] = {}

    def compute(self, cell: StudyCell, unit: int, checkpoint: Checkpoint) -> Future[Arrays]:
        plan, config, objective = self._plan, self._plan.config, self._objectives(cell)
        task, chosen = plan.task_of(cell), estimators_of(plan, cell)
        line = line_of(task, config.settings.points, config.span, config.direction, config.seed)
        keys, columns, solved = cell_keys(config.seed, config.seeds), [], []
        samples, size = np.asarray(config.seeds * cell.samples), plan.padded_samples(cell, config.seeds)
        for point, theta in enumerate(line.thetas(task.theta.dtype)):
            checkpoint.report(point, plan.config.settings.points, "points of the line")
            drawn, _, residuals = draw_batches(objective, theta, keys, plan.oracles, cell.samples, slice(None))
            solved += residuals.values()
            pooled = jax.tree.map(lambda leaf: leaf.reshape(1, -1, *leaf.shape[2:]), drawn)
            pooled = jax.tree.map(lambda leaf: padded(leaf, size)[0], pooled)
            columns.append(jax.device_get(_slopes(pooled, samples, line.direction, chosen)))
        arrays = {name: np.stack([column[name] for column in columns], axis=-1) for name in columns[0]}
        arrays |= {
            "position": line.position,
            "unconverged": np.asarray(sum(unconverged(each, precision()) for each in solved)),
            "residual": np.max([np.max(np.nan_to_num(each, nan=np.inf), initial=0.0) for each in solved]),
        }
        if (found := self._exact(cell, line.position, objective)) is not None:
            arrays |= {f"exact_{name}": values for name, values in vars(found).items()}
        return done({name: np.asarray(array, float) for name, array in arrays.items()})

    def _exact(self, cell: StudyCell, position: Float[np.ndarray, " points"], objective: Any) -> Means | None:
        """Means by quadrature or in closed form, where available."""
        task = self._plan.task_of(cell)
        if cell.model.analytic:
            return closed_form(objective, position)
        if not applies(task):
            return None
        points = grid(position[0], position[-1], cell.sigma, QUADRATURE, task.noise)
        if points[1] - points[0] > cell.sigma / 8:  # too coarse for so narrow a noise
            return None
        if cell.group not in self._lines:
            self._lines[cell.group] = Line(task)
        return means(points, *self._lines[cell.group](points, cell.model.contact), position, cell.sigma, task.noise)


@partial(jax.jit, static_argnames="chosen")
def _slopes(
    batches: dict[str, Any], samples: Int[Array, ""] | np.ndarray, direction: Array, chosen: tuple[Estimator, ...]
) -> dict[str, Array]:
    """Costs at a point, and every estimator's slope along the line, without nonfinite samples and padding."""
    evaluation = batches["evaluation"]
    real, padding = jnp.arange(len(evaluation.value)) < samples, len(evaluation.value) - samples
    smoothed, smoothed_se = _mean(jnp.where(real, evaluation.value, jnp.nan))
    estimates = [estimate_of(estimator, batches, samples) for estimator in chosen]
    slope, slope_se = map(jnp.stack, zip(*(_mean(each.per_sample @ direction) for each in estimates), strict=True))
    return {
        "slope": slope,
        "slope_se": slope_se,
        "nonfinite": jnp.stack([each.num_nonfinite - padding for each in estimates]),
        "cost": jnp.sum(jnp.where(real, evaluation.baseline, 0.0)) / samples,
        "smoothed": smoothed,
        "smoothed_se": smoothed_se,
    }


def _mean(sample: Float[Array, " samples"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    finite = jnp.isfinite(sample)
    count = jnp.sum(finite)
    return jnp.mean(sample, where=finite), jnp.std(sample, where=finite, ddof=1) / jnp.sqrt(count)
