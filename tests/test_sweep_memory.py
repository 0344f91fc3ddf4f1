"""Memory of a sweep: it is bounded, foreseen, and the numbers do not depend on how seeds are grouped."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from estimators import Differentiation, Evaluation
from mjx_study.experiment import gradients, sampling
from mjx_study.experiment import memory as sweep_memory
from mjx_study.experiment.gradients import seeds_together
from mjx_study.experiment.plan import plan_study
from mjx_study.objective import MjxObjective, Simulator
from mjx_study.options.configuration import StudyConfig
from mjx_study.simulation.contact import ContactModel
from tests.documents import MEASURED, numbers_of
from tests.processes import run_script


class Drawn(MjxObjective):
    """An objective whose samples are drawn, in place of simulated ones."""

    def evaluate(self, theta, keys) -> Evaluation:
        score = jax.vmap(lambda key: jax.random.normal(key, theta.shape))(keys)
        return Evaluation(score.sum(1), score, jnp.zeros(len(keys)), jnp.zeros(len(keys)))

    evaluate_odd = evaluate

    def differentiate(self, theta, keys) -> Differentiation:
        gradient = 1 + jax.vmap(lambda key: jax.random.normal(key, theta.shape))(keys)
        return Differentiation(gradient.sum(1), gradient, jnp.zeros(len(keys)))


class Stub(Simulator):
    """A simulator that compiles nothing."""

    def __post_init__(self) -> None:
        pass

    def objective(self, contact: ContactModel | None, sigma: float | None = None) -> MjxObjective:
        return Drawn(self, contact, self.task.sigma if sigma is None else sigma)


def config(**changes: Any) -> StudyConfig:
    common: dict[str, Any] = {"contact": ("penalty",), "stiffness": (10.0,), "reference_samples": 9, "horizon": 3}
    return StudyConfig(tasks=("pusher",), chunk_size=8, **(common | changes))


def test_numbers_do_not_depend_on_how_seeds_are_grouped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampling, "Simulator", Stub)
    monkeypatch.setattr(gradients.GradientComputation, "_build", lambda *_: None)
    plan = plan_study(config(samples=(8,), seeds=5, estimators=("zobg",)))
    found = []
    for at_once, groups in ((1e9, 5), (1.0, 1), (2.5 * plan.memory_of_seed(plan.cells[0]), 2)):
        monkeypatch.setitem(sweep_memory.AT_ONCE, "cpu", at_once)
        assert seeds_together(plan, plan.cells[0]) == groups
        found.append(numbers_of(plan))
    for other in found[1:]:
        for name, values in found[0].items():
            if name not in MEASURED:
                np.testing.assert_allclose(other[name], values, rtol=1e-12, err_msg=name)


SEVERAL: list[dict[str, Any]] = [{"iterations": 3, "seeds": 50}, {"points": 3, "seeds": 50}]


@pytest.mark.parametrize("kind", [*SEVERAL, {"estimators": ("zobg", "delta")}])
def test_a_plan_that_needs_too_much_memory_is_refused(kind: dict[str, Any]) -> None:
    changes = {} if "estimators" in kind else {"reference_samples": None}
    assert plan_study(config(samples=(100,), **kind, **changes)).memory < sweep_memory.AT_ONCE["cpu"]
    with pytest.raises(ValueError, match="a cell would take about .* GiB of memory, and the limit is 16 GiB"):
        plan_study(config(samples=(100, 10_000_000), **kind, **changes))


@pytest.mark.parametrize("kind", SEVERAL)
def test_what_is_not_tested_for_bias_needs_no_memory_for_that(kind: dict[str, Any]) -> None:
    """16 kB of draws per sample."""
    assert plan_study(config(samples=(1000,), **kind | {"seeds": 1000}, reference_samples=None)).memory < 1e9


def test_a_study_that_could_not_be_opened_again_is_refused() -> None:
    with pytest.raises(ValueError, match="more than 500000000 numbers, which is the limit: use fewer tasks, seeds"):
        plan_study(config(samples=(4,), seeds=100_000, points=10_000, reference_samples=None))


def test_of_gradients_seeds_cost_no_memory() -> None:
    few, many = (plan_study(config(samples=(10_000,), seeds=seeds, horizon=200)).memory for seeds in (2, 2000))
    assert few == many < 1e9


PEAK = """
import ast, resource, sys
from mjx_study import runtime
runtime._KEPT = 128 * 1024  # glibc's own threshold: what it keeps for later calls is not in use
runtime.configure(cpu_devices=1)
from mjx_study.experiment import gradients, sampling
from mjx_study.experiment.plan import plan_study
from tests.documents import numbers_of
from tests.test_sweep_memory import Stub, config

sampling.Simulator, gradients.GradientComputation._build = Stub, lambda *_: None
plan = plan_study(config(**ast.literal_eval(sys.argv[1])))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
numbers_of(plan)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1e6)
"""
GROWING: dict[str, tuple[dict[str, Any], dict[str, Any], dict[str, Any]]] = {
    "seeds": ({"samples": (10_000,), "horizon": 200}, {"seeds": 2}, {"seeds": 8}),
    "samples": ({"block_size": 10_000, "seeds": 1, "horizon": 50}, {"samples": (40_000,)}, {"samples": (160_000,)}),
}
"""By what grows: the rest of the study, a small one and a large one."""


@pytest.mark.slow
@pytest.mark.parametrize("name", GROWING)
def test_memory_does_not_grow(name: str) -> None:
    """With seeds it is what the plan says; with samples in blocks, a fraction of what whole batches would take."""
    common, *sizes = GROWING[name]
    peak = [float(run_script(PEAK, repr(common | size)).stdout) for size in sizes]
    planned = plan_study(config(**(common | sizes[name == "samples"] | {"block_size": None}))).memory / 1e9
    assert peak[1] < 1.15 * peak[0] + 0.01, peak
    assert planned / 2 < peak[1] < 2 * planned if name == "seeds" else peak[1] < planned / 4, (peak, planned)
