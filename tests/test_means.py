"""gradcheck --mean: through MuJoCo's default contact first order is biased, with the onset term it is not."""

import json
from typing import Any

import jax.numpy as jnp
import pytest

from estimators import make_estimator
from mjx_study.cli import main
from mjx_study.diagnose.means import check_mean, term_lines
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import family_grid


def test_estimators_take_their_options(capsys: pytest.CaptureFixture[str]) -> None:
    """A norm that no sample reaches clips none."""
    chosen = ["--estimators", "fobg,fobg_clipped", "--max-norm", "1e9", "--samples", "5", "--json"]
    main(["gradcheck", "tests.carts:walled_cart", "--contact", "penalty", "--stiffness", "10", "--mean", *chosen])
    plain, clipped = json.loads(capsys.readouterr().out)["checks"]
    assert clipped == plain | {"estimator": "fobg_clipped"}


def test_commands_judge_means_with_an_onset_term(capsys: pytest.CaptureFixture[str]) -> None:
    """Of the others `compare` has an error against a reference; a descent is judged where its best seed ends."""

    def printed(command: str, *options: str) -> dict[str, Any]:
        place = ["tests.carts:walled_cart", "--contact", "mujoco_default", "--samples", "40", "--json"]
        main([command, *place, *options])
        return json.loads(capsys.readouterr().out)

    names = "--estimators", "fobg,fobg_onset"
    (judged,) = printed("compare", *names, "--reference-samples", "20")["means"]
    one = "--estimators", "fobg_onset"
    paths = printed("gradcheck", *one, "--mean", "--direction", "means")["checks"]
    largest = max(paths, key=lambda each: abs(each["gap"]))
    assert judged["estimator"] == "fobg_onset" and judged["verdict"] == largest["verdict"]
    assert [judged[name] for name in ("gap", "half_width")] == pytest.approx([largest["gap"], largest["half_width"]])
    assert "means" not in printed("compare", "--estimators", "fobg", "--reference-samples", "20")
    found = printed("optimise", *names, "--iterations", "2", "--learning-rate", "0.1", "--evaluation-samples", "20")
    ((end,),) = [run["theta"] for run in found["runs"] if run["estimator"] == "fobg_onset"]
    (at_end,) = found["means"]
    task = make_task("tests.carts:walled_cart").replace(theta=jnp.asarray(end))
    cells, _ = family_grid(task, ("mujoco_default",))
    common = {"samples": 40, "seed": 0, "direction": "means"}
    (check,) = check_mean(task, cells, [make_estimator("fobg_onset")], **common)
    assert at_end["gap"] == pytest.approx(float(check.circulation.gap), rel=1e-9) and at_end["gap"] != judged["gap"]
    (line,) = term_lines([check])
    assert f"the mean of FoBG (onset) is {check.verdict}" in line and "without a reference" in line
