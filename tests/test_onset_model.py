"""The onset term over the model: of the drop-in step, and of rollouts, of which the model moves the touch."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.over_model import mean_gradients, slopes
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.contact import apply_contact
from mjx_study.simulation.drop_in import step
from mjx_study.simulation.dynamics import initial_state, rollout
from mjx_study.simulation.scene import Scene
from tests.scenes import FALLING, compiled, corrected_rollout, floor_scene, option, scene_of, slider
from tests.test_onset_term import BOUNCING, LAW, Law

ONSETS = {"step": "linear", "linear": "linear", "shift": "shift"}


def last_state(path: str, onset: str, scene: Scene, model: mjx.Model, start: Any, steps: int) -> Any:
    """Last position and velocity, by the drop-in step or by rollouts."""
    if path == "step":
        data = scene.template.replace(qpos=start.qpos, qvel=start.qvel)
        last = jax.lax.scan(lambda data, _: (step(model, data, onset=onset), None), data, length=steps)[0]
        return last.qpos, last.qvel
    if onset == "none":
        states, *_ = rollout(scene, model, start, LAW, steps)
    else:
        states, *_ = corrected_rollout(scene, model, start, LAW, steps, onset=onset)
    return states.qpos[-1], states.qvel[-1]


@pytest.mark.parametrize(
    "path", ["linear", *(pytest.param(path, marks=pytest.mark.slow) for path in ("step", "shift"))]
)
@pytest.mark.parametrize(
    ("law", "speed", "gap", "steps"),
    [(Law(), -1.5, 0.0352, 80), pytest.param(BOUNCING, -1.0, 0.0349, 400, marks=pytest.mark.slow)],
    ids=["begins", "begins and ends under force"],
)
def test_symmetries_hold(path: str, law: Law, speed: float, gap: float, steps: int) -> None:
    """To rounding, with the term and without, in both modes: of a shift of ball or floor, of the unit of time, and of
    the unit of mass."""
    scene = scene_of(FALLING)
    model = apply_contact(scene.model, law.contact)
    shift: dict[str, float] = {"gap": 1.0, "radius": -1.0, "floor": -1.0}
    time: dict[str, float] = {"timestep": 1.0, "timeconst": 1.0, "speed": -1.0, "gravity": -2.0}
    mass: dict[str, float] = {"mass": 1.0, "weight": -1.0}

    def height(changes: dict[str, Any], onset: str) -> Any:
        c = {name: jnp.asarray(changes.get(name, 0.0)) for name in (*shift, *time, *mass)}
        opt = model.opt.replace(
            timestep=model.opt.timestep * (1 + c["timestep"]), gravity=model.opt.gravity * (1 + c["gravity"])
        )
        changed = model.replace(
            opt=opt,
            geom_size=model.geom_size.at[1, 0].add(c["radius"]),
            geom_pos=model.geom_pos.at[0, 2].add(c["floor"]),
            geom_solref=model.geom_solref.at[:, 0].multiply(1 + c["timeconst"]),
            body_mass=model.body_mass * (1 + c["mass"]),
            body_invweight0=model.body_invweight0 * (1 + c["weight"]),
        )
        start = initial_state(scene, gap + c["gap"][None], jnp.array([speed]) * (1 + c["speed"]))
        return last_state(path, onset, scene, changed, start, steps)[0][0]

    def slopes(point: Any) -> Any:
        corrected = partial(height, onset=ONSETS[path])
        return jax.grad(partial(height, onset="none"))(point), jax.grad(corrected)(point), jax.jacfwd(corrected)(point)

    point = dict.fromkeys([*shift, *time, *mass], jnp.array(0.0))
    plain, reverse, forward = compiled(slopes, point)(point)
    for found in (plain, reverse):
        along = [sum(rate * found[name] for name, rate in each.items()) for each in (time, mass)]
        scale = max(abs(float(found[name])) for name in time)
        np.testing.assert_allclose(along, 0, atol=1e-9 * scale)
        # where ball and floor are, the height is the gap's less than it by the shift
        np.testing.assert_allclose([found["radius"], found["floor"]], 1 - found["gap"], rtol=1e-9)
    for name in point:
        np.testing.assert_allclose(reverse[name], forward[name], rtol=1e-9, atol=1e-12)
    assert all(abs(reverse[name] - plain[name]) > 0.1 for name in ("gap", "radius", "floor"))
    assert min(abs(float(reverse[name])) for name in (*time, *mass)) > 1e-6


@pytest.mark.slow
def test_rollouts_have_the_derivatives_of_the_drop_in_step() -> None:
    """To rounding, where both take the touch's velocity to be the same: without gravity, of one onset with friction."""
    scene = scene_of(floor_scene(slider(), option(2e-3, 'gravity="0 0 0"', 'refsafe="disable"')))
    model = apply_contact(scene.model, Law(timeconst=0.03, low=0.8).contact)
    start = initial_state(scene, jnp.array([0.0, 0.0, 0.0312]), jnp.array([0.7, 0.2, -1.5]))
    leaves = ("geom_solref", "geom_solimp", "geom_friction", "geom_size", "geom_margin", "body_mass", "body_invweight0")

    def total(moving: dict[str, Any], path: str) -> Any:
        opt = model.opt.replace(timestep=moving["timestep"], gravity=moving["gravity"])
        changed = model.replace(opt=opt, **{name: moving[name] for name in leaves})
        position, velocity = last_state(path, "linear", scene, changed, start, 30)
        return position @ jnp.array([1.0, 2.0, 3.0]) + velocity @ jnp.array([0.5, 0.1, 0.2])

    moving = {name: jnp.asarray(getattr(model, name)) for name in leaves}
    moving |= {name: jnp.asarray(getattr(model.opt, name)) for name in ("timestep", "gravity")}
    both = lambda moving: [jax.grad(partial(total, path=path))(moving) for path in ("step", "linear")]  # noqa: E731
    expected, found = compiled(both, moving)(moving)
    for name in moving:
        assert np.abs(expected[name]).max() > 1e-4, name
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-8, atol=1e-10, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("onset", ["linear", "shift"])
def test_the_mean_has_the_slope_over_the_model(onset: str) -> None:
    """Within 3 %, on `momentum_transfer`; where the model moves the touch, plain first order is 460 % off or more."""
    expected, plain, corrected = slopes(), mean_gradients("none"), mean_gradients(onset)
    for name, (slope, _) in expected.items():
        assert abs(corrected[name][0] - slope) < 0.03 * abs(slope), name
        assert abs(plain[name][0] - slope) > 4 * abs(slope) or name == "damping ratio"
