"""All comparisons at one state."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from mjx_study.gradcheck import diagnosis
from mjx_study.gradcheck.causes import Place
from mjx_study.gradcheck.diagnosis import Judged, judge, modes_apart
from mjx_study.gradcheck.differences import Differences, differences, moves
from mjx_study.gradcheck.engine_step import EngineStep
from mjx_study.gradcheck.programs import Linear, Programs, Setting
from mjx_study.gradcheck.rounding import solution_noise
from mjx_study.gradcheck.states import Sample
from mjx_study.gradcheck.values import Values, compare_values
from mjx_study.simulation.contact import apply_contact

STOCK = "mjx.step"


@dataclasses.dataclass(frozen=True, eq=False)
class StateCheck:
    """All results at one state.

    Attributes:
        derivatives: derivatives by mode: forward, reverse, tape, or mjx.step.
        truth: finite differences of this project's step.
        judged: verdicts on the derivatives.
        modes: difference between reverse and forward mode where no jump excuses it.
        values: comparison of the step with `mjx.step` and the C engine.
        engine_truth: finite differences of the C engine's step.
        engine: verdicts on the forward-mode derivative by `engine_truth`; None if the two steps differ.
    """

    sample: Sample
    linear: Linear
    derivatives: dict[str, np.ndarray]
    truth: Differences
    judged: dict[str, Judged]
    modes: float
    values: Values
    engine_truth: Differences
    engine: Judged | None
    place: Place


def check_state(
    programs: Programs, engine_step: EngineStep, setting: Setting, sample: Sample, *, stock: bool = False
) -> StateCheck:
    """Run all comparisons of a step and its derivatives.

    Args:
        setting: the contact model and the units of its parameters.
        stock: whether to differentiate `mjx.step` too.
    """
    layout = programs.layout
    linear = programs.linear(setting, sample.state)
    reference = jnp.asarray(linear.qpos)
    ladder = moves(np.eye(len(layout.inputs)))
    qacc = programs.exact(setting, sample.state, reference, ladder[:1]).after.warmstart
    solved = dataclasses.replace(sample.state, warmstart=qacc)
    exact = programs.exact(setting, solved, reference, ladder)
    noise = solution_noise(layout, exact.stages, qacc)
    truth = differences(exact.outputs, noise)
    engine_outputs = engine_step.outputs(solved, linear.qpos, ladder)
    engine_truth = differences(engine_outputs, engine_step.noise(solved, linear.qpos))
    values = compare_values(
        layout, engine_step, solved, exact.after, programs.stock_step(setting, solved), exact.stages, noise
    )

    model = apply_contact(layout.scene.model, setting.contact)
    place = Place(
        layout, sample.state, exact.stages, qacc, np.asarray(model.geom_solref), np.asarray(model.geom_solimp)
    )
    degenerate = np.array(
        [
            [any(each.concerns(output, source) for each in place.degenerate) for source in layout.inputs]
            for output in layout.outputs
        ]
    )
    derivatives = {"forward": linear.forward, "reverse": linear.reverse}
    derivatives |= {} if linear.tape is None else {"tape": linear.tape}
    excused = degenerate & truth.rough
    apart = [modes_apart(layout, linear.forward, other, excused) for other in list(derivatives.values())[1:]]
    engine = judge(layout, linear.forward, engine_truth) if values.agrees_with_engine else None
    converged = None if linear.residual <= 1e-10 else programs.linear(setting, solved).forward
    starved = not linear.residual <= diagnosis.RESIDUAL_TOLERANCE
    judged = {
        mode: judge(layout, jacobian, truth, converged, starved=starved, degenerate=degenerate)
        for mode, jacobian in derivatives.items()
    }
    if engine is not None:
        judged = {mode: diagnosis.resolved_by(verdicts, engine) for mode, verdicts in judged.items()}
    if stock:
        derivatives[STOCK] = programs.stock(setting, sample.state)
        judged[STOCK] = judge(layout, derivatives[STOCK], truth, degenerate=degenerate)
    return StateCheck(sample, linear, derivatives, truth, judged, max(apart), values, engine_truth, engine, place)
