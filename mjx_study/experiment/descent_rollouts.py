"""Where descents get their rollouts: from MJX, in programs shared by all contact models, or from an analytic system."""

import math
import threading
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from estimators import Estimator, draw
from estimators.sampling import draw_at, sample_keys
from mjx_study.compiled import Builds, Compiled
from mjx_study.experiment.iteration import (
    Descent,
    Record,
    advance_one,
    if_going,
    make_optimizer,
    optimizer_of,
    schedule_factors,
)
from mjx_study.experiment.memory import padded_seeds
from mjx_study.experiment.study import StudyCell, StudyPlan
from mjx_study.objective import Simulator, TracedObjective, chunk_for, natively, simulate
from mjx_study.reference import ReferenceObjective
from mjx_study.runtime import local_devices
from mjx_study.simulation.contact import ContactModel, soften
from mjx_study.simulation.observation import observed
from mjx_study.tasks.contact_grid import ContactPoint

TOGETHER: Final = 1000
"""Rollouts of an analytic system per batch; more take memory and save little time."""


class Backend:
    """A source of rollouts, and of the iterations, costs and metrics that follow from them."""

    def __init__(self, plan: StudyPlan, cell: StudyCell):
        group, config = plan.groups[cell.group], plan.config
        self.task, self.recipe, self.samples = group.task.replace(sigma=cell.sigma), group.descent, cell.samples
        self.config, self.seeds = config, config.seeds
        self._rates = np.array(self.recipe.learning_rate), np.array(self.recipe.decay)
        self.optimizer = make_optimizer(self.recipe.optimizer, *map(float, self._rates))
        self.simulator = None if cell.model.analytic else Simulator(self.task, chunk_size=plan.chunk_size)
        evaluation = chunk_for(config.settings.evaluation_samples, local_devices(), [self.task])
        chunk = plan.chunk_size if config.chunk_size and not self._in_turn else evaluation
        self._evaluation = self.simulator and Simulator(self.task, chunk_size=chunk)
        self.saving = threading.Lock()
        self.costs: dict[str, tuple[int, float]] = {}  # iterations and last cost by estimator
        iterations = self.recipe.iterations
        self._stiffness = schedule_factors(config.stiffness_schedule, iterations, most=1.0)
        self._sigma = self.task.sigma * schedule_factors(config.sigma_schedule, iterations)
        self._padded = plan.padded_samples(cell)
        self._iterations: dict[Estimator, Callable[..., tuple[Descent, Record]]] = {}

    @property
    def threads(self) -> int:
        """Number of estimators to advance in parallel."""
        return 1 if self.simulator is None else len(self.simulator.devices)

    @property
    def rows(self) -> int:
        """Number of rows of a state: one for each seed, and others that have stopped."""
        return padded_seeds(self.seeds) if self._in_turn else self.seeds

    @property
    def _in_turn(self) -> bool:
        """Whether a program takes seeds in turn, so that it serves any number of them and of samples, up to a size:
        where rollouts are native code, which gains nothing from larger batches."""
        return self.simulator is not None and natively([self.task])

    def place(self, state: Descent, index: int) -> Descent:
        """Put the state of an estimator on its device; on CPUs always the first, see `spread`."""
        if self.simulator is None:
            return state
        device = self.simulator.devices[index % self.threads]
        return jax.device_put(state, self.simulator.devices[0] if device.platform == "cpu" else device)

    def iteration(
        self, estimator: Estimator, model: ContactPoint
    ) -> Callable[[Descent, Key[Array, " seeds"], int], tuple[Descent, Record]]:
        """Return an iteration of all seeds under one contact model, by index; compiled once for all contact models."""
        if (simulator := self.simulator) is not None:
            if estimator not in self._iterations:
                name, in_turn = self.recipe.optimizer, self._in_turn
                size = self._padded if in_turn else self.samples

                def all_seeds(contact, sigma, state: Descent, keys, rates, samples=None):
                    objective = TracedObjective(simulator, contact, sigma, batched=not in_turn, samples=samples)

                    def one_seed(state, key):
                        drawn = draw(estimator.needs, objective, state.theta, key, size)
                        return advance_one(state, drawn, estimator, optimizer_of(name, *rates), samples)

                    if in_turn:
                        return jax.lax.map(lambda each: if_going(one_seed, *each), (state, keys))
                    return jax.vmap(one_seed)(state, keys)

                made_of = "descent", estimator, name, self.task, size, simulator.chunk_size
                self._iterations[estimator] = Compiled(all_seeds, *made_of)
            simulated = self._iterations[estimator]
            return lambda *arguments: simulated(*self._on_device(model, *arguments))

        update = jax.vmap(lambda state, drawn: advance_one(state, drawn, estimator, self.optimizer))
        compiled = self._iterations.setdefault(estimator, jax.jit(update))
        count = max(1, TOGETHER // self.samples)

        def on_host(state: Descent, keys: Key[Array, " seeds"], index: int) -> tuple[Descent, Record]:
            task = self.task.replace(sigma=float(self._sigma[index]))
            reference = task.analytic(model.stiffness_or_zero * float(self._stiffness[index]))
            groups = [slice(first, first + count) for first in range(0, self.seeds, count)]
            theta = jnp.asarray(state.theta)
            parts = [self._together(estimator.needs, reference, theta[some], keys[some]) for some in groups]
            return compiled(state, jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts))

        return on_host

    def build(
        self,
        estimator: Estimator,
        builds: Builds,
        model: ContactPoint,
        state: Descent,
        keys: Key[Array, " seeds"],
        index: int,
    ) -> None:
        """Trace the program of `iteration` for its arguments and begin to compile it, where it is one for all
        devices."""
        program = self._iterations[estimator]
        if isinstance(program, Compiled) and jax.default_backend() == "cpu":
            builds.start(program, *self._on_device(model, state, keys, index))

    def build_evaluation(self, model: ContactPoint, builds: Builds) -> None:
        """Begin to compile the program of `cost`."""
        if self._evaluation is not None:
            self._evaluation.build("value", self.task.theta, model.contact, self.task.sigma, builds)

    def _on_device(self, model: ContactPoint, state: Descent, keys: Key[Array, " seeds"], index: int) -> Any:
        """Arguments of a simulated iteration."""
        factor, contact = self._stiffness[index], model.contact
        contact = contact if contact is None or factor == 1 else soften(contact, factor)
        samples = (np.asarray(self.samples),) if self._in_turn else ()
        return contact, self._sigma[index], state, keys, self._rates, *samples

    def _together(
        self,
        needs: Sequence[str],
        reference: ReferenceObjective,
        theta: Float[Array, "seeds params"],
        keys: Key[Array, " seeds"],
    ) -> dict[str, Any]:
        """Draw the batches of several seeds as one, so that NumPy's loops over steps run once for all."""
        each = jnp.repeat(theta, self.samples, axis=0)
        drawn = draw_at(needs, reference, each, [jnp.ravel(part) for part in self._sample_keys(keys)])
        return jax.tree.map(lambda leaf: leaf.reshape(len(theta), self.samples, *leaf.shape[1:]), drawn)

    @cached_property
    def _sample_keys(self) -> Callable[[Key[Array, " seeds"]], list[Key[Array, "seeds samples"]]]:
        """`sample_keys` over several seeds."""
        return jax.jit(jax.vmap(partial(sample_keys, num_samples=self.samples)))

    def cost(self, theta: Float[Array, " params"], model: ContactPoint) -> tuple[float, float]:
        """Mean cost with noise at theta, over samples with the same noise for every theta, and its standard error."""
        analytic, simulator = self.task.analytic, self._evaluation
        objective = analytic(model.stiffness_or_zero) if simulator is None else simulator.objective(model.contact)
        value = np.asarray(objective.evaluate(theta, self._evaluation_keys()).value)
        value = value[np.isfinite(value)]
        if len(value) < 2:
            return math.nan, math.nan
        return float(np.mean(value)), float(np.std(value, ddof=1) / math.sqrt(len(value)))

    def metrics(self, theta: Float[Array, " params"], model: ContactPoint) -> dict[str, float]:
        """Means of the task's metrics over the rollouts of `cost`, nonfinite values excluded."""
        if self.simulator is None:
            found = self.task.analytic(model.stiffness_or_zero).observe(theta, self._evaluation_keys())
        elif self.task.metrics is None:
            return {}
        else:
            found = jax.device_get(self._observe(theta, model.contact, self._evaluation_keys()))
        finite = {name: (values, np.isfinite(values)) for name, values in sorted(found.items())}
        return {name: float(np.mean(each, where=ok)) if ok.any() else math.nan for name, (each, ok) in finite.items()}

    def _evaluation_keys(self) -> Key[Array, " samples"]:
        key = jax.random.fold_in(jax.random.key(self.config.seed), 2**31 - 1)
        return jax.random.split(key, self.config.settings.evaluation_samples)

    @cached_property
    def _observe(self) -> Compiled:
        """Program for the task's metrics of each sample, as a function of theta, contact and keys."""

        def one(theta: Float[Array, " params"], contact: ContactModel | None, key: Key[Array, ""]) -> dict[str, Array]:
            states, *_ = simulate(self.task, theta, contact, key, 1.0)
            return self.task.metrics(observed(self.task.scene, states, contact))  # type: ignore[misc]

        return Compiled(jax.vmap(one, (None, None, 0)), "metrics", self.task)
