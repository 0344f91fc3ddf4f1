"""diagnose measures what a bouncing ball has in closed form, and its advice is right."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from estimators import Circulation, FirstOrder, ZerothOrder, estimate
from mjx_study import cli
from mjx_study.diagnose.advice import advise
from mjx_study.diagnose.means import along_means
from mjx_study.diagnose.measurement import ESTIMATORS, Measured, Measurement, affordable, chunk_of, more_samples
from mjx_study.diagnose.page import document_of, page_lines
from mjx_study.diagnose.run import Diagnosis, diagnose_task, plan_diagnosis
from mjx_study.diagnose.setting import setting_of, touches_of
from mjx_study.experiment.quadrature import Line, grid, means
from mjx_study.gradcheck import Finding
from mjx_study.objective import Simulator
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import single_contact
from mjx_study.tasks.mjcf import mjcf_task
from tests.estimators import objectives

HELD_OUT = Path(__file__).parents[1] / "experiments" / "data" / "held_out"
GRAVITY, HEIGHT, TIMESTEP = 9.81, 0.05, 0.002
K, B = 3e4, 60.0  # [1/s^2], [1/s]: it bounces
BALL = """<mujoco><option timestep="{h}"/>
  <worldbody><geom name="floor" type="plane" size="1 1 .1"/>
  <body pos="0 0 {z}"><joint type="slide" axis="0 0 1"/>
    <geom name="ball" size=".1" mass="1" condim="1" solref="{k} {b}" solimp="{solimp}" priority="1"/></body>
  </worldbody></mujoco>"""


def ball(folder: Path, solimp: str = "0.9 0.95 0.001 0.5 2") -> str:
    path = folder / "ball.xml"
    path.write_text(BALL.format(h=TIMESTEP, z=0.1 + HEIGHT, k=-K, b=-B, solimp=solimp))
    return str(path)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Diagnosis:
    """The ball, on its way up again."""
    return diagnosed(ball(tmp_path_factory.mktemp("ball")), 65, 500, sigma=0.05)


def diagnosed(name: str, horizon: int, samples: int, options: str = "", **changes: Any) -> Diagnosis:
    plan = plan_diagnosis(name, make_task(name, horizon=horizon).replace(**changes), samples=samples)
    return diagnose_task(name, plan, samples=samples, options=options)


def test_the_contact_in_closed_form(found: Diagnosis) -> None:
    (touch,) = found.touches
    speed = math.sqrt(2 * GRAVITY * HEIGHT)
    assert touch.pair == "floor and ball" and touch.impedance == 0.9 and touch.stable
    assert touch.speed == pytest.approx(speed, abs=GRAVITY * TIMESTEP)
    assert touch.time == pytest.approx(speed / GRAVITY, abs=2 * TIMESTEP)
    assert touch.damping == pytest.approx(TIMESTEP * B) and touch.stiffness == pytest.approx(TIMESTEP**2 * K)
    assert touch.travel == pytest.approx(TIMESTEP * touch.speed / 0.001)
    assert found.onsets["onsets"] == found.samples and found.lost == found.unconverged == 0


def test_the_bias_its_correction_and_the_best_estimator(found: Diagnosis) -> None:
    by_name = {each.estimator: each for each in found.estimators}
    assert by_name["fobg"].verdict == "biased" and by_name["fobg_onset"].verdict == "right"
    assert by_name["zobg"].verdict == "unbiased" and by_name["zobg"].bias == 0
    assert "h^2 k" in "\n".join(page_lines(found))
    assert found.best.estimator in ("fobg_onset", "aobg_onset")
    errors = [each.error(found.norm) for each in found.estimators]
    assert errors == sorted(errors)
    task = found.task
    points = grid(0.0, 0.0, task.sigma, 1000, "gaussian")
    exact = means(points, *Line(task)(points, None), np.zeros(1), task.sigma, "gaussian")
    assert found.norm == pytest.approx(abs(exact.slope[0]), rel=0.05)
    bias = abs(exact.first[0] - exact.slope[0])
    assert by_name["fobg"].bias == pytest.approx(bias, rel=0.3)  # one is over a path, the other at its middle
    assert found.derivatives.passed


@pytest.mark.parametrize("solimp", ["0.9 0.95 0", "0 0 0.001"])
def test_a_contact_of_any_impedance_is_described(solimp: str, tmp_path: Path) -> None:
    """MuJoCo allows a rise without a width, and an impedance of 0, in place of which it uses its least."""
    task = make_task(ball(tmp_path, solimp), horizon=65)
    (touch,) = touches_of(task, single_contact(task)[0])
    assert touch.travel is not None and touch.travel > 0 and math.isfinite(touch.travel + touch.jump)


def advised(found: Diagnosis, **changes: Any) -> list[str]:
    """The texts of the advice where other numbers had been measured."""
    return [text for text, _ in advise(dataclasses.replace(found, **changes))]


def with_estimator(found: Diagnosis, name: str, **changes: Any) -> tuple[Measured, ...]:
    """The estimators, of which one measured otherwise."""
    return tuple(dataclasses.replace(each, **changes) if each.estimator == name else each for each in found.estimators)


def commands_of(found: Diagnosis) -> list[list[str]]:
    return [line.removeprefix("  > mjx-study ").split() for line in page_lines(found) if line.startswith("  > ")]


def test_every_statement_has_a_command_and_the_document_is_complete(found: Diagnosis) -> None:
    """No command is printed twice."""
    commands = commands_of(found)
    assert {command[0] for command in commands} == {"gradcheck", "compare"}
    assert len(set(map(tuple, commands))) == len(commands)
    assert all(cli.parser(command[0]).parse_args(command).task == found.subject for command in commands)
    expected = {"sigma": 0.05, "sigma_unit": "m/s", "added_to": "the initial velocities", "timestep": TIMESTEP}
    expected |= {"horizon": 65, "params": 1, "best": found.best.estimator, "derivatives": "right"}
    assert expected.items() <= document_of(found).items()


def test_steps_are_checked_without_noise(found: Diagnosis) -> None:
    """`gradcheck` takes --sigma and --theta only with --mean."""
    commands = commands_of(dataclasses.replace(found, options=" --sigma 20 --theta 1 --horizon 65"))
    (steps,) = [command for command in commands if "gradcheck" in command and "--mean" not in command]
    assert steps == ["gradcheck", found.subject, "--horizon", "65"]
    assert all({"--sigma", "--theta"} <= {*command} for command in commands if command != steps)


def test_other_parameters_and_what_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Thrown upwards, the ball is in the air until the end, where half the squared displacement has a slope of t x."""
    name, speed, steps, folder = ball(tmp_path), 1.2, 65, tmp_path / "out"
    command = ["diagnose", name, "--horizon", str(steps), "--sigma", "0.01", "--samples", "100"]
    assert cli.main([*command, "--theta", str(speed), "--output", str(folder), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    time = steps * TIMESTEP
    rise = speed * time - GRAVITY * TIMESTEP**2 * steps * (steps + 1) / 2
    assert document["theta"] == str(speed) and document["onsets"] == 0
    assert document["gradient_norm"] == pytest.approx(time * rise, rel=0.01)
    assert json.loads((folder / "diagnosis.json").read_text()) == document
    assert f"65 steps of 0.002 s, at theta {speed:g}" in (folder / "diagnosis.txt").read_text()
    assert cli.main(["gradcheck", name, "--theta", "1"]) == 2 and cli.main([*command, "--theta", "1,2"]) == 2


@pytest.mark.slow
def test_the_advised_impedance_avoids_the_bias(found: Diagnosis, tmp_path: Path) -> None:
    (text,) = (text for text in advised(found) if "solimp" in text)
    name = ball(tmp_path, text.partition('solimp="')[2].partition('"')[0])
    smooth = diagnosed(name, 65, 500, sigma=0.05)
    assert {each.estimator: each.verdict for each in smooth.estimators}["fobg"] == "right"
    assert not [text for text in advised(smooth) if "biased" in text]


@pytest.mark.slow
@pytest.mark.parametrize("model", ["cart", "pendulum", "peg"])
def test_the_commands_on_the_page_repeat_it(model: str, capsys: pytest.CaptureFixture[str]) -> None:
    name, horizon = str(HELD_OUT / f"{model}.xml"), 60
    found = diagnosed(name, horizon, 60, f" --horizon {horizon}")
    commands = commands_of(found)
    steps, means = (command for command in commands if command[0] == "gradcheck")
    batches = next(command for command in commands if command[0] == "compare" and "zobg" in "".join(command))

    def document(command: list[str]) -> tuple[int, Any]:
        code = cli.main([*command, "--json"])
        return code, json.loads(capsys.readouterr().out)

    assert (document(steps)[0] != 1) == found.derivatives.passed
    measured = {each.estimator: each for each in found.estimators}
    gaps: dict[str, list[float]] = {each: [] for each in measured}
    for check in document(means)[1]["checks"]:
        gaps[check["estimator"]].append(check["gap"])
    for each in found.estimators:
        if each.paths:
            assert gaps[each.estimator] == pytest.approx([float(path.gap) for path in each.paths], rel=1e-6, abs=1e-12)
    rows = {row["estimator"]: row for row in document(batches)[1]["rows"]}
    assert rows.keys() == measured.keys()
    for estimator, row in rows.items():
        assert row["variance"] == pytest.approx(measured[estimator].variance, rel=1e-6)


def planted(**changes: object) -> Measured:
    numbers = {"estimator": "fobg", "variance": 4.0, "lower": 3.0, "upper": 5.0, "seconds": 0.01}
    numbers |= {"paths": (), "verdict": "unbiased", "off": 0.0, "off_error": 0.0, "bias": 0.0, "norm": 2.0}
    numbers |= {"slope": 0.0, "lost": 0}
    return Measured(**(numbers | changes))  # type: ignore[arg-type]


def test_samples_fill_whole_calls_within_the_budget() -> None:
    """Three paths of nine nodes and theta itself: thirty calls, at least, or four times that if a call takes 1/4 s."""
    assert affordable(1e-3, 32) == 500 and affordable(100.0, 8) == affordable(2.0, 8) == 3 * 8 - 1
    assert affordable(0.25, 8) == 4 * 3 * 8 - 1


@pytest.mark.usefixtures("natively")
def test_calls_of_large_models_are_short() -> None:
    """A call computes all of its samples, so that one of many would take minutes where few are asked for."""
    quadruped = Path(mujoco.__file__).parent / "mjx" / "test_data" / "barkour_v0" / "assets" / "barkour_v0_mjx.xml"
    assert chunk_of(make_task("momentum_transfer"), 500) == 101 and chunk_of(make_task(str(quadruped)), 500) == 8


def test_the_error_after_a_second_is_that_of_its_samples() -> None:
    hundred = math.sqrt(4.0 / 100) / 2.0
    assert planted().error(2.0) == pytest.approx(hundred)
    assert planted().error(2.0, 16.0) == pytest.approx(2 * hundred)
    assert planted(bias=0.3).error(2.0) == pytest.approx(math.hypot(0.15, hundred))
    assert planted().error(0.0) == math.inf


def test_a_bias_at_right_angles_to_the_gradient_is_seen() -> None:
    """10 x + step(y): the derivative is nearly right along the mean gradient, and misses all of it across."""
    objective = objectives.OneStep(lambda x: 10 * x[0] + (x[1] > 0), 2, 0.1)
    chosen = [ZerothOrder(), FirstOrder()]
    streams = jax.random.split(jax.random.key(1), 2)
    estimates = [estimate(each, objective, jnp.zeros(2), key, 2000) for each, key in zip(chosen, streams, strict=True)]
    gradient, aside = (path[0] for path in along_means(chosen[1:], objective, jnp.zeros(2), 0.2, estimates, 4000, 0))
    assert gradient.verdict() == "right" and aside.verdict() == "biased"
    mean_slope = math.erf(2 / math.sqrt(2)) / 0.4  # of the step, over four standard deviations
    assert abs(float(aside.gap)) / 0.4 == pytest.approx(mean_slope, rel=0.05)
    assert float(aside.difference) == float(gradient.difference)


@pytest.mark.parametrize(
    ("spread", "strength", "expected"),
    [
        (0.3, 0.5, "for fobg_onset and aobg_onset the noise is too narrow: take --timestep 0.0008 or --sigma 0.2"),
        (0.0, 0.5, "the noise is too narrow: take a larger --sigma, or noise on the start"),
        (2.0, 0.5, "can be off by 25 %"),
        (2.0, 0.05, None),
        (2.0, 1.2, "can leave more than it adds"),
    ],
)
def test_when_the_onset_term_cannot_be_trusted(
    found: Diagnosis, spread: float, strength: float, expected: str | None
) -> None:
    """Unless its mean was measured to be right."""
    onsets = found.onsets | {"onset_spread": spread, "onset_strength": strength}
    doubts = [text for text in advised(found, onsets=onsets) if "narrow" in text or "can be off" in text]
    assert all("fobg_onset is right here, by the check of the mean" in text for text in doubts)
    undecided = tuple(dataclasses.replace(each, verdict="undecided") for each in found.estimators)
    texts = advised(found, onsets=onsets, estimators=undecided)
    assert any(expected in text for text in texts) if expected else len(texts) == 1


def test_contacts_that_all_lack_a_term_have_neither_a_first_step_nor_a_strength(found: Diagnosis) -> None:
    none = found.onsets | {"onset_spread": math.nan, "onset_strength": math.nan}
    told = "\n".join(page_lines(dataclasses.replace(found, onsets=none)))
    assert "contacts and limits that begin" in told and "nan" not in told


def test_biases_without_the_usual_explanation(found: Diagnosis) -> None:
    off = {"bias": 2 * found.norm, "off": 2 * found.norm, "off_error": 0.3 * found.norm}
    left = advised(found, estimators=with_estimator(found, "fobg_onset", verdict="biased", **off))
    error = 100 * math.hypot(0.3, 2 * found.norm_error / found.norm)
    assert any(f"the onset term leaves a bias of 200 ± {error:.0f} %" in text for text in left)
    assert not any("corrects that" in text for text in left)
    touches = tuple(dataclasses.replace(each, jump=1e-5) for each in found.touches)
    limited = advised(found, touches=touches)
    assert any("a joint's or tendon's limit sets in with a jump" in text and "solimplimit" in text for text in limited)
    smooth = advised(found, touches=touches, onsets=found.onsets | {"onset_strength": 1e-5})
    assert any("though force sets in without a jump" in text for text in smooth)
    assert not any("sets in with a jump" in text or "solimp" in text for text in smooth)


def test_a_bias_under_another_law_is_laid_to_something_else(found: Diagnosis) -> None:
    plain = tuple(each for each in found.estimators if not each.estimator.endswith("_onset"))
    events = {name: found.onsets[name] for name in ("onsets", "onset_spread")}
    _, text = advised(found, law="conic", onsets=events, estimators=plain, touches=())
    assert text.startswith("plain first order is biased by") and "something else jumps" in text


def test_without_a_significant_gradient_zeroth_order_is_advised_and_no_mean_judged(found: Diagnosis) -> None:
    """Errors are then absolute; twice the standard error takes four times the samples."""

    def among(*first: Measured) -> Diagnosis:
        others = [planted(estimator=name, norm=0.1, verdict="undecided") for name in ESTIMATORS[1 + len(first) :]]
        zeroth = planted(estimator="zobg", norm=0.1)
        return dataclasses.replace(found, seconds=10.0, estimators=(zeroth, *first, *others))

    def taken(*first: Measured) -> str:
        return advised(among(*first))[0].partition("take ")[2].partition(":")[0]

    (text,) = advised(among())
    assert taken() == "zobg" and "of 100 % needs 400 samples and one of 10 % 40,000;" in text
    assert f"is 0.100 ± {2 / math.sqrt(500):.3f}; --samples 1600 (32 s here) would resolve" in page_lines(among())[3]
    document = document_of(among())
    assert not document["resolved"] and document["best"] is None and document["estimators"][0]["bias"] is None
    assert document["gradient_norm_error"] == pytest.approx(2 / math.sqrt(500))
    right = planted(norm=0.1, verdict="right")
    assert taken(right) == "zobg" and taken(dataclasses.replace(right, variance=3.9)) == "fobg"
    off = dataclasses.replace(right, verdict="biased", off=3.0, off_error=0.2, bias=3.0)
    assert any("off by 3.00 ± 0.20 in the gradient's unit" in line for line in page_lines(among(off)))


def test_a_page_without_finite_samples_or_variance_says_so(found: Diagnosis) -> None:
    nothing = {"variance": math.nan, "lower": math.nan, "upper": math.nan, "norm": math.nan, "lost": found.samples}
    assert f"the gradient is unknown: 0 of {found.samples} samples are finite" in page_lines(
        dataclasses.replace(found, estimators=(planted(estimator="zobg", **nothing), planted(**nothing)))
    )
    wild = with_estimator(found, "fobg", variance=math.inf, lower=math.inf, upper=math.inf)
    rows = [line.split()[:2] for line in page_lines(dataclasses.replace(found, estimators=wild))]
    assert ["fobg", "inf"] in rows


@pytest.mark.parametrize(
    ("numbers", "why"),
    [
        ({"variance": 0.0, "lower": 0.0, "upper": 0.0, "norm": 0.0}, "the gradient is 0"),
        ({"variance": math.inf, "estimator": "zobg"}, "no estimator without visible bias has a finite variance"),
    ],
)
def test_without_a_number_nothing_is_recommended(found: Diagnosis, numbers: dict[str, Any], why: str) -> None:
    (text,) = advised(found, estimators=(planted(**numbers),))
    assert text.startswith(f"no estimator can be recommended: {why};")


def test_the_mean_costs_slope_stands_in_for_a_gradient_that_zeroth_order_does_not_resolve(found: Diagnosis) -> None:
    """All first-order means are biased, by a third of that slope, and their noise is small."""
    noisy = planted(estimator="zobg", variance=1e4, lower=9e3, upper=1.1e4, norm=0.1)
    off = {"verdict": "biased", "off": 0.2, "off_error": 0.01, "bias": 0.2, "paths": (crossed(0.2, 0.01),)}
    first = planted(variance=0.02, lower=0.01, upper=0.03, norm=0.7, slope=0.6, **off)
    term = dataclasses.replace(first, estimator="fobg_onset", variance=0.03)
    told = dataclasses.replace(found, samples=500, estimators=(first, term, noisy))
    assert told.by_slope and told.resolved and told.norm == 0.6
    assert told.norm_error == pytest.approx(math.hypot(0.01, math.sqrt(0.02 / 500)))
    assert "take fobg; its bias of 33.3 ± 1.8 % remains" in advised(told)[0]
    unsure = dataclasses.replace(first, off_error=0.4)
    assert not dataclasses.replace(told, estimators=(noisy, unsure)).resolved
    seen = dataclasses.replace(told, estimators=(first, dataclasses.replace(noisy, norm=50.0)))
    assert not seen.by_slope and seen.norm == 50.0


def crossed(gap: float, error: float, quadrature: float = 0.0, effective: float = 100.0) -> Circulation:
    """A check of a mean along a path over which the mean cost differs by 1."""
    return Circulation(*map(jnp.asarray, (1.0, gap, error, quadrature, effective, 1.0, 0)))


@pytest.mark.parametrize(
    ("path", "factor"),
    [
        (crossed(0.0, 0.01), 1.0),  # right
        (crossed(0.2, 0.01), 1.0),  # biased
        (crossed(0.01, 0.02), (3.29 * 0.02 / 0.04) ** 2),
        (crossed(0.04, 0.02), (3.29 * 0.02 / 0.04) ** 2),
        (crossed(0.01, 0.02, quadrature=0.01), (3.29 * 0.02 / 0.03) ** 2),
        (crossed(0.01, 0.02, quadrature=0.1), math.inf),
        (crossed(0.2, 0.01, effective=1.0), 3.0),
    ],
)
def test_a_verdict_needs_so_many_times_the_samples(path: Circulation, factor: float) -> None:
    assert path.more_samples() == pytest.approx(factor)
    if 1 < factor < math.inf:  # a standard error falls with the root of the number of samples
        enough = path.standard_error / math.sqrt(1.01 * factor), path.effective * 1.01 * factor
        assert dataclasses.replace(path, standard_error=enough[0], effective=enough[1]).verdict() != "undecided"


def test_samples_are_drawn_until_the_verdict_is_had_or_time_is_up(found: Diagnosis) -> None:
    def open_to(path: Circulation, seconds: float, **changes: Any) -> int:
        first = planted(verdict="undecided", paths=(path,), **changes)
        best = planted(estimator="zobg", variance=5.0)
        return more_samples(Measurement(500, seconds, 1.0, {}, 0, (best, first)))

    assert open_to(crossed(0.01, 0.02), 1.0) == 4 and open_to(crossed(0.01, 0.02), 10.0) == 0
    assert open_to(crossed(0.01, 0.03), 1.0) == 8 and open_to(crossed(0.01, 0.06), 1.0) == 0  # 32 exceed the most
    assert open_to(crossed(0.01, 0.02, quadrature=0.1), 1.0) == 0
    assert open_to(crossed(0.01, 0.02), 1.0, variance=6.0) == 0  # it cannot be the best
    unseen = Measurement(500, 1.0, 1.0, {}, 0, (planted(estimator="zobg", norm=0.1),))
    assert more_samples(unseen) == 4 and more_samples(dataclasses.replace(unseen, seconds=8.0)) == 0


HINGE, FREE, SLIDE = (f'<body><joint name="x" type="{kind}"/><geom size=".1" pos=".1 0 0"/></body>'
                      for kind in ("hinge", "free", "slide"))  # fmt: skip
CONTROL, VELOCITY = "every control", "the initial velocities"


@pytest.mark.parametrize(
    ("subject", "actuator", "unit", "added_to"),
    [
        (HINGE, "", "rad/s", VELOCITY),
        (FREE, "", "m/s or rad/s", VELOCITY),
        (SLIDE, '<motor joint="x"/>', "N", CONTROL),
        (HINGE, '<motor joint="x"/>', "N m", CONTROL),
        (SLIDE, '<position joint="x" kp="9" kv="1"/>', "m", CONTROL),
        (HINGE, '<velocity joint="x" kv="3"/>', "rad/s", CONTROL),
        (HINGE, '<motor joint="x" gear="2"/>', "", CONTROL),
        ("momentum_transfer", "", "rad", "theta"),
        ("double_pendulum", "", "", "theta"),
        ("tennis", "", "", CONTROL),
    ],
)
def test_the_noise_has_the_unit_of_what_it_is_added_to(
    subject: str, actuator: str, unit: str, added_to: str, tmp_path: Path
) -> None:
    """None where it is not known."""
    if subject.startswith("<"):
        path = tmp_path / "one.xml"
        path.write_text(f"<mujoco><worldbody>{subject}</worldbody><actuator>{actuator}</actuator></mujoco>")
        subject = str(path)
    setting = setting_of(subject, make_task(subject))
    assert (setting.sigma_unit, setting.added_to) == (unit, added_to)
    assert f"{setting.level}, added to {added_to}" in setting.line()


def test_the_onset_term_does_not_matter_where_plain_first_order_is_best(found: Diagnosis) -> None:
    for verdict in ("right", "undecided"):
        one = planted(variance=1e-6, norm=found.norm, verdict="right")
        plain = one, dataclasses.replace(one, estimator="fobg_onset", verdict=verdict)
        (text,) = advised(found, onsets=found.onsets | {"onset_spread": 0.3}, estimators=plain)
        assert text.startswith("at sigma = 0.05 m/s, take fobg;")
        assert "do not decide" not in "".join(page_lines(dataclasses.replace(found, estimators=plain)))


def test_a_bias_is_not_averaged_away(found: Diagnosis) -> None:
    """10 % with a bias of 8 % needs variance / 0.06^2 samples, and cannot be had with one of 30 %."""
    some = found.best.variance / (0.06 * found.norm) ** 2
    for bias, expected in ((0.08, some), (0.3, math.inf)):
        off = {"bias": bias * found.norm, "off": bias * found.norm, "off_error": 0.05 * found.norm}
        estimators = with_estimator(found, found.best.estimator, **off)
        assert dataclasses.replace(found, estimators=estimators).samples_needed == pytest.approx(expected)
    assert advised(found, estimators=estimators)[0].endswith("its bias of 30.0 ± 5.0 % remains, however many samples")


def test_a_mean_that_is_not_judged_is_not_called_biased(found: Diagnosis) -> None:
    name = found.best.estimator
    off = {"bias": 0.3 * found.norm, "off": 0.3 * found.norm, "off_error": 0.2 * found.norm}
    unsure = with_estimator(found, name, **off, verdict="undecided")
    best = advised(found, estimators=unsure)[0]
    assert "its bias" not in best and f"take {name};" in best
    assert best.endswith("whether its mean is right is undecided: 30 ± 20 % off along the paths")


def test_cautions_of_derivatives_and_stability(found: Diagnosis) -> None:
    """A solver that stops early is not called a wrong derivative."""
    finding = Finding("mjcf", "project", "unconverged", (), "", ())
    early = dataclasses.replace(found, derivatives=dataclasses.replace(found.derivatives, findings=(finding,)))
    assert document_of(early)["derivatives"] == "unconverged"
    assert "do not trust a first-order estimate" in "\n".join(page_lines(early))
    idle = dataclasses.replace(found, cost=1e7 * found.norm * found.setting.sigma)
    assert ["hardly depends" in "\n".join(page_lines(each)) for each in (found, idle)] == [False, True]
    unstable = dataclasses.replace(found.touches[0], stiffness=9.0, stable=False)
    page = page_lines(dataclasses.replace(found, touches=(*found.touches, unstable)))
    assert [line.split()[-1] for line in page if line.startswith("  floor and ball")] == ["UNSTABLE", "stable"]


def test_the_task_of_a_file(tmp_path: Path) -> None:
    """Its cost is the displacement, its noise is on the initial velocity, or on the controls from the keyframe's."""
    task = mjcf_task(ball(tmp_path), horizon=5)
    assert task.theta.shape == (1,) and task.contact_pair is None
    objective = Simulator(task, chunk_size=4).objective(None, 1e-9)
    falls = objective.evaluate(task.theta, jax.random.split(jax.random.key(0), 2))
    drop = GRAVITY * TIMESTEP**2 * 15  # after five steps of semi-implicit Euler
    assert jnp.allclose(falls.value, drop**2 / 2, rtol=1e-5)
    path = tmp_path / "arm.xml"
    path.write_text(
        """<mujoco><worldbody><body><joint name="a" type="hinge"/><geom size=".1" fromto="0 0 0 1 0 0" type="capsule"/>
        </body></worldbody><actuator><motor joint="a" ctrlrange="-4 4" ctrllimited="true"/></actuator>
        <keyframe><key qpos="0.5" qvel="1" ctrl="2"/></keyframe></mujoco>"""
    )
    arm = make_task(str(path), horizon=3)
    assert arm.theta.tolist() == [2.0] * 3 and arm.sigma == pytest.approx(0.4)
    start = arm.draw_start(jax.random.key(0))
    assert start.qpos.tolist() == [0.5] and start.qvel.tolist() == [1.0]
    with pytest.raises(ValueError, match="a file already"):
        make_task(str(path), model="other.xml")


@pytest.mark.parametrize("actuator", ["", '<actuator><motor joint="x"/></actuator>'])
def test_a_resting_system_is_moved_so_that_its_cost_has_a_gradient(actuator: str, tmp_path: Path) -> None:
    """A cart on a level rail: half the squared displacement is stationary at zero."""
    path = tmp_path / "cart.xml"
    path.write_text(
        f"""<mujoco><worldbody><body><joint name="x" type="slide" axis="1 0 0"/><geom size=".1" mass="2"/></body>
        </worldbody>{actuator}</mujoco>"""
    )
    task = mjcf_task(path, horizon=4)
    assert set(task.theta.tolist()) == {task.sigma} and "raised by 0.1 since nothing moves" in task.description
    if not actuator:
        objective = Simulator(task, chunk_size=4).objective(None, 1e-9)
        found = objective.differentiate(task.theta, jax.random.split(jax.random.key(0), 2))
        elapsed = 4 * task.scene.timestep
        assert jnp.allclose(found.gradient, task.sigma * elapsed**2, rtol=1e-5)
