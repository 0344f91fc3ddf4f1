"""Compiled programs of a cell: rollouts, gradients with and without the onset term, and their statistics."""

import dataclasses
import math
import time
from collections.abc import Sequence
from functools import cached_property
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from estimators import Antithetic, Evaluation, effective_samples, squared_bias_of_means, variance_interval, zeroth_order
from estimators.noise import batch_noise, noise_score
from estimators.statistics import summarise
from experiments.atlas.design import COLUMNS, Cell, contact_of
from mjx_study.compiled import Compiled
from mjx_study.diagnose.setting import touch_of
from mjx_study.experiment.reference_gradient import estimate_reference
from mjx_study.experiment.resolution import direction_of
from mjx_study.experiment.tally import onset_numbers, unconverged
from mjx_study.objective import SamplePrograms, rollout_cost, spread
from mjx_study.results.variables import ONSETS
from mjx_study.runtime import local_devices
from mjx_study.simulation.contact import ContactModel, stable
from mjx_study.simulation.dynamics import State
from mjx_study.simulation.engine import engine_model
from mjx_study.simulation.law import Law
from mjx_study.simulation.onset import as_row
from mjx_study.tasks.contact_grid import family_grid
from mjx_study.tasks.task import Task

SAMPLES: Final = 64  # first-order samples of a cell, and pairs of rollouts for zeroth order and the reference
BATCHES: Final = 8  # number of batches for the squared bias
CHUNK: Final = 256
SEED: Final = 0
ESTIMATORS: Final = ("zobg", "fobg", "fobg_onset")


class Programs:
    """The two compiled programs of a task: rollouts, and gradients with and without the onset term.

    Under a law other than MuJoCo's there is no such term, so that gradients are those without; whether bodies meet is
    known from `usual`, the programs of MuJoCo's law.
    """

    def __init__(self, task: Task, law: Law | None = None, usual: "Programs | None" = None):
        self.task, self.direction, self.law, self.usual = task, direction_along(task), law, usual or self
        programs = SamplePrograms(task)
        value, gradient = programs.by_name["value"], programs.by_name["gradient"]

        def plain(*given):
            cost, slope, residual, _ = gradient(*given)
            return cost, slope[None], residual, ()

        def gradients(theta, contact, sigma, key, scale):
            start, noise = programs.draw(sigma, key, scale)

            def cost(theta, weight):
                value, (_, _, residual, counts) = rollout_cost(task, theta, contact, start, noise, "linear", weight)
                return value, (residual, as_row(counts))

            slopes = jax.vmap(jax.value_and_grad(cost, has_aux=True), (None, 0))
            (values, (residuals, counts)), both = slopes(theta, jnp.array([0.0, 1.0], theta.dtype))
            return values[0], both, residuals[0], counts[0]

        def of_rows(program):
            def run(along, solref, solimp, sigma, key, scale):
                return program(along * self.direction, ContactModel(solref, solimp, law=law), sigma, key, scale)

            return Compiled(jax.vmap(run))

        self._warm: set[str] = set()
        self._programs = {"value": of_rows(value), "gradients": of_rows(plain if law else gradients)}

    def run(self, name: str, settings: Sequence[np.ndarray], keys: np.ndarray, scale: np.ndarray) -> tuple[Any, float]:
        """Return outputs `(cells, rows, ...)`, and seconds per row (NaN for a call that compiles).

        Args:
            settings: t, solref, solimp and sigma of every cell.
            keys: key data (cells, rows, 2).
            scale: factor on the noise of each row.
        """
        cells, rows = keys.shape[:2]
        flat = [np.repeat(each, rows, axis=0) for each in settings]
        flat += [keys.reshape(cells * rows, -1), np.tile(scale, cells)]
        begun = time.perf_counter()
        found = spread(self._programs[name], (), flat, CHUNK, local_devices())
        seconds = (time.perf_counter() - begun) / (cells * rows) if name in self._warm else math.nan
        self._warm.add(name)
        return jax.tree.map(lambda leaf: leaf.reshape(cells, rows, *leaf.shape[1:]), found), seconds

    @cached_property
    def control(self) -> Any:
        """Control without noise as a function of t, the step and the state."""
        policy = self.task.policy
        noise = jnp.zeros(policy.noise_shape)

        def law(along, step, state):
            theta = along * self.direction
            feedback = policy.feedback(theta, state)
            return policy.feedforward(theta, noise)[step] + (0.0 if feedback is None else feedback)

        return jax.jit(law)


def direction_along(task: Task) -> jax.Array:
    """Return the direction of theta: the same force at every step, or random feedback gains."""
    if task.policy.additive:
        return jnp.ones(task.policy.num_params)
    return jnp.asarray(direction_of("random", task.policy.num_params, SEED))


def first_touch(programs: Programs, cell: Cell, contact: ContactModel, key: jax.Array) -> dict[str, float]:
    """Return whether bodies touch at the start, and the speed at which the first contact begins, without noise."""
    task = programs.task
    policy, host = task.policy, engine_model(task.scene, contact)
    theta, still = cell.theta * programs.direction, jnp.zeros(policy.noise_shape)
    data, start = mujoco.MjData(host), policy.place(theta, still, task.draw_start(key))
    data.qpos[:], data.qvel[:] = start.qpos, start.qvel
    forces = np.asarray(policy.feedforward(theta, still))
    at_start, before, speed = False, None, math.nan
    for step in range(task.horizon):
        mujoco.mj_step1(host, data)
        now = {tuple(each.geom): each for each in data.contact if each.dist < each.includemargin}
        if before is None:
            at_start, before = bool(now), now.keys()
        if begun := now.keys() - before:
            speed = touch_of(host, data, now[begun.pop()], data.time, task.scene.timestep).speed
            break
        if not policy.additive:
            state = State(jnp.asarray(data.qpos), jnp.asarray(data.qvel), jnp.asarray(data.act), start.warmstart)
            data.ctrl[:] = programs.control(cell.theta, step, state)
        else:
            data.ctrl[:] = forces[step]
        before = now.keys()
        mujoco.mj_step2(host, data)
    return {"at_start": at_start, "speed": speed}


@jax.jit
def _statistics(plus: Evaluation, minus: Evaluation, pilot: Evaluation | None, gradients, sigma):
    """Return the statistics of one cell.

    The slope along a direction d is compared, since that is where a descent step goes. With one parameter d is 1.
    Otherwise it is the direction of the median first-order gradient of one half of the samples, along which the other
    half and the reference are projected; both halves take their turn.

    Args:
        plus, minus: evaluations with opposite noise.
        pilot: evaluation of the first-order samples; None for a feedback policy, whose reference averages pairs.
        gradients: (samples, 1 or 2, params), without and with the onset term.
    """
    zeroth = zeroth_order(plus, "zero_noise")
    plain, *corrected = (summarise(gradients[:, which]) for which in range(gradients.shape[1]))
    kept = jnp.where(jnp.isfinite(plain.per_sample).all(axis=1)[:, None], plain.per_sample, jnp.nan)
    if pilot is None:
        reference = Antithetic().combine((plus, minus))
    else:
        odd = dataclasses.replace(plus, value=(plus.value - minus.value) / 2, baseline=jnp.zeros_like(plus.value))
        reference = estimate_reference(odd, pilot, [jnp.nanmedian(kept, axis=0)], sigma)
    half = len(kept) // 2
    parts = slice(half), slice(half, None)
    medians = [jnp.nanmedian(kept[part], axis=0) for part in parts]
    if kept.shape[1] == 1:
        medians = [jnp.ones(1)] * 2
    across = [median / jnp.linalg.norm(median) for median in medians]
    mean = (across[0] + across[1]) / 2
    along = reference.per_sample @ mean
    found = {"slope": jnp.mean(along), "slope_se": jnp.std(along, ddof=1) / jnp.sqrt(len(along))}
    found |= {"norm": jnp.linalg.norm(reference.mean)}
    found |= {"norm_se": jnp.linalg.norm(reference.standard_error)}
    for name, estimate in zip(ESTIMATORS, (zeroth, plain, *corrected), strict=False):
        lower, upper = variance_interval(estimate, 0.95)
        found |= {f"{name}_variance": estimate.variance, f"{name}_lower": lower, f"{name}_upper": upper}
        found |= {f"{name}_effective": effective_samples(estimate).count}
        found |= {f"{name}_lost": len(estimate.per_sample) - estimate.num_finite}
        if name == "zobg":
            continue
        others = [
            summarise((estimate.per_sample[part] @ each)[:, None])
            for part, each in zip(parts, across[::-1], strict=True)
        ]
        found |= {f"{name}_bias": (others[0].mean[0] + others[1].mean[0]) / 2 - found["slope"]}
        found |= {f"{name}_bias_se": jnp.sqrt(sum(each.standard_error[0] ** 2 for each in others) / 4)}
        means = jnp.mean(estimate.per_sample.reshape(BATCHES, -1, kept.shape[1]), axis=1)
        found |= dict(
            zip((f"{name}_square", f"{name}_square_se"), squared_bias_of_means(means, reference), strict=True)
        )
    return found


def measure(programs: Programs, cells: Sequence[Cell]) -> dict[str, np.ndarray]:
    """Return all columns of some cells of one task and timestep."""
    task, additive = programs.task, programs.task.policy.additive
    contacts = [contact_of(task, cell) for cell in cells]
    sigmas = np.array([cell.sigma for cell in cells])

    def settings_of(contacts: Sequence[ContactModel]) -> list[np.ndarray]:
        stacked = (np.stack([np.asarray(getattr(each, name)) for each in contacts]) for name in ("solref", "solimp"))
        return [np.array([cell.theta for cell in cells]), *stacked, sigmas]

    settings = settings_of(contacts)
    root = jax.random.key(SEED)
    pairs, firsts = zip(*(jax.random.split(jax.random.fold_in(root, cell.index)) for cell in cells), strict=True)
    pairs, firsts = (
        np.stack([jax.random.key_data(jax.random.split(key, SAMPLES)) for key in each]) for each in (pairs, firsts)
    )
    still = pairs if task.random_start else pairs[:, :1]
    scale = np.repeat([1.0, -1.0, 0.0], [SAMPLES, SAMPLES, still.shape[1]])
    (values, scores, residuals), value_seconds = programs.run(
        "value", settings, np.concatenate([pairs, pairs, still], axis=1), scale
    )
    (gained, gradients, more, events), seconds = programs.run("gradients", settings, firsts, np.ones(SAMPLES))
    if programs.law is not None:
        (default,), _ = family_grid(task, ["mujoco_default"])
        assert default.contact is not None
        contacts = [default.contact] * len(cells)
        (*_, events), _ = programs.usual.run("gradients", settings_of(contacts), firsts, np.ones(SAMPLES))
    ends = jnp.split(values, [SAMPLES, 2 * SAMPLES], axis=1)
    baseline = jnp.broadcast_to(ends[2], ends[0].shape)
    plus = Evaluation(ends[0], jnp.asarray(scores[:, :SAMPLES]), baseline)
    minus = Evaluation(ends[1], jnp.asarray(scores[:, SAMPLES : 2 * SAMPLES]), baseline)
    pilot = None
    if additive:
        flat = jax.random.wrap_key_data(jnp.asarray(firsts.reshape(-1, firsts.shape[-1])))
        _, noise = batch_noise(flat, task.policy.noise_shape, task.noise)
        scores = noise_score(noise.reshape(len(cells), SAMPLES, -1), 1.0, task.noise) / sigmas[:, None, None]
        pilot = Evaluation(jnp.asarray(gained), scores, baseline)
    found = jax.device_get(jax.vmap(_statistics)(plus, minus, pilot, gradients, jnp.asarray(sigmas)))
    columns = {name: np.asarray(each, float) for name, each in found.items()}
    onsets = np.stack([onset_numbers(each) for each in events])
    keys = jax.random.wrap_key_data(jnp.asarray(pairs[:, 0]))
    touched = [first_touch(programs, *each) for each in zip(cells, contacts, keys, strict=True)]
    touched = {name: [each[name] for each in touched] for name in touched[0]}
    solved = [unconverged(np.concatenate(each, axis=None), "float64") for each in zip(residuals, more, strict=True)]
    columns |= dict(zip(ONSETS, onsets.T, strict=True)) | touched | {"unconverged": solved}
    _, solref, solimp, _ = settings
    if programs.law is None:
        columns |= {"k": -solref[:, 0], "b": -solref[:, 1], "impedance": solimp[:, 0]}
        columns |= {"stable": [stable(each.tolist(), task.scene.timestep) for each in solref]}
    else:
        k = np.array([cell.stiffness for cell in cells]) / task.effective_mass
        b = 2 * np.array([cell.dampratio for cell in cells]) * np.sqrt(k)
        columns |= {"k": k, "b": b, "impedance": [math.nan] * len(cells), "stable": np.ones(len(cells))}
    columns |= {name: [getattr(cell, name) for cell in cells] for name in ("index", *COLUMNS)}
    columns |= {"value_seconds": [value_seconds] * len(cells), "gradient_seconds": [seconds] * len(cells)}
    return {name: np.asarray(each, float) for name, each in columns.items()}
