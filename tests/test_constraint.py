"""Our law of the constraint rows against MJX's solver, and the residual that it gives."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco.mjx._src import solver

from mjx_study.simulation import constraint, dynamics
from mjx_study.simulation.linear_algebra import MOST_UNROLLED, solve_positive_definite
from mjx_study.simulation.scene import put_scene
from tests.scenes import (
    CASES,
    compiled,
    condims,
    floor_scene,
    option,
    scene_of,
    slider,
    split,
    start_point,
    step_flat,
)

SOURCES = {
    "pyramidal condim 1, 3, 4, 6": condims("pyramidal", (1, 3, 4, 6)),
    "elliptic condim 3, 4, 6": condims("elliptic", (3, 4, 6)),
    "mechanism": CASES["mechanism"].source,
    "chain elliptic CG": CASES["chain elliptic CG"].source,
}


@pytest.fixture(scope="module", params=SOURCES, ids=lambda name: name.replace(" ", "-"))
def laws(request):
    """The slack, our forces and imbalance, and MJX's at a given acceleration."""
    scene = scene_of(SOURCES[request.param])
    if request.param in CASES:
        point = start_point(CASES[request.param], scene)
    else:
        speeds = np.random.default_rng(1).normal(size=scene.host.nv) / 5
        point = np.concatenate([np.asarray(scene.template.qpos), speeds])

    def evaluate(qacc):
        qpos, qvel, act, control = split(scene, jnp.asarray(point))
        positioned = dynamics.position_stage(scene, scene.model, qpos)
        data = dynamics.force_stage(scene.model, positioned, qvel, act, control)
        context = solver.Context.create(scene.model, data.replace(qacc=qacc))
        rows: Any = data._impl
        slack = rows.efc_J @ qacc - rows.efc_aref
        forces = constraint.row_force(scene.model, data, slack)
        imbalance = constraint.imbalance(scene.model, data, qacc)
        span = slice(rows.ne, rows.ne + rows.nf or None)  # the rows whose linear zone is narrow, if there are any
        nearest = jnp.linalg.lstsq(rows.efc_J[span], rows.efc_aref[span])[0]
        return slack, rows.efc_D, forces, context.efc_force, imbalance, context.grad, nearest

    run = compiled(evaluate, jnp.zeros(scene.host.nv))
    return request.param, scene, run


def random_accelerations(run, nv: int, number: int = 200) -> np.ndarray:
    """Around the acceleration of least slack, at distances from 1e-5 to 1e3, so that every zone is seen."""
    rng = np.random.default_rng(2)
    return np.asarray(run(np.zeros(nv))[-1]) + rng.normal(size=(number, nv)) * 10 ** rng.uniform(-5, 3, (number, 1))


def test_forces_and_imbalance_are_those_of_mjx(laws) -> None:
    name, scene, run = laws
    seen, forces = [], []
    for qacc in random_accelerations(run, scene.host.nv):
        slack, inverse_regularisation, ours, theirs, imbalance, gradient, _ = map(np.asarray, run(qacc))
        scale = np.abs(inverse_regularisation * slack).max()
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-14 * scale)
        np.testing.assert_allclose(imbalance, gradient, rtol=0, atol=1e-13 * max(scale, np.abs(gradient).max()))
        forces.append(ours)
        linear = np.isclose(ours, -inverse_regularisation * slack, rtol=1e-9, atol=0)
        seen.append(np.where(ours == 0, 0, np.where(linear, 1, 2)))
    seen, forces = np.array(seen), np.array(forces)
    zones = {zone: set(np.flatnonzero((seen == zone).any(axis=0))) for zone in (0, 1, 2)}
    rows: Any = scene.template._impl
    one_sided = set(range(rows.ne + rows.nf, rows.nefc))
    if "condim" in name:  # each contact is seen separated and sticking (and on the cone's side below)
        assert one_sided <= zones[0] and one_sided <= zones[1]
    if "elliptic condim" in name:
        assert one_sided <= zones[2], "not every contact was seen sliding"
    if name == "mechanism":
        assert rows.ne == 1 and rows.nf == 3 and rows.nl == 3
        assert zones[1] >= set(range(rows.ne + rows.nf)), "equality and friction loss were not seen linear"
        assert zones[2] >= set(range(rows.ne, rows.ne + rows.nf)), "friction loss was not seen saturated"
        saturated = np.abs(forces[:, rows.ne : rows.ne + rows.nf]).max(axis=0)
        np.testing.assert_allclose(saturated, [0.1, 0.02, 0.2], rtol=1e-15)  # of two joints, then of the tendon


def test_the_elliptic_law_is_the_gradient_of_a_convex_cost() -> None:
    """On the cone's side, in directions that turn: the law's Jacobian is symmetric and dissipative, and f = f' x.

    The law alone, without a simulation: a term without its derivative, or scaled on one side, is not symmetric.
    """
    friction, impratio, mass = np.array([0.6, 0.4, 0.03]), 1.7, 0.8
    scene = scene_of(floor_scene(slider(4), option(extra=f'cone="elliptic" impratio="{impratio}"'), 'condim="4"'))
    mu = friction[0] / np.sqrt(impratio)
    # of the normal row 1/R, and of each tangential row 1/R impratio-scaled so that the cone's two pieces meet smoothly
    inverse = np.concatenate([[mass], mass * impratio * friction**2 / friction[0] ** 2])
    rows: Any = scene.template._impl
    limits = np.concatenate([friction, np.full(rows.contact.friction.shape[1] - 3, 0.01)])[None]
    data: Any = scene.template.tree_replace(
        {"_impl.efc_D": jnp.asarray(inverse), "_impl.contact.friction": jnp.asarray(limits)}
    )

    def law(slack):
        return constraint.row_force(scene.model, data, slack)

    rng, sliding = np.random.default_rng(0), 0
    for _ in range(12):
        tangent = rng.normal(size=3) / friction
        length = np.linalg.norm(friction * tangent)
        slack = np.concatenate([[rng.uniform(-1 / mu, mu) * length / mu], tangent])
        force, slope = np.asarray(law(jnp.asarray(slack))), np.asarray(jax.jacfwd(law)(jnp.asarray(slack)))
        normal = mu * slack[0]
        sliding += bool(mu * normal + length > 0 and normal < mu * length)
        np.testing.assert_allclose(slope, slope.T, rtol=0, atol=1e-13)
        np.testing.assert_allclose(slope @ slack, force, rtol=0, atol=1e-13)
        assert np.linalg.eigvalsh(slope).max() < 1e-12
        assert np.linalg.norm(force[1:] / friction) <= force[0] + 1e-12  # within the cone
    assert sliding >= 4


def test_the_residual_measures_the_distance_from_the_solution() -> None:
    """Of a ball that presses on the plane."""
    scene = scene_of(floor_scene(slider(3), option(extra='cone="elliptic"')))

    def evaluate(height, qacc):
        data = dynamics.position_stage(scene, scene.model, jnp.zeros(3).at[2].set(height))
        data = dynamics.force_stage(scene.model, data, jnp.asarray([0.3, 0.0, -0.1]), jnp.zeros(0), jnp.zeros(0))
        solved = constraint.solve(scene.model, data)
        return solved, constraint.residual(scene.model, data, solved), constraint.residual(scene.model, data, qacc)

    run = compiled(evaluate, jnp.asarray(0.0), jnp.zeros(3))
    height = jnp.asarray(-0.0005)
    solution, converged, _ = run(height, jnp.zeros(3))
    # MJX stops where its cost no longer falls; the cost is quadratic, so that this is the square root of rounding
    assert float(converged) < 1e-7
    away = np.array([1.0, -0.5, 2.0])
    far, near = (float(run(height, solution + distance * away)[2]) for distance in (1e-2, 1e-3))
    assert far > 1e-4
    assert far / near == pytest.approx(10, rel=0.05)  # linear in the distance


def test_the_residual_of_nothing_is_zero() -> None:
    scene = scene_of(floor_scene(slider(1, height=0.5), option(extra='gravity="0 0 0"'), 'condim="1"'))

    def residual(qpos):
        data = dynamics.position_stage(scene, scene.model, qpos)
        data = dynamics.force_stage(scene.model, data, jnp.zeros(3), jnp.zeros(0), jnp.zeros(0))
        return constraint.residual(scene.model, data, jnp.zeros(3))

    assert float(jax.jit(residual)(jnp.zeros(3))) == 0.0


def test_small_systems_are_solved_to_rounding_from_anywhere() -> None:
    """Also where MJX's conjugate gradients stop because their cost no longer falls, whatever MJX's budget; and from the
    warm start of a state that had diverged."""
    case = CASES["mechanism"]
    scene = scene_of(case.source.replace('iterations="100" ls', 'solver="CG" iterations="1" ls'))
    assert scene.host.nv <= MOST_UNROLLED
    point, warmstart = start_point(case, scene), jnp.zeros(scene.host.nv)
    step = compiled(lambda *args: step_flat(scene, scene.model, *args), point, warmstart)
    for start in (warmstart, warmstart + 1e3, warmstart - 1e5, warmstart * np.nan, warmstart + np.inf):
        after, _, left = step(point, start)
        assert np.isfinite(after).all() and float(left) < 1e-13


@pytest.mark.parametrize("size", [1, 2, MOST_UNROLLED, MOST_UNROLLED + 1])
def test_solve_positive_definite(size: int) -> None:
    """Unrolled and by a library."""
    rng = np.random.default_rng(size)
    root = rng.normal(size=(size, size))
    matrix = root @ root.T + np.eye(size)
    for right_side in (rng.normal(size=size), rng.normal(size=(size, 3))):
        solution = solve_positive_definite(jnp.asarray(matrix), jnp.asarray(right_side))
        assert solution.shape == right_side.shape
        # backward stable: |A x - b| is some roundings of |A| |x|
        scale = np.linalg.norm(matrix, 2) * np.abs(solution).max()
        np.testing.assert_allclose(matrix @ solution, right_side, rtol=0, atol=10 * size * np.finfo(float).eps * scale)


BOX = """<mujoco>
<option cone="{}" iterations="1"/>
<worldbody><geom type="plane" size="5 5 .1"/><body pos="0 0 .1"><freejoint/>
<geom type="box" size=".1 .15 .1" mass="1" condim="4" friction="0.7 0.01 0.001"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize("cone", ["elliptic", pytest.param("pyramidal", marks=pytest.mark.slow)])
def test_a_box_on_four_corners_is_solved_to_rounding(cone: str) -> None:
    """Corners that stick, slip, spin and part, from warm starts far off."""
    scene = put_scene(mujoco.MjModel.from_xml_string(BOX.format(cone)), "box")

    def solved(key):
        keys = jax.random.split(key, 4)
        turn = jnp.array([1.0, 0, 0, 0]) + 0.02 * jax.random.normal(keys[0], (4,))
        place = jnp.array([0, 0, 0.1]) + 0.004 * jax.random.normal(keys[1], (3,))
        velocity = jnp.array([1.0, 1, 1, 5, 5, 5]) * jax.random.normal(keys[2], (6,))
        start = dynamics.State(
            jnp.concatenate([place, turn / jnp.linalg.norm(turn)]), velocity, jnp.zeros(0), jnp.zeros(6)
        )
        data = dynamics.smooth_stages(scene, scene.model, start, jnp.zeros(0))
        data = data.replace(qacc_warmstart=100 * jax.random.normal(keys[3], (6,)))
        qacc = constraint.run_solver(scene.model, data)
        return constraint.residual(scene.model, data, qacc), jnp.any(qacc != data.qacc_smooth)

    residuals, touching = jax.jit(jax.vmap(solved))(jax.random.split(jax.random.key(1), 1000))
    assert float(jnp.mean(touching)) > 0.5
    assert float(jnp.max(residuals)) < 1e-12
