"""Lines of a report and exit codes of the command, without a computation."""

import dataclasses

import mujoco
import pytest

from mjx_study import cli, gradcheck
from mjx_study.gradcheck import Finding, GradcheckReport, StepCheck
from mjx_study.gradcheck.check import unoffered
from mjx_study.gradcheck.cost import judge_closed_forms
from mjx_study.gradcheck.coverage import count_coverage
from mjx_study.gradcheck.report import CostCheck, Entry

PARTS = frozenset({"contact", "stick", "slide", "separate", "limit"})
STICKING = count_coverage(PARTS, [{"contact", "stick"}, {"contact", "stick", "limit"}, {"separate"}])
WHOLE = count_coverage(PARTS, [{"contact", "stick"}, {"contact", "slide", "limit"}])
STEP = StepCheck(
    contact="penalty", stiffness=100.0, states=3, entries=30, unresolved=7, modes=1e-16, differences=1e-9,
    parameters=1e-8, stock_step=0.0, engine_step=0.0, engine=1e-8, stock=None, residual=1e-16, coverage=WHOLE,
    verdict="right",
)  # fmt: skip


def report(*steps: StepCheck, findings: tuple[Finding, ...] = ()) -> GradcheckReport:
    return GradcheckReport("scene", "2 degrees of freedom", (), steps, findings, (), {})


def test_unexercised_parts_are_a_warning_and_another_exit_code(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    unexercised = dataclasses.replace(STEP, coverage=STICKING)
    failing = dataclasses.replace(unexercised, verdict="value")
    for steps, code in (((STEP,), 0), ((STEP, unexercised), 3), ((STEP, failing), 1)):
        monkeypatch.setattr(gradcheck, "gradcheck", lambda plan, progress, steps=steps: report(*steps))
        assert cli.main(["gradcheck", "pusher", "--horizon", "2", "--stiffness", "100"]) == code
    capsys.readouterr()
    lines = report(unexercised).lines()
    assert "of 3 states, contact in 2 (stick 2, slide 0, separate 1); limit in 1" in lines
    assert any(line.startswith("warning: penalty, K = 100 N/m: no state exercises slide") for line in lines)
    assert lines[-1] == "every derivative that exists is right, where it was checked"
    assert report(unexercised).as_json()["unexercised"] == {"penalty, K = 100 N/m": ["slide"]}


def test_unreachable_parts_are_reported_and_not_missing() -> None:
    step = dataclasses.replace(
        STEP, coverage=count_coverage(PARTS - {"slide"}, [{"contact", "stick", "limit"}], {"slide": 2})
    )
    lines = report(step).lines()
    assert (
        "of 1 state, contact in 1 (stick 1, separate 0); limit in 1; slide out of reach of all 2 pairs of geoms"
        in lines
    )
    assert lines[-1] == "every derivative that exists is right" and not report(step).unexercised
    (told,) = report(step).as_json()["steps"]
    assert told["coverage"]["unreachable"] == {"slide": 2}


def test_a_finding_names_the_source_of_the_other_number() -> None:
    sources = {"value": "mjx.step", "engine": "the C engine", "engine_mismatch": "the C engine", "wrong": "differences"}
    for verdict, source in sources.items():
        finding = Finding("penalty", "project", verdict, (), "a reason", (Entry("start", 0, 0.0, "qvel[x]", 1.0, 2.0),))
        assert f"qvel[x] = 1, {source} 2" in finding.line()
        assert report(STEP, findings=(finding,)).passed == (not finding.fails) == (verdict == "engine_mismatch")


def test_features_without_a_derivative_are_named() -> None:
    xml = """<mujoco><worldbody><body mocap="true"/><body><joint name="x"/><geom size=".1"/></body></worldbody>
    <sensor><jointpos joint="x"/><jointvel joint="x"/></sensor></mujoco>"""
    sensors, mocap = unoffered(mujoco.MjModel.from_xml_string(xml))
    assert sensors.startswith("2 sensors: ") and mocap.startswith("1 mocap pose: ")
    assert all("without a derivative" in note for note in (sensors, mocap))


def closed_form(stiffness: float, distance: float) -> CostCheck:
    return CostCheck("penalty", float(stiffness), 1.0, 0.0, 0.0, 0.0, distance, 0.0, "right")


def test_a_closed_form_is_a_judge() -> None:
    """It may be another model, but stiffness must not lead away from it."""
    assert judge_closed_forms([closed_form(10, 1e-6), closed_form(1000, 1e-8)]) == []
    (soft,) = judge_closed_forms([closed_form(10, 0.7), closed_form(1000, 1e-6)])
    assert soft.verdict == "apart" and not soft.fails and soft.contact == "penalty, K = 10 N/m"
    _, stiff = judge_closed_forms([closed_form(1000, 0.7), closed_form(10, 0.1)])
    assert stiff.fails and "farther than at 10 N/m" in stiff.cause
    (both,) = judge_closed_forms([closed_form(10, 1e-6), closed_form(1000, 0.5)])
    assert both.fails
    told = report(STEP, findings=(both,))
    assert not told.passed and not any("that of the step" in line for line in told.lines())
    assert told.lines()[-1] == f"NOT RIGHT: {both.cause}"
