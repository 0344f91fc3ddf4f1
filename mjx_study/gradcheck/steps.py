"""Check the steps of one contact model: all comparisons at each state, their findings, and a row of the table."""

import dataclasses
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mjx_study.gradcheck import diagnosis
from mjx_study.gradcheck.causes import ROUNDING_DECIDES, SINGULAR, FindingContext, faults, kinks
from mjx_study.gradcheck.coordinates import Coordinates
from mjx_study.gradcheck.coverage import Coverage
from mjx_study.gradcheck.diagnosis import ENGINE, JUMP, NAN, RIGHT, UNRESOLVED, VERDICTS, Codes, judge, worst_error
from mjx_study.gradcheck.differences import (
    SHAKE,
    Differences,
    moves,
    solution_noise,
    take_differences,
    unseen_moves,
    unsteady_outputs,
)
from mjx_study.gradcheck.engine_step import EngineStep
from mjx_study.gradcheck.programs import ContactCase, Programs
from mjx_study.gradcheck.report import Entry, Finding, StepCheck
from mjx_study.gradcheck.states import Sample
from mjx_study.gradcheck.values import Values, change, compare_values
from mjx_study.simulation.contact import apply_contact, has_mujoco_law
from mjx_study.simulation.engine import HostState
from mjx_study.table import grouped
from mjx_study.tasks.contact_grid import ContactPoint

STOCK: Final = "mjx.step"
SHAKES: Final = 8  # number of steps with geoms moved by `SHAKE`
MOST_SLOPE: Final = 1e6  # change of a step over `SHAKE` beyond which rounding decides; h k / m of a contact is below
MARGIN: Final = 10.0  # by which the jump between other programs may exceed the largest of `SHAKES`
_Kind = tuple[str, str, tuple[str, ...], str]
"""Owner of the derivative, verdict, modes and cause, which the entries of a finding have in common."""


@dataclasses.dataclass(frozen=True, eq=False)
class StateCheck:
    """All results at one state.

    Attributes:
        derivatives, judged: derivatives by mode (forward, reverse, tape or mjx.step), and verdicts on them.
        truth, engine_truth: finite differences of this project's step, and of the C engine's.
        modes: difference between reverse and forward mode where no jump excuses it.
        values: comparison with `mjx.step` and the C engine; None for contact laws other than MuJoCo's, which they lack.
        engine: verdicts on the forward-mode derivative by `engine_truth`; None if the two steps differ.
    """

    sample: Sample
    residual: float
    derivatives: dict[str, np.ndarray]
    truth: Differences
    judged: dict[str, Codes]
    modes: float
    values: Values | None
    engine_truth: Differences | None
    engine: Codes | None
    context: FindingContext

    def entry(self, name: str, derivative: float, difference: float | None = None, gap: float | None = None) -> Entry:
        time = self.sample.index * self.context.layout.scene.timestep
        return Entry(self.sample.label, self.sample.index, time, name, derivative, difference, gap)

    def of(self, who: str) -> dict[str, Codes]:
        """Verdicts on the derivatives of the project or of `mjx.step`."""
        return {mode: codes for mode, codes in self.judged.items() if (mode == STOCK) == (who == STOCK)}


def check_state(
    programs: Programs, engine_step: EngineStep, case: ContactCase, sample: Sample, *, stock: bool = False
) -> StateCheck:
    """Run all comparisons of a step and its derivatives; with `stock`, differentiate `mjx.step` too."""
    layout = programs.layout
    linear = programs.linear(case, sample.state)
    reference = jnp.asarray(linear.qpos)
    ladder = moves(np.eye(len(layout.inputs)))
    qacc = programs.exact(case, sample.state, reference, ladder[:1]).after.warmstart
    solved = dataclasses.replace(sample.state, warmstart=qacc)
    unseen = unseen_moves(len(layout.inputs))
    exact = programs.exact(case, solved, reference, np.concatenate([ladder, unseen]))
    outputs, around = np.split(exact.outputs, [len(ladder)])
    noise = solution_noise(layout, exact.stages, qacc)
    unsteady = unsteady_outputs(outputs[0], around, linear.forward, noise)
    truth = take_differences(outputs, noise).jumping(unsteady > 0)
    values = engine_truth = None
    if has_mujoco_law(case.contact):
        engine_truth = take_differences(
            engine_step.outputs(solved, linear.qpos, ladder), engine_step.noise(solved, linear.qpos)
        )
        stock_step = programs.stock_step(case, solved)
        compared = partial(compare_values, layout, engine_step, solved, exact.after, stock_step, exact.stages, noise)
        values = compared(unsteady)
        if values.verdict == "value":
            unsteady = np.maximum(unsteady, jumps_of_stock(programs, case, solved, stock_step))
            values = compared(unsteady)

    model = apply_contact(layout.scene.model, case.contact)
    solref, solimp = np.asarray(model.geom_solref), np.asarray(model.geom_solimp)
    context = FindingContext(layout, sample.state, exact.stages, qacc, solref, solimp, unsteady)
    degenerate = np.array(
        [
            [any(contact.concerns(output, source) for contact in context.degenerate) for source in layout.inputs]
            for output in layout.outputs
        ]
    )
    derivatives = {"forward": linear.forward, "reverse": linear.reverse}
    derivatives |= {} if linear.tape is None else {"tape": linear.tape}
    excused = (degenerate | (unsteady > 0)[:, None]) & truth.rough
    others = list(derivatives.values())[1:]
    apart = max(diagnosis.modes_apart(layout, linear.forward, other, excused) for other in others)
    converged = None if linear.residual <= 1e-10 else programs.linear(case, solved).forward
    starved = not linear.residual <= diagnosis.RESIDUAL_TOLERANCE
    judged = {
        mode: judge(layout, jacobian, truth, converged, starved=starved, degenerate=degenerate)
        for mode, jacobian in derivatives.items()
    }
    agrees = values is not None and values.agrees_with_engine
    engine = judge(layout, linear.forward, engine_truth) if agrees and engine_truth else None
    if engine is not None:
        judged = {mode: diagnosis.resolved_by(codes, engine) for mode, codes in judged.items()}
    if stock:
        derivatives[STOCK] = programs.stock(case, sample.state)
        judged[STOCK] = judge(layout, derivatives[STOCK], truth, degenerate=degenerate)
    return StateCheck(sample, linear.residual, derivatives, truth, judged, apart, values, engine_truth, engine, context)


def jumps_of_stock(
    programs: Programs, case: ContactCase, state: HostState, after: HostState
) -> Float[np.ndarray, " outputs"]:
    """How far the step of `mjx.step` to `after` jumps where rounding decides, which symmetry may hide from moves of the
    state; 0 if it does not."""
    host = programs.layout.scene.host
    shaken = [programs.stock_step(case, state, SHAKE) for _ in range(SHAKES)]
    jumps = np.max([np.abs(change(host, after, each)) for each in shaken], axis=0)
    return MARGIN * jumps if jumps.max() > MOST_SLOPE * SHAKE else np.zeros(len(jumps))


def step_check(
    cell: ContactPoint, layout: Coordinates, checks: Sequence[StateCheck], found: Sequence[Finding], coverage: Coverage
) -> StepCheck:
    def worst(who: str, *blocks: str) -> float:
        return max(
            worst_error(layout, check.derivatives[mode], check.truth, codes, layout.columns(*blocks))
            for check in checks
            for mode, codes in check.of(who).items()
        )

    blocks = layout.blocks()
    engine = [
        worst_error(layout, check.derivatives["forward"], check.engine_truth, check.engine, range(len(layout.inputs)))
        for check in checks
        if check.engine is not None and check.engine_truth is not None
    ]
    values = [check.values for check in checks if check.values is not None]
    stock = None
    if STOCK in checks[0].judged:
        nan = any((check.judged[STOCK] == NAN).any() for check in checks)
        stock = float("inf") if nan else worst(STOCK, *blocks)
    return StepCheck(
        contact=cell.family,
        stiffness=cell.stiffness_or_zero,
        states=len(checks),
        entries=len(checks) * len(layout.inputs) * len(layout.outputs),
        unresolved=sum(int(np.sum(_worst_codes(check.of("project")) == UNRESOLVED)) for check in checks),
        modes=max(check.modes for check in checks),
        differences=worst("project", *(block for block in blocks if block != "contact")),
        parameters=worst("project", "contact") if len(layout.scales) else None,
        stock_step=max((each.stock for each in values), default=None),
        engine_step=max((each.engine for each in values), default=None),
        engine=max(engine, default=None),
        stock=stock,
        residual=max(check.residual for check in checks),
        coverage=coverage,
        verdict=diagnosis.worst_verdict([f.verdict for f in found if f.who == "project" and f.verdict in VERDICTS]),
    )


def collect(cell: ContactPoint, layout: Coordinates, checks: Sequence[StateCheck]) -> list[Finding]:
    """Group the findings for one contact model."""
    found = [each for check in checks for part in (_of_entries, _of_engine, _of_state) for each in part(check, layout)]
    alike = grouped(found, lambda each: each[0])
    return [Finding(cell.label, *kind, tuple(entry for _, entry in entries)) for kind, entries in alike.items()]


def _worst_codes(judged: dict[str, Codes]) -> Codes:
    return np.max(list(judged.values()), axis=0)


def _of_entries(check: StateCheck, layout: Coordinates) -> Iterator[tuple[_Kind, Entry]]:
    for who in ("project", STOCK) if STOCK in check.judged else ("project",):
        judged = check.of(who)
        worst = _worst_codes(judged)
        for row, column in np.argwhere((worst != RIGHT) & (worst != UNRESOLVED)).tolist():
            verdict = VERDICTS[worst[row, column]]
            smooth = verdict not in ("kink", "jump")
            if who == STOCK and not smooth:
                continue  # inherited from the step, so already attributed to the project
            output, source = layout.outputs[row], layout.inputs[column]
            if not smooth:
                cause = next(kinks(check.context, output, source))
            elif verdict == "unconverged":
                cause = _budget(layout)
            else:
                cause = next(faults(check.context, output, source, who == STOCK))
            modes = tuple(mode for mode, codes in judged.items() if codes[row, column] == worst[row, column])
            derivative, difference, gap = (
                float(values[row, column])
                for values in (check.derivatives[modes[0]], check.truth.value, check.truth.gap)
            )
            entry = check.entry(f"d {output} / d {source}", derivative, difference, None if smooth else gap)
            yield (who, verdict, modes, cause), entry


def _of_engine(check: StateCheck, layout: Coordinates) -> Iterator[tuple[_Kind, Entry]]:
    """Findings where the C engine's step has the same value but another derivative."""
    if check.engine is None or check.engine_truth is None:
        return
    apart = diagnosis.disagreements(check.judged["forward"], check.truth, check.engine, check.engine_truth)
    kind = ("project", VERDICTS[ENGINE], (), "the derivative is that of this step, but the C engine's step has another")
    for row, column in np.argwhere(apart).tolist():
        ours, theirs = (float(each[row, column]) for each in (check.derivatives["forward"], check.engine_truth.value))
        yield kind, check.entry(f"d {layout.outputs[row]} / d {layout.inputs[column]}", ours, theirs)


def _of_state(check: StateCheck, layout: Coordinates) -> Iterator[tuple[_Kind, Entry]]:
    values, unsteady = check.values, check.context.unsteady
    if unsteady.any() and not any((codes == JUMP).any() for codes in check.of("project").values()):
        yield ("project", VERDICTS[JUMP], (), ROUNDING_DECIDES), check.entry("", float(unsteady.max()))
    if not check.residual <= diagnosis.RESIDUAL_TOLERANCE:
        cause = f"residual {check.residual:.1e}; {_budget(layout)}"
        yield ("project", "unconverged", (), cause), check.entry("", check.residual)
    if not check.modes <= diagnosis.MODES_TOLERANCE:
        text = f"the two modes of differentiation disagree by {check.modes:.1e}"
        cause = f"{text}: {SINGULAR}" if check.context.singular else text
        yield ("project", "wrong", (), cause), check.entry("", check.modes)
    if values is not None and values.verdict:
        who = STOCK if values.verdict == "value" and values.agrees_with_engine else "project"
        entry = check.entry(f"change of {layout.outputs[values.coordinate]}", *values.numbers)
        yield (who, values.verdict, (), values.cause), entry


def _budget(layout: Coordinates) -> str:
    option = layout.scene.host.opt
    return (
        f"the solver stopped early, with iterations={option.iterations} and ls_iterations={option.ls_iterations}; "
        "give more with --solver-iterations and --solver-ls-iterations"
    )
