"""Statistics of closed forms and of MJX landscapes over one parameter: biases, variances, errors, and the lemmas."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np

import estimators
from estimators import AlphaOrder, FirstOrder, GradientEstimate, InverseVariance, ZerothOrder, constrained_alpha
from mjx_study.claims.laboratory import (
    Laboratory,
    Slopes,
    Statistic,
    batch,
    batches,
    closed_form,
    difference_of,
    exact,
    log_variance,
    mean_of,
    ratio_of,
    share_of,
)
from mjx_study.reference import Heaviside, RelaxedHeaviside

STIFFNESS: Final = 10_000.0
"""Contact stiffness of the landscapes, for families that take one [N/m]."""
STEP, RAMP = "step", "ramp of 0.01 sigma"  # analytic systems
Changes = Mapping[str, Any]
NONE: Final[Changes] = MappingProxyType({})  # no changes of a landscape


def at(lab: Laboratory, system: str, family: str, stiffness: float = STIFFNESS, **changes: Any) -> Slopes:
    """Landscape of a system under a family, at the angle or height and with the relaxed derivatives given in its name.

    Changes are those of `Laboratory.slopes`; `relaxed="none"` stands for exact derivatives.
    """
    if system == STEP:
        return closed_form(Heaviside(), 0.5, 1.0)
    if system == RAMP:
        return closed_form(RelaxedHeaviside(0.01), 0.0, 1.0)
    task, angle, *relaxed = system.split(", ")
    changes = {"relaxed": relaxed[0] if relaxed else None} | changes
    changes["relaxed"] = None if changes["relaxed"] == "none" else changes["relaxed"]
    return lab.slopes(task, family, float(angle.split()[0]), stiffness=stiffness, **changes)


def pair(lab: Laboratory, system: str, family: str, one: Changes, other: Changes) -> list[Slopes]:
    """Two landscapes with changes, which may replace the system or the family."""
    named: dict[str, Any] = {"system": system, "family": family}
    return [at(lab, **(named | dict(changes))) for changes in (one, other)]


def relative_bias(lab: Laboratory, system: str, family: str, absolute: bool = False, **changes: Any) -> Statistic:
    """(E[FoBG] - grad F) / grad F of a landscape."""
    found = at(lab, system, family, **changes)
    return exact(abs(found.relative) if absolute else found.relative, sum(found.errors), found.points)


def bias_ratio(
    lab: Laboratory, system: str, family: str, one: Changes = NONE, other: Changes = NONE, absolute: bool = False
) -> Statistic:
    """Relative bias on one landscape as a share of that on another."""
    first, second = pair(lab, system, family, one, other)
    share = first.relative / second.relative
    slack = (sum(first.errors) + abs(share) * sum(second.errors)) / abs(second.relative)
    return exact(abs(share) if absolute else share, slack, second.points)


def variance_ratio(lab: Laboratory, system: str, family: str, one: Changes = NONE, other: Changes = NONE) -> Statistic:
    """log10 of FoBG's variance on one landscape over that on another."""
    points = pair(lab, system, family, one, other)
    return difference_of(*(log_variance(batch(FirstOrder(), each, lab.effort.draws)) for each in points))


def error_ratio(lab: Laboratory, system: str, family: str, one: Changes = NONE, other: Changes = NONE) -> Statistic:
    """log10 of FoBG's mean squared error in batches of 200 on one landscape over that on another, both about the
    gradient of the first."""
    points = pair(lab, system, family, one, other)
    (first,), (second,) = (batches([FirstOrder()], each, 200, 2 * lab.effort.batches) for each in points)
    return errors_of(first, second, points[0].gradient)


def moved_gradient(lab: Laboratory, system: str, family: str, one: Changes, other: Changes) -> Statistic:
    """Relative distance between the gradients of two landscapes."""
    first, second = pair(lab, system, family, one, other)
    share = first.gradient / second.gradient
    return exact(abs(share - 1), first.errors[0] * abs(share) + abs(share) * second.errors[0], first.points)


def errors_of(one: GradientEstimate, other: GradientEstimate, gradient: float) -> Statistic:
    """log10 of the ratio of two mean squared errors over the same batches."""
    squared = [(np.asarray(each.mean)[:, 0] - gradient) ** 2 for each in (one, other)]
    return ratio_of(squared[0], squared[1], "batches")


def zeroth_bias(lab: Laboratory, system: str, family: str) -> Statistic:
    found = at(lab, system, family)
    rows = batch(ZerothOrder(), found, 4 * lab.effort.draws).per_sample[:, 0]
    return mean_of(np.asarray(rows) / found.gradient - 1, "samples", found.errors[0])


def variances(lab: Laboratory, system: str, family: str) -> Statistic:
    found = at(lab, system, family)
    one, other = (log_variance(batch(each, found, lab.effort.draws)) for each in (FirstOrder(), ZerothOrder()))
    return difference_of(one, other)


def silent(lab: Laboratory, system: str, family: str) -> Statistic:
    (found,) = batches([FirstOrder()], at(lab, system, family), 10, 10 * lab.effort.batches)
    return share_of(np.all(np.asarray(found.per_sample) == 0, axis=(1, 2)), "batches")


def missed(lab: Laboratory, system: str, family: str, *, truth: str, samples: int, quantile: float) -> Statistic:
    """Share of batches whose interval for the first-order mean, with a quantile of Student's t, misses a number of
    the landscape."""
    point = at(lab, system, family)
    (found,) = batches([FirstOrder()], point, samples, 5 * lab.effort.batches)
    gap = np.abs(np.asarray(found.mean)[:, 0] - getattr(point, truth))
    return share_of(gap > quantile * np.asarray(found.standard_error)[:, 0], "batches")


def rare(lab: Laboratory, system: str, family: str) -> Statistic:
    """log10 of the largest Delta_0^2 / beta over the variance, with a large batch as the distribution."""
    found = batch(FirstOrder(), at(lab, system, family), lab.effort.draws // 10)
    count = len(found.per_sample)
    variance, mean = float(found.variance) * (1 - 1 / count), float(abs(found.mean[0]))
    bounds = [0.0]
    for number in np.unique(np.geomspace(1, count // 2, 40).astype(int)):
        seen = estimators.empirical_bias(found, found.mean, int(number))
        beta = number / count
        bounds.append(max(0.0, (1 - beta) * float(seen.discrepancy) - beta * mean) ** 2 / beta)
    return exact(math.log10(max(bounds) / variance) if max(bounds) > 0 else -300.0)


def friction(lab: Laboratory, system: str, family: str) -> Statistic:
    """Exponent e of the variance in nu^e, by regression over four widths."""
    widths = np.array([0.1, 0.03, 0.01, 0.003])
    points = [closed_form(RelaxedHeaviside(float(width)), 0.0, 1.0) for width in widths]
    found = [log_variance(batch(FirstOrder(), point, 4 * lab.effort.draws)) for point in points]
    x = np.log10(widths) - np.mean(np.log10(widths))
    shares = list(zip(x / np.sum(x**2), found, strict=True))
    error = math.sqrt(sum((weight * each.error) ** 2 for weight, each in shares))
    estimate = float(sum(weight * each.estimate for weight, each in shares))
    return Statistic(estimate, error, min(each.freedom for each in found), samples=4 * lab.effort.draws, of="samples")


def bound(lab: Laboratory, system: str, family: str) -> Statistic:
    """log10 of ZoBG's variance without a baseline over B_V^2 B_pi^2 H m / sigma^2, here max |f|^2 / sigma^2."""
    point = at(lab, system, family)
    key, theta = jax.random.key(2), jnp.array([point.theta])
    largest = float(jnp.max(jnp.abs(point.objective.evaluate(theta, jax.random.split(key, lab.effort.draws)).value)))
    found = log_variance(batch(ZerothOrder(baseline="none"), point, lab.effort.draws))
    return difference_of(found, exact(2 * math.log10(largest / point.objective.sigma)))


def accurate(lab: Laboratory, system: str, family: str) -> Statistic:
    """Share of batches of 4000 that keep an error of gamma = |grad F| / 2, among those that promise it."""
    point = at(lab, system, family)
    gamma = abs(point.gradient) / 2
    (found,) = batches([AlphaOrder(gamma=gamma)], point, 4000, lab.effort.batches)
    choice = found.alpha
    assert choice is not None and choice.epsilon is not None and choice.discrepancy is not None
    promised = np.asarray(choice.epsilon + choice.alpha * choice.discrepancy) <= gamma * (1 + 1e-9)
    kept = np.abs(np.asarray(found.mean)[:, 0] - point.gradient) <= gamma
    return share_of(kept[promised], "batches that promise it")


def solution(lab: Laboratory, system: str, family: str) -> Statistic:
    """Largest distance of the closed form from the best alpha on a grid, over random problems."""
    random = np.random.default_rng(0)
    zeroth, first, distance, epsilon = random.lognormal(0, 2, (4, 10 * lab.effort.batches))
    gamma = epsilon * (1 + random.lognormal(0, 1, len(epsilon)))
    alphas = np.linspace(0, 1, 20_001)[:, None]
    worst = 0.0
    for part in np.array_split(np.arange(len(gamma)), 100):
        objective = alphas**2 * first[part] + (1 - alphas) ** 2 * zeroth[part]
        feasible = epsilon[part] + alphas * distance[part] <= gamma[part]
        best = alphas[np.argmin(np.where(feasible, objective, np.inf), axis=0), 0]
        given = (zeroth[part], first[part], distance[part], epsilon[part], gamma[part])
        closed = jax.vmap(constrained_alpha)(*map(jnp.asarray, given))
        worst = max(worst, float(np.max(np.abs(np.asarray(closed) - best))))
    return exact(worst)


def compared(lab: Laboratory, system: str, family: str, one: str, other: str) -> Statistic:
    """log10 of the ratio of two estimators' mean squared errors, over batches of 200; gamma is |grad F| / 2."""
    point = at(lab, system, family)
    bounded = AlphaOrder(gamma=abs(point.gradient) / 2)
    known = {"zobg": ZerothOrder(), "fobg": FirstOrder(), "ivw": InverseVariance(), "aobg": bounded}
    first, second = batches([known[one], known[other]], point, 200, 2 * lab.effort.batches)
    return errors_of(first, second, point.gradient)
