"""Group the findings for one contact model, and summarise them in a table row."""

from collections.abc import Sequence

import numpy as np

from mjx_study.gradcheck import diagnosis
from mjx_study.gradcheck.causes import SINGULAR, cause_of_fault, cause_of_kink
from mjx_study.gradcheck.coordinates import Coordinates
from mjx_study.gradcheck.coverage import Coverage
from mjx_study.gradcheck.diagnosis import ENGINE, NAN, RIGHT, UNRESOLVED, VERDICTS, worst_error, worst_verdict
from mjx_study.gradcheck.finding import Entry, Finding
from mjx_study.gradcheck.report import StepCheck
from mjx_study.gradcheck.state_check import STOCK, StateCheck
from mjx_study.tasks.contact_grid import ContactPoint

_Key = tuple[str, str, tuple[str, ...], str]
"""Owner of the derivative, verdict, modes, cause."""


def collect(cell: ContactPoint, layout: Coordinates, checks: Sequence[StateCheck]) -> list[Finding]:
    groups: dict[_Key, list[Entry]] = {}
    for check in checks:
        for key, entry in [*_of_entries(check, layout), *_of_engine(check, layout), *_of_state(check, layout)]:
            groups.setdefault(key, []).append(entry)
    return [Finding(cell.label, *key, tuple(entries)) for key, entries in groups.items()]


def step_check(
    cell: ContactPoint, layout: Coordinates, checks: Sequence[StateCheck], found: Sequence[Finding], coverage: Coverage
) -> StepCheck:

    def worst(modes: Sequence[str], blocks: Sequence[str]) -> float:
        columns = layout.columns(*blocks)
        figures = [
            worst_error(layout, check.derivatives[mode], check.truth, check.judged[mode], columns)
            for check in checks
            for mode in modes
            if mode in check.derivatives and columns
        ]
        return max(figures, default=0.0)

    state_blocks = [block for block in layout.blocks() if block != "contact"]
    everywhere = range(len(layout.inputs))
    own = ("forward", "reverse", "tape")
    engine = [
        worst_error(layout, check.linear.forward, check.engine_truth, check.engine, everywhere)
        for check in checks
        if check.engine is not None
    ]
    stock = None
    if STOCK in checks[0].judged:
        nan = any((check.judged[STOCK].codes == NAN).any() for check in checks)
        stock = float("inf") if nan else worst([STOCK], layout.blocks())
    unresolved = sum(int(np.sum(_codes(check, _own_modes(check)) == UNRESOLVED)) for check in checks)
    return StepCheck(
        contact=cell.family,
        stiffness=cell.stiffness,
        states=len(checks),
        entries=len(checks) * len(layout.inputs) * len(layout.outputs),
        unresolved=unresolved,
        modes=max(check.modes for check in checks),
        differences=worst(own, state_blocks),
        parameters=worst(own, ["contact"]) if len(layout.scales) else None,
        stock_step=max(check.values.stock for check in checks),
        engine_step=max(check.values.engine for check in checks),
        engine=max(engine, default=None),
        stock=stock,
        residual=max(check.linear.residual for check in checks),
        coverage=coverage,
        verdict=worst_verdict([f.verdict for f in found if f.who == "project" and f.verdict in VERDICTS]),
    )


def _own_modes(check: StateCheck) -> list[str]:
    return [mode for mode in check.judged if mode != STOCK]


def _codes(check: StateCheck, modes: Sequence[str]) -> np.ndarray:
    return np.max([check.judged[mode].codes for mode in modes], axis=0)


def _of_entries(check: StateCheck, layout: Coordinates) -> list[tuple[_Key, Entry]]:
    found: list[tuple[_Key, Entry]] = []
    for who, modes in (("project", _own_modes(check)), (STOCK, [STOCK] if STOCK in check.judged else [])):
        if not modes:
            continue
        worst = _codes(check, modes)
        for row, column in np.argwhere((worst != RIGHT) & (worst != UNRESOLVED)).tolist():
            verdict = VERDICTS[worst[row, column]]
            smooth = verdict not in ("kink", "jump")
            if who == STOCK and not smooth:
                continue  # inherited from the step, so already attributed to the project
            shown = tuple(mode for mode in modes if check.judged[mode].codes[row, column] == worst[row, column])
            output, source = layout.outputs[row], layout.inputs[column]
            if not smooth:
                cause = cause_of_kink(check.place, output, source)
            elif verdict == "unconverged":
                cause = _budget(layout)
            else:
                cause = cause_of_fault(check.place, output, source, stock=who == STOCK)
            numbers = (check.derivatives[shown[0]][row, column], check.truth.value[row, column])
            gap = None if smooth else float(check.truth.gap[row, column])
            found.append(
                ((who, verdict, shown, cause), _entry(check, layout, f"d {output} / d {source}", numbers, gap))
            )
    return found


def _of_engine(check: StateCheck, layout: Coordinates) -> list[tuple[_Key, Entry]]:
    """Findings where the C engine's step has the same value but a different derivative."""
    if check.engine is None:
        return []
    apart = diagnosis.disagreements(check.judged["forward"], check.truth, check.engine, check.engine_truth)
    key = ("project", VERDICTS[ENGINE], (), "the derivative is that of this step, and the C engine's has another")
    return [
        (
            key,
            _entry(
                check,
                layout,
                f"d {layout.outputs[row]} / d {layout.inputs[column]}",
                (check.linear.forward[row, column], check.engine_truth.value[row, column]),
            ),
        )
        for row, column in np.argwhere(apart).tolist()
    ]


def _of_state(check: StateCheck, layout: Coordinates) -> list[tuple[_Key, Entry]]:
    found: list[tuple[_Key, Entry]] = []
    residual, values = check.linear.residual, check.values
    if not residual <= diagnosis.RESIDUAL_TOLERANCE:
        cause = f"residual {residual:.1e}; {_budget(layout)}"
        found.append((("project", "unconverged", (), cause), _entry(check, layout, "", (residual, None))))
    if not check.modes <= diagnosis.MODES_TOLERANCE:
        text = f"the two modes of differentiation disagree by {check.modes:.1e}"
        cause = f"{text}: {SINGULAR}" if check.place.singular else text
        found.append((("project", "wrong", (), cause), _entry(check, layout, "", (check.modes, None))))
    if values.verdict:
        name = f"change of {layout.outputs[values.coordinate]}"
        who = STOCK if values.verdict == "value" and values.agrees_with_engine else "project"
        found.append(((who, values.verdict, (), values.cause), _entry(check, layout, name, values.numbers)))
    return found


def _entry(
    check: StateCheck, layout: Coordinates, name: str, numbers: tuple[float, float | None], gap: float | None = None
) -> Entry:
    sample = check.sample
    derivative, difference = numbers
    return Entry(
        sample.label,
        sample.index,
        sample.index * layout.scene.timestep,
        name,
        float(derivative),
        None if difference is None else float(difference),
        gap,
    )


def _budget(layout: Coordinates) -> str:
    option = layout.scene.host.opt
    return (
        f"the solver stopped early, with iterations={option.iterations} and ls_iterations={option.ls_iterations}; "
        "give more with --iterations and --ls-iterations"
    )
