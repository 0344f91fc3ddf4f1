"""Parameters are recovered from records, with the errors that the records' noise leaves."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from experiments.identification import DEVIATION, GUESS, TRUTH, changed, changed_host, host, thrown
from mjx_study.identification import engine_trajectories, identify, profile, trajectories, with_masses
from mjx_study.simulation._mjx import mjx

TIMES = np.linspace(0, 2, 40)
DECAY = {"size": 2.0, "rate": 1.5}


def decay(values: Any) -> Any:
    return values["size"] * jnp.exp(-values["rate"] * TIMES)


@pytest.mark.parametrize(("derivatives", "tolerance"), [("exact", 1e-9), ("smoothed", 2e-2), ("none", 2e-2)])
def test_a_decay(derivatives: str, tolerance: float) -> None:
    """Values, information in closed form, errors that cover, and the profile of a nearly quadratic misfit."""
    noise = 0.01 * np.random.default_rng(1).standard_normal(TIMES.size)
    fit = identify(decay, np.asarray(decay(DECAY)) + noise, 0.01, {"size": 1.0, "rate": 3.0}, derivatives=derivatives)
    size, rate = fit.values.values()
    slopes = size * np.exp(-rate * TIMES)[:, None] * np.stack([np.ones_like(TIMES), -rate * TIMES], 1) / 0.01
    np.testing.assert_allclose(fit.information, slopes.T @ slopes, rtol=tolerance)
    errors = np.sqrt(np.diag(np.linalg.inv(fit.information)))
    np.testing.assert_allclose(list(fit.standard_errors.values()), errors, rtol=1e-6)
    assert np.all(np.abs(np.log([size / 2, rate / 1.5])) < 3 * errors) and fit.converged and fit.size == 40
    at = rate * np.exp(2 * errors[1] * np.array([-1, 1]))
    np.testing.assert_allclose(profile(decay, decay(DECAY) + noise, 0.01, fit, "rate", at), 4, rtol=0.1)


@pytest.mark.parametrize("derivatives", ["exact", "smoothed", "none"])
def test_what_is_left_out_need_not_be_a_number(derivatives: str) -> None:
    """A missing record, and a prediction that there is no record of."""
    records, deviation = np.array(decay(DECAY)), np.full(TIMES.size, 0.01)
    records[3], deviation[[3, 5]] = np.nan, np.inf
    guess = {"size": 1.0, "rate": 3.0}
    fit = identify(lambda values: decay(values).at[5].set(np.nan), records, deviation, guess, derivatives=derivatives)
    np.testing.assert_allclose(list(fit.values.values()), [2.0, 1.5], rtol=1e-2)
    assert fit.converged and fit.size == 38


def test_a_profile_of_the_only_parameter_and_one_without_derivatives() -> None:
    def engine(values: Any) -> np.ndarray:
        known = DECAY | values
        return float(known["size"]) * np.exp(-float(known["rate"]) * TIMES)

    for guess in ({"rate": 1.0}, {"size": 1.0, "rate": 1.0}):
        fit = identify(engine, engine({}), 0.01, guess, derivatives="none")
        at = fit.values["rate"] * np.exp(2 * fit.standard_errors["rate"] * np.array([-1, 1]))
        found = profile(engine, engine({}), 0.01, fit, "rate", at, derivatives="none")
        np.testing.assert_allclose(found, 4, rtol=0.1)


def test_products_leave_their_factors_unknown() -> None:
    def product(values: Any) -> Any:
        return decay({"size": values["a"] * values["b"], "rate": values["rate"]})

    fit = identify(product, decay(DECAY), 0.01, {"a": 1.0, "b": 3.0, "rate": 1.0})
    errors, basis = fit.directions
    assert fit.converged and fit.misfit < 1 and np.isinf(errors[0]) and np.isfinite(errors[1:]).all()
    np.testing.assert_allclose(abs(basis[0]), [0.5**0.5, 0.5**0.5, 0], atol=1e-6)
    assert [np.isinf(error) for error in fit.standard_errors.values()] == [True, True, False]
    with pytest.raises(ValueError, match="by their logarithms, a must be positive"):
        identify(product, decay(DECAY), 0.01, {"a": 0.0, "b": 3.0, "rate": 1.0})
    with pytest.raises(ValueError, match="unknown derivatives of a fit 'second'; choose from exact, smoothed, none"):
        identify(product, decay(DECAY), 0.01, {"a": 1.0}, derivatives="second")


def test_what_depends_on_masses_is_mujocos() -> None:
    """Free, ball, hinge and slide joints, a static body and a tendon, against `mj_setConst`."""
    engine = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body><geom size=".1" mass="1"/></body>
      <body pos="0 3 0"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
        <geom size=".1" mass="3"/></body>
      <body pos="0 0 1"><freejoint/><geom type="box" size=".1 .2 .3" pos=".1 0 0" mass="2"/>
        <body pos=".3 0 0"><joint type="ball"/><geom type="capsule" size=".05 .1" mass="1"/>
          <body pos="0 .3 0"><joint name="h" type="hinge" axis="1 0 0"/>
            <geom type="capsule" size=".05 .1" mass=".5" pos="0 0 .2"/></body>
      </body></body></worldbody><tendon><fixed><joint joint="h" coef="2"/></fixed></tendon></mujoco>""")
    model, data = mjx.put_model(engine), mjx.make_data(engine)
    factor = np.array([1, 1, 3, 0.5, 2, 3])
    found = jax.jit(with_masses)(model, data, jnp.asarray(engine.body_mass * factor))
    engine.body_mass[:] *= factor
    engine.body_inertia[:] *= factor[:, None]
    mujoco.mj_setConst(engine, mujoco.MjData(engine))
    for name in ("body_subtreemass", "body_invweight0", "dof_invweight0", "tendon_invweight0", "body_inertia"):
        np.testing.assert_allclose(getattr(found, name), getattr(engine, name), rtol=1e-6, atol=1e-12, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("onset", ["none", "linear"])
def test_tosses(onset: str) -> None:
    """Predictions and, until the first contact ends, derivatives are the C engine's; the scale of all masses is not
    identified; and what the records tell is recovered."""
    starts = thrown(3, np.random.default_rng(0))
    # just above the deck, at speed, so that contact begins in the second step whatever the parameters
    starts[0][:, 2], starts[1][:, 2] = 0.0533, -1.3
    predict = trajectories(mjx.put_model(host), mjx.make_data(host), changed, starts, 8, onset=onset)
    engine = engine_trajectories(host, changed_host, starts, 8)
    exact = engine(TRUTH)
    np.testing.assert_allclose(predict(TRUTH), exact, atol=1e-8)
    fit = identify(predict, exact, DEVIATION / 100, GUESS)
    np.testing.assert_allclose(list(fit.values.values()), list(TRUTH.values()), rtol=1e-3)
    assert fit.converged
    shifts = 1e-4 * np.eye(4)
    away = [[engine(dict(zip(TRUTH, list(TRUTH.values()) * np.exp(sign * shift), strict=True))) for sign in (1, -1)]
            for shift in shifts]  # fmt: skip
    slopes = np.stack([((one - other) / (2e-4 * DEVIATION / 100)).ravel() for one, other in away], 1)
    at_truth = identify(predict, exact, DEVIATION / 100, TRUTH, iterations=0).information
    np.testing.assert_allclose(at_truth, slopes.T @ slopes, rtol=0, atol=1e-3 * np.diag(at_truth).max())
    errors, basis = identify(predict, exact, DEVIATION, {**TRUTH, "mass of cart": 1.0}, iterations=0).directions
    assert errors[0] > 1e5 * errors[1]
    np.testing.assert_allclose(abs(basis[0]), np.array([0, 0, 0, 1, 1]) / 2**0.5, atol=1e-4)
