"""Tables of docs/coverage.md: how often each interval covers, how often each test rejects.

    python -m experiments.coverage

A minute on one core. Only the tables of the page are replaced.
"""

from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import estimators
from estimators import ENOUGH_EFFECTIVE, ESTIMATORS, make_estimator, summarise
from experiments import DOCS
from experiments.linear_quadratic import LinearQuadratic
from experiments.pages import write_tables
from mjx_study.reference import ReferenceObjective
from mjx_study.results.curves import DETECTED_SE
from mjx_study.runtime import configure
from mjx_study.table import markdown_table, percent

PAGE: Final = DOCS / "coverage.md"
SAMPLES: Final = (10, 400)
TRIALS: Final = 2000
TOGETHER: Final = 100  # trials computed together
PARAMS: Final = 3
DRAWS: Final = 199
REFERENCE: Final = (100, 0.05)
"""Number of samples of the reference, and its standard error over the gradient's norm."""
BIAS: Final = 0.3  # true relative error: bias over the gradient's norm
SEEDS: Final = 10  # number of batches per estimate of a squared bias
RARE: Final = 0.01


class Kind(NamedTuple):
    """A distribution of noise with mean zero.

    Attributes:
        draw: of a key and a number of samples; (samples, PARAMS).
        variance: of one sample, the trace of its covariance.
    """

    draw: Callable[[Array, int], Array]
    variance: float


def _rare(key: Array, samples: int) -> Array:
    """Draw 1 / RARE with probability RARE, minus its mean, in the first parameter."""
    event = jax.random.bernoulli(key, RARE, (samples,)) / RARE - 1.0
    return event[:, None] * jnp.eye(1, PARAMS)


KINDS: Final = {
    "Gaussian": Kind(lambda key, n: jax.random.normal(key, (n, PARAMS)), float(PARAMS)),
    "Student's t, 3 degrees": Kind(lambda key, n: jax.random.t(key, 3.0, (n, PARAMS)), 3.0 * PARAMS),
    "lognormal": Kind(
        lambda key, n: jnp.exp(jax.random.normal(key, (n, PARAMS))) - np.exp(0.5), (np.e - 1) * np.e * PARAMS
    ),
    f"an event of {percent(RARE)}": Kind(_rare, 1 / RARE - 1),
}
COLUMNS: Final = {
    "mean": "mean ± 1.96 se",
    "apart": f"mean off by {DETECTED_SE:g} se",
    "variance": "variance",
    "variances": "two variances differ",
    "relative_error": "relative error",
    "debiased_error": "debiased",
    "cosine": "cosine",
    "debiased_cosine": "debiased",
    "squared_bias": "squared bias",
    "epsilon": "epsilon",
}
"""Columns of the table of intervals; each holds a share of the trials."""


def trials(kind: Kind, samples: int, count: int) -> dict[str, np.ndarray]:
    """Estimate from `count` batches, and compare each estimate with the truth.

    The gradient is as long as half a standard deviation of a sample; rare samples carry the whole of it.
    """
    rare = kind.draw is _rare
    length = 1.0 if rare else 0.5 * kind.variance**0.5
    gradient = length * jnp.eye(1, PARAMS)[0]
    offset = BIAS * length * jnp.eye(PARAMS)[1]
    others, uncertainty = REFERENCE

    def one(key: Array) -> dict[str, Array]:
        streams = jax.random.split(key, 3)
        batch = summarise(gradient + kind.draw(streams[0], samples))
        scale = uncertainty * length * (others / PARAMS) ** 0.5
        reference = summarise(gradient + scale * jax.random.normal(streams[1], (others, PARAMS)))
        lower, upper = estimators.variance_interval(batch, 0.95)
        off = jnp.abs(batch.mean - gradient)[0] / batch.standard_error[0]
        epsilon = estimators.bernstein_epsilon(
            batch, failure_probability=0.05, variance_proxy="variance", radius="max_deviation"
        )
        test = estimators.bias_test(batch, reference, streams[2], num_draws=DRAWS)
        biased = summarise(batch.per_sample + offset)
        found = estimators.compare(biased, reference)
        measured = {
            "mean": off <= 1.96,
            "apart": off > DETECTED_SE,
            "variance": (lower <= kind.variance) & (kind.variance <= upper),
            "epsilon": jnp.linalg.norm(batch.mean - gradient) <= epsilon,
            "rejects": test.p_value <= 0.05,
            "believable": test.effective_samples >= ENOUGH_EFFECTIVE,
        }
        for name, exact in (("error", BIAS), ("cosine", (1 + BIAS**2) ** -0.5)):
            raw = "relative_error" if name == "error" else name
            for field in (raw, f"debiased_{name}"):
                measured[field] = jnp.abs(getattr(found, field) - exact) <= 1.96 * getattr(found, f"{field}_se")
        return measured | {"lower": lower, "upper": upper, "biased": biased.mean, "reference": reference}

    return _map(one, jax.random.split(jax.random.key(samples), count)) | {"bias": BIAS * length}


def _map(function: Callable[[Array], Any], keys: Array) -> Any:
    """Apply a function to all keys, `TOGETHER` at a time; return NumPy arrays."""
    program = jax.jit(lambda keys: jax.lax.map(function, keys, batch_size=TOGETHER))
    return jax.tree.map(np.asarray, program(keys))


def shares(found: dict[str, Any]) -> dict[str, float]:
    """Return each column's share of the trials."""
    measured = {name: float(np.mean(found[name])) for name in COLUMNS if name in found}
    apart = found["upper"][::2] < found["lower"][1::2]
    apart |= found["lower"][::2] > found["upper"][1::2]
    groups = len(found["biased"]) // SEEDS
    means = jnp.asarray(found["biased"][: groups * SEEDS].reshape(groups, SEEDS, PARAMS))
    references = jax.tree.map(lambda leaf: jnp.asarray(leaf[: groups * SEEDS : SEEDS]), found["reference"])
    value, error = jax.jit(jax.vmap(estimators.squared_bias_of_means))(means, references)
    held = np.abs(np.asarray(value) - found["bias"] ** 2) <= 1.96 * np.asarray(error)
    return measured | {"variances": float(np.mean(apart)), "squared_bias": float(np.mean(held))}


def coverage_rows(name: str, samples: int, count: int = TRIALS) -> tuple[list[str], list[str]]:
    """Return a row of the table of intervals, and one of the table of the test for bias."""
    found = trials(KINDS[name], samples, count)
    share = shares(found)
    return (
        [name, str(samples), *(_share(share[column]) for column in COLUMNS)],
        [name, str(samples), *_verdicts(found)],
    )


def _verdicts(found: dict[str, Any]) -> list[str]:
    rejects, believable = found["rejects"], found["believable"]
    among = _share(float(np.mean(rejects[believable]))) if np.sum(believable) >= 50 else "-"
    return [_share(float(np.mean(rejects))), _share(float(np.mean(believable))), among]


def rare_row(expected: float, samples: int, count: int = TRIALS) -> list[str]:
    """Return a row on the test for bias where, on average, `expected` samples of a batch carry the whole gradient."""
    probability = expected / samples

    def one(key: Array) -> dict[str, Array]:
        event, noise, draws = jax.random.split(key, 3)
        batch = summarise(jax.random.bernoulli(event, probability, (samples, 1)) / probability)
        reference = summarise(1.0 + 0.01 * jax.random.normal(noise, (REFERENCE[0], 1)))
        test = estimators.bias_test(batch, reference, draws, num_draws=DRAWS)
        plain = jnp.abs(batch.mean - 1.0)[0] > 1.96 * batch.standard_error[0]
        return {
            "rejects": test.p_value <= 0.05,
            "believable": test.effective_samples >= ENOUGH_EFFECTIVE,
            "plain": plain,
        }

    found = _map(one, jax.random.split(jax.random.key(1), count))
    return [f"{expected:g}", str(samples), _share(float(np.mean(found["plain"]))), *_verdicts(found)]


def dimension_row(params: int, bias: float, uncertainty: float, samples: int = 400, count: int = 300) -> list[str]:
    """Return a row on relative error and cosine with noise of an eighth of the gradient's norm."""
    gradient, others = jnp.eye(1, params)[0], 600
    offset = bias * jnp.roll(gradient, 1)

    def one(key: Array) -> estimators.Comparison:
        batch_key, reference_key = jax.random.split(key)
        noise = 0.125 * (samples / params) ** 0.5 * jax.random.normal(batch_key, (samples, params))
        reference = uncertainty * (others / params) ** 0.5 * jax.random.normal(reference_key, (others, params))
        return estimators.compare(summarise(gradient + offset + noise), summarise(gradient + reference))

    found = _map(one, jax.random.split(jax.random.key(2), count))
    row = [str(params), f"{uncertainty:g}", f"{bias:g}"]
    for field, exact in (
        ("relative_error", bias),
        ("debiased_error", bias),
        ("cosine", (1 + bias**2) ** -0.5),
        ("debiased_cosine", (1 + bias**2) ** -0.5),
    ):
        value, error = getattr(found, field), getattr(found, f"{field}_se")
        held = np.mean(np.abs(value - exact) <= 1.96 * error)
        row += [f"{np.mean(value):.3f} ± {np.mean(error):.3f}", _share(float(held))]
    return row


WEIGHED: Final = ("ivw", "ivw_h", "total_propagation", "ddcg")


def weights_rows(sizes: Mapping[int, int]) -> list[list[str]]:
    """Return rows on bias and variance with either kind of weights, on a linear-quadratic problem.

    Args:
        sizes: number of batches by the number of samples of each.
    """
    columns = [weights_columns(samples, count) for samples, count in sizes.items()]
    names = [row[:2] for row in columns[0]]
    return [
        [*name, *(", ".join(cells) for cells in zip(*(rows[index][2:] for rows in columns), strict=True))]
        for index, name in enumerate(names)
    ]


def weights_columns(samples: int, count: int) -> list[list[str]]:
    """Return problem, estimator, bias with plug-in and cross-fitted weights [%], and the ratio of variances."""
    weight = np.array([[1.0, 0.2], [0.2, 0.5]])
    system = LinearQuadratic(
        np.array([[0.9, 0.3], [-0.2, 0.8]]), np.array([[0.5, 0.1], [-0.3, 0.7]]), weight, np.diag([0.3, 0.2]), weight
    )
    problems = {
        "feedback": (ReferenceObjective(system, (1.0, -0.5), 3, 0.4, "feedback"), np.array([0.4, 0.1, 0.2, 0.5])),
        "open loop": (ReferenceObjective(system, (1.0, -0.5), 3, 0.4), np.full(6, -0.2)),
    }
    rows = []
    for problem, (objective, theta) in problems.items():
        needed = estimators.oracles_of(ESTIMATORS[name] for name in WEIGHED)
        drawn = estimators.draw(needed, objective, jnp.asarray(theta), jax.random.key(3), samples * count)
        many = jax.random.split(jax.random.key(4), 400_000)
        exact = np.mean(np.asarray(objective.differentiate(jnp.asarray(theta), many).gradient), axis=0)
        drawn = jax.tree.map(lambda leaf: jnp.asarray(leaf).reshape(count, samples, *leaf.shape[1:]), drawn)
        for name in WEIGHED:
            batches = {oracle: drawn[oracle] for oracle in ESTIMATORS[name].needs}
            row, errors = [problem, name], []
            for weights in estimators.WEIGHTS:
                estimator = make_estimator(name, sigma=objective.sigma, weights=weights)
                program = jax.jit(jax.vmap(lambda batch, estimator=estimator: estimator(batch).mean))
                means = np.asarray(program(batches))
                bias = np.linalg.norm(np.mean(means, axis=0) - exact) / np.linalg.norm(exact)
                errors.append(np.sum(np.var(means, axis=0)))
                row.append(f"{100 * bias:.1f}")
            rows.append([*row, f"{errors[1] / errors[0]:.2f}"])
    return rows


def _share(value: float) -> str:
    return f"{value:.3f}" if 0 < value < 0.1 else f"{value:.2f}"


def tables() -> dict[str, str]:
    """Return every table of the page by its name."""
    both = [coverage_rows(name, samples) for name in KINDS for samples in SAMPLES]
    test = ["rejects at 5 %", "believable", "rejects of those"]
    wide = ["relative error", "covers", "debiased", "covers", "cosine", "covers", "debiased", "covers"]
    return {
        "intervals": markdown_table([row for row, _ in both], ["samples of", "n", *COLUMNS.values()]),
        "test": markdown_table([row for _, row in both], ["samples of", "n", *test]),
        "rare": markdown_table(
            [rare_row(expected, n) for expected, n in ((0.1, 50), (0.4, 50), (1, 50), (3.2, 400), (8, 400), (20, 400))],
            ["rare samples expected", "n", "z test", *test],
        ),
        "dimensions": markdown_table(
            [dimension_row(*case) for case in ((5, 0.3, 0.02), (200, 0.3, 0.02), (200, 0.3, 0.1), (200, 0.0, 0.02))],
            ["parameters", "reference ±", "true error", *wide],
        ),
        "weights": markdown_table(
            weights_rows({10: 20_000, 40: 5000}),
            ["problem", "estimator", "bias [%], plug-in", "cross-fitted", "variance, cross-fitted / plug-in"],
        ),
    }


def main() -> None:
    configure()
    write_tables(PAGE, tables())


if __name__ == "__main__":
    main()
