"""One page about a model: where contact begins, whether derivatives and means are right, and which estimator to take.

Every statement is measured here and comes with the command that measures it again. The error of an estimator after a
second of computing is sqrt(bias^2 + variance x seconds per sample), relative to the gradient: the bias is what the
estimator's mean misses of the mean cost's slope along a path (`estimators.circulation`), where something is seen.
"""

import dataclasses
import math
import textwrap
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from estimators import ORACLES, Circulation, Estimator, make_estimator, oracles_of, variance_interval
from estimators.mean_check import NODES
from mjx_study.choices import is_file
from mjx_study.compiled import Compiled
from mjx_study.gradcheck import GradcheckPlan, GradcheckReport, gradcheck, plan_gradcheck, plan_scene_gradcheck
from mjx_study.gradcheck.mean import MEANS, along_means, reach_of, unmixed
from mjx_study.objective import MjxObjective, Simulator, chunk_for, simulate
from mjx_study.runtime import environment, precision
from mjx_study.simulation.contact import ContactModel, stable, stiffness_from_solref
from mjx_study.simulation.engine import engine_model
from mjx_study.study.configuration import Progress
from mjx_study.study.dataset import as_plain
from mjx_study.study.findings import NARROW, NOTABLE, SHARE_OFF, STRONG, linear_error
from mjx_study.study.memory import check_memory
from mjx_study.study.sampling import cell_keys, draw_batches, unconverged
from mjx_study.study.tally import onset_numbers
from mjx_study.study.variables import ONSETS
from mjx_study.table import format_table
from mjx_study.tasks.contact_grid import ContactPoint, contact_grid
from mjx_study.tasks.task import Task

ESTIMATORS: Final = ("zobg", "fobg", "aobg", "fobg_onset", "aobg_onset")
STATES: Final = 2
"""Of the gradient check."""
SAMPLES: Final = 500
"""Of each batch, where time allows."""
LEAST: Final = 20
"""Fewest samples, however long they take."""
FEW: Final = 100
"""Samples below which the page says so."""
BUDGET: Final = 60.0
"""Time for all batches, compilation apart [s]."""
CHUNK: Final = 16
"""Fewest samples in a call of a program."""
ACCURATE: Final = 0.1
"""Relative error that a number of samples is given for."""
SMOOTH: Final = 0.01
"""Share of the approach speed lost in the first step below which force sets in without a jump."""
WIDTHS: Final = 3.0
"""Steps' travel over which an impedance should rise."""
LEGEND: Final = (
    "  zobg: zeroth order; fobg: first order; aobg: both, weighted; _onset: with a term for contact that begins"
)
SHOWN: Final = 6
"""Contacts in the text, the least resolved first."""


@dataclasses.dataclass(frozen=True)
class Touch:
    """A contact that begins in the rollout without noise, and how its step resolves it.

    Attributes:
        speed: of approach [m/s]; not positive for one that begins without.
        damping: h b, at full impedance.
        stiffness: h^2 k, at full impedance.
        travel: h v over the width of the impedance's rise.
        impedance: d_0, at first touch; 0.9 is MuJoCo's default.
        jump: h b d_0 / d_width, the share of the approach speed that the damper takes in the first step.
        stable: whether the step in contact is.
    """

    pair: str
    time: float
    speed: float
    damping: float
    stiffness: float
    travel: float
    impedance: float
    jump: float
    stable: bool


@dataclasses.dataclass(frozen=True)
class Measured:
    """An estimator on one batch.

    Attributes:
        variance, lower, upper: of one sample, with its 95 % interval [gradient^2].
        seconds: computing time of a sample [s].
        paths: checks of its mean along them; none of zeroth order, which has no bias.
        verdict: of its mean: unbiased by theory, or right, biased or undecided by the check.
        bias: what the mean misses along the paths, beyond one standard error [gradient].
        norm: of the mean, without what noise adds to it [gradient].
        lost: samples that are not finite and were left out.
    """

    estimator: str
    variance: float
    lower: float
    upper: float
    seconds: float
    paths: tuple[Circulation, ...]
    verdict: str
    bias: float
    norm: float
    lost: int

    def error(self, norm: float, variance: float | None = None) -> float:
        """Error after a second of computing, relative to a gradient of this norm."""
        spread = (self.variance if variance is None else variance) * self.seconds
        return math.hypot(self.bias, math.sqrt(spread)) / norm if norm > 0 else math.inf


@dataclasses.dataclass(frozen=True)
class Measurement:
    """The estimators under one contact model.

    Attributes:
        onsets: `mjx_study.study.variables.ONSETS` of the first-order batch.
        unconverged: rollouts in which the solver did not converge.
        estimators: best first.
    """

    samples: int
    onsets: dict[str, float]
    unconverged: int
    estimators: tuple[Measured, ...]

    @property
    def lost(self) -> int:
        """Samples that are not finite, of the batch with the most."""
        return max(each.lost for each in self.estimators)

    @property
    def surest(self) -> Measured:
        """The estimator of least variance of those without a bias that is seen."""
        return min((each for each in self.estimators if each.verdict != "biased"), key=lambda each: each.variance)

    @property
    def norm(self) -> float:
        """Norm of the gradient; its standard error where that is larger."""
        return max(self.surest.norm, self._uncertainty)

    @property
    def _uncertainty(self) -> float:
        return math.sqrt(self.surest.variance / self.samples)

    @property
    def _too_small(self) -> bool:
        """Whether the gradient cannot be told from 0."""
        return self.surest.norm < 2 * self._uncertainty

    @property
    def best(self) -> Measured:
        """The estimator of least error after a second of computing."""
        return self.estimators[0]

    @property
    def samples_needed(self) -> float:
        """By the best, for a relative error of `ACCURATE`."""
        return self.best.variance / (ACCURATE * self.norm) ** 2


@dataclasses.dataclass(frozen=True)
class Diagnosis(Measurement):
    """Everything that was measured; `lines` is the page.

    Attributes:
        subject: as it was named.
        task: what was studied.
        contact: label of the contact model.
        touches: contacts that begin without noise.
        derivatives: the gradient check.
        warnings: about the contact model.
        options: contact options, as a command has them.
    """

    subject: str
    task: Task
    contact: str
    touches: tuple[Touch, ...]
    derivatives: GradcheckReport
    warnings: tuple[str, ...]
    options: str

    def as_json(self) -> dict[str, Any]:
        shown = [
            {
                "estimator": each.estimator,
                "variance": each.variance,
                "seconds_per_sample": each.seconds,
                "mean": each.verdict,
                "bias": each.bias / self.norm,
                "error_after_a_second": each.error(self.norm),
            }
            for each in self.estimators
        ]
        document = {
            "subject": self.subject,
            "cost": self.task.description,
            "contact": self.contact,
            "samples": self.samples,
            "touches": [dataclasses.asdict(each) for each in self.touches],
            **self.onsets,
            "nonfinite": self.lost,
            "unconverged": self.unconverged,
            "derivatives": "right" if self.derivatives.passed else "wrong",
            "unexercised": self.derivatives.unexercised,
            "estimators": shown,
            "best": self.best.estimator,
            "gradient_norm": self.norm,
            "samples_needed": self.samples_needed,
            "warnings": [*self.warnings, *self._cautions()],
            "advice": [text for text, _ in self._advice()],
            "environment": environment(),
        }
        return as_plain(document)

    def lines(self) -> list[str]:
        task, command = self.task, f"mjx-study {{}} {self.subject}{self.options}"
        lines = [f"{self.subject}: {task.description or task.name}", f"contact {self.contact}, {self.samples} samples"]
        lines += [f"warning: {text}" for text in (*self.warnings, *self._cautions())]
        lines += ["", "contact", *self._contact_lines()]
        state = "every derivative that exists is right" if self.derivatives.passed else "A DERIVATIVE IS WRONG"
        missing = ", where it was exercised" if self.derivatives.passed and self.derivatives.unexercised else ""
        lines += ["", "derivatives of a step", f"  {state}{missing}", f"  > {command.format('gradcheck')}"]
        batch = f"--estimators {','.join(each.estimator for each in self.estimators)} --samples {self.samples}"
        lines += ["", "estimators, by their relative error after a second of computing", *self._estimator_lines()]
        lines += [f"  > {command.format('gradcheck')} --mean --direction {MEANS} {batch}"]
        lines += [f"  > {command.format('compare')} {batch}"]
        lines += ["", "advice"]
        for text, flags in self._advice():
            lines += textwrap.wrap(text, 100, initial_indent="  ", subsequent_indent="    ")
            lines += [f"  > {command.format('compare')} {flags}"] if flags else []
        return lines

    def _contact_lines(self) -> list[str]:
        found = self.onsets.get("onsets", 0)
        lines = [f"  contacts that begin in a rollout with noise: {found / self.samples:.2g}"]
        if found:
            lines[0] += (
                f"; the first at a step that varies by {self.onsets['onset_spread']:.2g} steps, "
                f"each takes {self.onsets['onset_strength']:.0%} of the approach speed in one step"
            )
        if not self.touches:
            return [*lines, "  none in the rollout without noise"]
        worst = sorted(self.touches, key=lambda each: (each.stable, -each.jump, -each.travel))
        header = ["  without noise", "t [s]", "v [m/s]", "h b", "h^2 k", "h v / width", "impedance", "step"]
        rows = [
            [
                f"  {each.pair}",
                f"{each.time:.3g}",
                *(f"{number:.2g}" for number in (each.speed, each.damping, each.stiffness, each.travel)),
                f"{each.impedance:g}",
                "stable" if each.stable else "UNSTABLE",
            ]
            for each in worst[:SHOWN]
        ]
        more = len(worst) - len(rows)
        return [*lines, *format_table(rows, header), *([f"  and {more} more"] if more else [])]

    def _estimator_lines(self) -> list[str]:
        rows = []
        for each in self.estimators:
            ends = (each.error(self.norm, end) for end in (each.lower, each.upper))
            rows.append(
                [
                    f"  {each.estimator}",
                    f"{each.error(self.norm):.2%}",
                    " to ".join(f"{end:.2%}" for end in ends),
                    f"off by {each.bias / self.norm:.1%}" if each.verdict == "biased" else each.verdict,
                    f"{1e3 * each.seconds:.3g}",
                ]
            )
        return [*format_table(rows, ["  estimator", "error", "95 % interval", "mean", "ms a sample"]), LEGEND]

    def _cautions(self) -> Iterator[str]:
        """What makes numbers on the page mean less."""
        if self.lost:
            yield f"{self.lost} samples are not finite and were left out"
        if self.unconverged:
            yield f"{self.unconverged} rollouts in which the contact solver did not converge"
        if unstable := [each for each in self.touches if not each.stable]:
            yield f"the step in contact is unstable: {unstable[0].pair}, h^2 k = {unstable[0].stiffness:.2g}"
        if self._too_small:
            yield (
                f"the gradient is too small to be told from 0 with {self.samples} samples: errors are relative to "
                f"{self.norm:.2g}"
            )
        if self.samples < FEW:
            yield f"{self.samples} samples are few: --samples {SAMPLES} takes longer and says more"
        if undecided := [each.estimator for each in self.estimators if each.verdict == "undecided"]:
            yield f"the mean of {', '.join(undecided)} could not be judged with {self.samples} samples"
        if not self.derivatives.passed:
            yield "a derivative is wrong: no first-order estimate is to be trusted"

    def _advice(self) -> Iterator[tuple[str, str]]:
        """What to do, each with options of `compare` that show it."""
        by_name, timestep = {each.estimator: each for each in self.estimators}, self.task.scene.timestep
        needed = _round(self.samples_needed)
        if self._too_small:
            yield (
                f"no estimator can be advised: no gradient shows in {self.samples} samples, take more or another theta",
                "",
            )
        else:
            yield f"take {self.best.estimator}; a relative error of {ACCURATE:.0%} needs {needed} samples", ""
        if not self.onsets.get("onsets"):
            yield "no contact begins: longer rollouts, more noise or another start would say more", ""
            return
        plain, corrected = by_name["fobg"], by_name["fobg_onset"]
        if plain.verdict == "biased":
            smooth = self.touches and all(each.jump <= SMOOTH for each in self.touches)
            text = f"plain first order is biased by {plain.bias / self.norm:.0%}, " + (
                "though force sets in without a jump: something else jumps, such as where corners and edges touch"
                if smooth
                else "for contact sets in with a jump"
            )
            if corrected.verdict == "right":
                text += ": the onset term corrects that"
            if travel := max((each.speed * timestep for each in self.touches if each.jump > SMOOTH), default=0.0):
                text += f'; an impedance that rises from 0, solimp="0 0.95 {WIDTHS * travel:.1g}", has no jump'
            yield text, "--onset linear" if corrected.verdict == "right" else ""
        if corrected.verdict == "right":
            return
        spread, strength = self.onsets["onset_spread"], self.onsets["onset_strength"]
        explained = SHARE_OFF * strength * (plain.bias + corrected.bias)
        if spread < NARROW:
            finer = f"a timestep of {timestep * spread / NARROW:.1g} s, or " if spread > 0 else ""
            yield f"the noise is too narrow for onset terms: take {finer}more noise", ""
        elif corrected.bias > explained and strength <= STRONG:
            yield (
                f"the onset term leaves a bias of {corrected.bias / self.norm:.0%}, which its own error does not "
                "explain: corners that turn, edges and contacts that end under load have no term",
                "",
            )
        elif SHARE_OFF * strength > NOTABLE:
            step = timestep * NOTABLE / (SHARE_OFF * strength)
            yield (
                f"{linear_error(strength)}: a timestep of {step:.1g} s brings that down to {NOTABLE:.0%}; the jump is "
                "exact but for the square of the step",
                "--onset jump",
            )


def diagnose(
    subject: str,
    task: Task,
    family: str | None = None,
    stiffness: float | None = None,
    *,
    damping: float | None = None,
    samples: int | None = None,
    seed: int = 0,
    options: str = "",
    progress: Progress = lambda done, total, what: None,
) -> Diagnosis:
    """Measure everything under one contact model.

    Args:
        subject: as the user named it; of a file the gradient check takes single steps alone.
        family: contact family; None for the task's main one.
        stiffness: of the contact [N/m]; None for the task's middle one.
        damping: of the contact [N s/m]; None for the family's.
        samples: of each batch, and at each node of the path along which means are checked; None for `SAMPLES`, or as
            many as `BUDGET` has room for.
        options: contact options, as a command has them.
        progress: called before each part.

    Raises:
        ValueError: there is no such contact model, or the batches do not fit in memory.
    """
    family, stiffness = family or task.defaults.main_family, stiffness or task.defaults.middle_stiffness
    (cell,), warnings = contact_grid(task, [family], [stiffness], damping)
    check_memory(task, _estimators(task), samples or SAMPLES)
    total = 4
    progress(0, total, "rollout without noise")
    touches = _touches(task, cell)
    progress(1, total, "derivatives of steps")
    derivatives = gradcheck(_plan(subject, task, family, stiffness, damping, seed))
    progress(2, total, "estimators")
    found = measure(Simulator(task, chunk_size=_chunk(task, samples or SAMPLES)), cell.contact, samples, seed)
    progress(total, total, "done")
    return Diagnosis(
        **vars(found),
        subject=subject,
        task=task,
        contact=cell.label,
        touches=tuple(touches),
        derivatives=derivatives,
        warnings=tuple(warnings),
        options=options,
    )


def _estimators(task: Task) -> list[Estimator]:
    return [make_estimator(name, gamma=task.defaults.gamma, sigma=task.sigma) for name in ESTIMATORS]


def _chunk(task: Task, samples: int) -> int:
    """Samples in a call of a program: on a CPU fewer of larger models, so that the first call takes seconds."""
    devices = jax.local_devices()
    most = max(CHUNK, CHUNK * (CHUNK // task.scene.host.nv) ** 2) if devices[0].platform == "cpu" else samples + 1
    return min(chunk_for(samples, devices, [task]), most)


def measure(
    simulator: Simulator, contact: ContactModel | None, samples: int | None = None, seed: int = 0
) -> Measurement:
    """The estimators at the task's theta, without the contacts and the derivatives of a step.

    Args:
        simulator: what it has compiled serves every contact model.
        contact: the contact model; None for the MJCF's own.
        samples: see `diagnose`.
        seed: of all randomness.
    """
    task = simulator.task
    chosen = _estimators(task)
    oracles, objective, keys = oracles_of(chosen, "evaluation"), simulator.objective(contact), cell_keys(seed, 1)

    def drawn(count: int):
        return draw_batches(objective, task.theta, keys, oracles, count, slice(1))

    full = simulator.chunk_size - 1  # and a baseline: one call of a program
    drawn(1)  # compiles
    if samples is None:
        rate = sum(drawn(full)[1].values()) / full
        samples = int(np.clip(BUDGET / rate / (NODES + 1), LEAST, SAMPLES))
    batches, seconds, residuals = drawn(samples)
    batches = jax.tree.map(lambda leaf: leaf[0], batches)
    found = _measure(chosen, objective, batches, seconds, samples, seed)
    events = np.asarray(batches["corrected"].events).reshape(-1, len(ONSETS))
    onsets = dict(zip(ONSETS, onset_numbers(events).tolist(), strict=True))
    unsolved = max(unconverged(each, precision()) for each in residuals.values())
    unordered = Measurement(samples, onsets, unsolved, tuple(found))
    order = sorted(found, key=lambda each: each.error(unordered.norm))
    return dataclasses.replace(unordered, estimators=tuple(order))


def _plan(subject: str, task: Task, family: str, stiffness: float, damping: float | None, seed: int) -> GradcheckPlan:
    common = {"seed": seed, "damping": damping, "states": STATES}
    if is_file(subject):
        return plan_scene_gradcheck(task.scene, [family], None, horizon=task.horizon, **common)
    return plan_gradcheck(task, [family], [stiffness], **common)


def _measure(
    chosen: Sequence[Estimator],
    objective: MjxObjective,
    batches: Any,
    seconds: dict[str, float],
    samples: int,
    seed: int,
) -> list[Measured]:
    """The estimators on their batches, and their means along the paths of `along_means`."""
    task, estimates = objective.simulator.task, [estimator(batches) for estimator in chosen]
    reach = reach_of(task)
    first = [each for each in chosen if any(ORACLES[oracle].order for oracle in each.needs)]
    found = along_means(first, objective, task.theta, reach, unmixed(chosen, batches), samples, seed)
    checks: dict[Estimator, tuple[Circulation, ...]] = dict(zip(first, zip(*found, strict=True), strict=True))
    measured = []
    for estimator, estimate in zip(chosen, estimates, strict=True):
        lower, upper = variance_interval(estimate, 0.95)
        squared = float(jnp.sum(estimate.mean**2)) - float(estimate.variance) / samples
        paths = checks.get(estimator, ())
        verdicts = {each.verdict() for each in paths}
        missed = sum(max(0.0, float(each.gap**2 - each.standard_error**2)) for each in paths)
        measured.append(
            Measured(
                estimator=estimator.name,
                variance=float(estimate.variance),
                lower=float(lower),
                upper=float(upper),
                seconds=sum(seconds[oracle] for oracle in estimator.needs) / samples,
                paths=paths,
                verdict=next((each for each in ("biased", "undecided", "right") if each in verdicts), "unbiased"),
                bias=math.sqrt(missed) / (2 * reach),
                norm=math.sqrt(max(squared, 0.0)),
                lost=int(estimate.num_nonfinite),
            )
        )
    return measured


def _touches(task: Task, cell: ContactPoint) -> Iterator[Touch]:
    """Contacts that begin in the rollout without noise, in the C engine."""
    dtype = task.theta.dtype
    run = Compiled(partial(simulate, task), "rollout", task)
    states, *_ = run(task.theta, cell.contact, jax.random.key(0), jnp.zeros((), dtype))
    host = engine_model(task.scene, cell.contact)
    data, timestep, before = mujoco.MjData(host), task.scene.timestep, None
    for index, (qpos, qvel) in enumerate(zip(np.asarray(states.qpos), np.asarray(states.qvel), strict=True)):
        if not (np.isfinite(qpos).all() and np.isfinite(qvel).all()):
            return
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(host, data)
        now = {tuple(contact.geom): contact for contact in data.contact if contact.dist < contact.includemargin}
        for pair in now.keys() - (now.keys() if before is None else before):
            yield touch_of(host, data, now[pair], index * timestep, timestep)
        before = now.keys()


def touch_of(host: mujoco.MjModel, data: mujoco.MjData, contact: Any, time: float, timestep: float) -> Touch:
    """A contact of the engine's data, which has just begun."""
    solref = np.array(contact.solref)
    if solref[0] > 0 and not host.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE:
        solref[0] = max(solref[0], 2 * timestep)
    k, b = stiffness_from_solref(solref.tolist(), effective_mass=1.0)
    first, edges = contact.efc_address, 2 * (contact.dim - 1)
    pyramid = contact.dim > 1 and host.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    speed = (
        -float(np.mean(data.efc_vel[first : first + edges] if pyramid else data.efc_vel[first])) if first >= 0 else 0.0
    )
    names = (mujoco.mj_id2name(host, mujoco.mjtObj.mjOBJ_GEOM, geom) or f"geom {geom}" for geom in contact.geom)
    return Touch(
        pair=" and ".join(names),
        time=time,
        speed=speed,
        damping=timestep * b,
        stiffness=timestep**2 * k,
        travel=timestep * speed / float(contact.solimp[2]),
        impedance=float(contact.solimp[0]),
        jump=timestep * b * float(contact.solimp[0] / contact.solimp[1]),
        stable=stable(solref.tolist(), timestep),
    )


def _round(number: float) -> str:
    """Two significant digits, upwards, with separators."""
    if not math.isfinite(number):
        return "more than can be told"
    digits = max(0, math.floor(math.log10(max(number, 1.0))) - 1)
    return f"{math.ceil(number / 10**digits) * 10**digits:,}"
