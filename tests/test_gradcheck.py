"""The gradient check passes what is right and finds what is wrong."""

import json

import jax.numpy as jnp
import pytest

from mjx_study import cli, dynamics, gradcheck
from mjx_study.tasks import make_task


@pytest.fixture(autouse=True)
def configured(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests' own settings stand: JAX takes its devices once per process."""
    monkeypatch.setattr(cli, "configure", lambda **_: None)


def test_the_pusher_is_right(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["gradcheck", "pusher", "--horizon", "12", "--stiffness", "100"]
    assert cli.main([*arguments, "--contact", "penalty,mujoco_default", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["passed"] is True
    penalty, default = document["findings"]
    assert penalty["verdict"] == default["verdict"] == "right"
    assert penalty["closed_form"] < 1e-3 and default["closed_form"] is None
    for finding in (penalty, default):
        assert finding["forward"] < 1e-10 and finding["difference"] < 1e-6 and finding["engine"] < 1e-5


def test_a_wrong_derivative_is_found(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    right = dynamics.step_jacobian

    def slightly_wrong(*arguments):
        over_step, over_qacc = right(*arguments)
        return over_step * (1 + 1e-4), over_qacc

    monkeypatch.setattr(dynamics, "step_jacobian", slightly_wrong)
    arguments = ["gradcheck", "pusher", "--horizon", "6", "--stiffness", "100", "--contact", "penalty"]
    assert cli.main(arguments) == 1
    printed = capsys.readouterr().out
    assert "wrong" in printed and "SOMETHING IS WRONG" in printed


def test_a_kink_is_told_from_a_wrong_derivative() -> None:
    """Without a first push the bodies rest exactly at the onset of contact, where a difference straddles it."""
    task = make_task("pusher", horizon=6)
    task = task.replace(theta=task.theta.at[0].set(0.0))
    report = gradcheck.gradcheck(gradcheck.plan_gradcheck(task, ["mujoco"], [100.0], seed=0))
    (finding,) = report.findings
    assert finding.verdict == "kink" and finding.one_sided > gradcheck.DIFFERENCE_TOLERANCE
    assert report.passed
    assert any(line.startswith("kink:") for line in report.lines())


@pytest.mark.parametrize(
    ("figures", "verdict"),
    [
        ((0.0, 0.0, 0.0, 0.0, 0.0, 1e-3), "unconverged"),
        ((0.0, 0.0, 0.0, 0.0, 0.0, float("nan")), "unconverged"),
        ((0.0, 0.0, 0.0, 0.0, 0.0, 0.0), "right"),
        ((1e-8, 0.0, 0.0, 0.0, 0.0, 0.0), "wrong"),
        ((0.0, 1e-3, 0.0, 0.0, 0.0, 0.0), "wrong"),
        ((0.0, 1e-3, 1e-2, 0.0, 0.0, 0.0), "kink"),
        ((0.0, 1e-3, 1e-2, 1e-2, 0.0, 0.0), "wrong"),
        ((0.0, 0.0, 0.0, None, None, 0.0), "right"),
        ((0.0, 0.0, 0.0, None, 1e-2, 0.0), "wrong"),
        ((float("nan"), 0.0, 0.0, None, None, 0.0), "wrong"),
    ],
)
def test_verdicts(figures: tuple[float, ...], verdict: str) -> None:
    assert gradcheck._verdict(*figures) == verdict


def test_plans_refuse_what_cannot_be_checked() -> None:
    task = make_task("pusher", horizon=3)
    with pytest.raises(ValueError, match="needs a fixed start"):
        gradcheck.plan_gradcheck(task.replace(start=lambda key: task.start), ["penalty"], [10.0], seed=0)
    single = task.replace(theta=task.theta.astype(jnp.float32))
    with pytest.raises(ValueError, match="needs float64"):
        gradcheck.plan_gradcheck(single, ["penalty"], [10.0], seed=0)
    with pytest.raises(ValueError, match="no contact model"):
        gradcheck.plan_gradcheck(task, [], [10.0], seed=0)
