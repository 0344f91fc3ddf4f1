"""Contact models: units, the force that MJX makes of them, validation and warnings."""

import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_study.choices import DEFAULT_SOLIMP, DEFAULT_SOLREF, FAMILIES
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.contact import (
    ContactModel,
    ContactWarning,
    apply_contact,
    contact_model,
    effective_mass,
    family_model,
    solref_from_stiffness,
    stable,
    stiffness_from_solref,
)
from mjx_study.simulation.scene import SceneError, load_scene, put_scene
from tests.scenes import compiled, floor_scene, option, scene_of, slider, step_flat

PENETRATION = 0.002  # [m], beyond every width, so that the impedance is d_width
MASS = 2.0


def constant(impedance: float) -> tuple[float, float, float, float, float]:
    return (impedance, impedance, 0.001, 0.5, 2.0)


# A sphere over a plane; the excess g of its edges' weight over the normal's own, by the cone.
KINDS = {
    "frictionless": (1, "pyramidal", 0.5),
    "elliptic": (3, "elliptic", 0.5),
    "pyramidal mu 0.5": (3, "pyramidal", 0.5),
    "pyramidal mu 1": (3, "pyramidal", 1.0),
    "pyramidal condim 4": (4, "pyramidal", 0.5),
}


def edges_gain(kind: str) -> float:
    """g = 2 (condim - 1) / (2 mu^2 (1 + mu^2)) for a pyramid, else 1: m_eff = g m."""
    condim, cone, mu = KINDS[kind]
    if condim == 1 or cone == "elliptic":
        return 1.0
    return 2 * (condim - 1) / (2 * mu**2 * (1 + mu**2))


def ball_scene(condim: int, cone: str, mu: float):
    ball = slider(condim, mu, MASS).replace("<geom", '<geom gap="0"', 1)
    text = floor_scene(ball, option(extra=f'cone="{cone}" gravity="0 0 0"'), f'condim="{condim}" friction="{mu} .01 0"')
    return scene_of(text)


@pytest.fixture(scope="module", params=KINDS)
def normal_acceleration(request):
    """The kind, its scene, and (contact, normal velocity, force per mass) -> normal acceleration, in MJX."""
    scene = ball_scene(*KINDS[request.param])
    lowered = jnp.asarray([0.0, 0.0, -PENETRATION])

    def acceleration(contact: ContactModel, velocity, free):
        model = apply_contact(scene.model, contact)
        data = scene.template.replace(
            qpos=lowered, qvel=jnp.zeros(3).at[2].set(velocity), qfrc_applied=jnp.zeros(3).at[2].set(MASS * free)
        )
        return mjx.forward(model, data).qacc[2]

    example = contact_model(DEFAULT_SOLREF, scene=scene)
    run = compiled(acceleration, example, jnp.asarray(0.0), jnp.asarray(0.0))
    return request.param, scene, lambda contact, v, a: float(run(contact, jnp.asarray(v), jnp.asarray(a)))


STIFFNESS, DAMPING, SPEED = 5e3, 30.0, -0.04  # N/m, N s/m, m/s


@pytest.mark.parametrize(("k", "b"), [(50.0, 0.0), (400.0, 3.0), (0.0, 199.0), (1e4, 100.0)])
def test_a_contact_is_stable_where_its_step_does_not_grow(k: float, b: float) -> None:
    """Against the eigenvalues of x' = x + h v', v' = v - h (k x + b v), on both sides of the limit."""
    for timestep in np.geomspace(1e-3, 1.0, 60):
        step = np.array([[1 - timestep**2 * k, timestep - timestep**2 * b], [-timestep * k, 1 - timestep * b]])
        grows = np.max(np.abs(np.linalg.eigvals(step))) > 1 + 1e-12
        assert stable((-k, -b), float(timestep)) != grows, timestep


@pytest.mark.parametrize("impedance", [1e-3, 0.5, 0.9])
def test_the_law_of_contact(normal_acceleration, impedance: float) -> None:
    """a_1 = (1 - d) a_0 - b v - k r, exact for a single normal row; with its gain for a pyramid."""
    kind, scene, acceleration = normal_acceleration
    k, b, free, gain = 3e3, 20.0, -7.0, edges_gain(kind)
    measured = acceleration(contact_model((-k, -b), constant(impedance), scene=scene), SPEED, free)
    law = (1 - impedance) * free - b * SPEED + k * PENETRATION
    # a pyramid's edges together weigh g rows: share g d / (1 - d + g d) of the way from a_0 to the reference
    share = gain * impedance / (1 - impedance + gain * impedance)
    weighed = free + share * ((-b * SPEED + k * PENETRATION) / impedance - free)
    assert measured == pytest.approx(weighed, rel=1e-10)
    assert gain != 1 or measured == pytest.approx(law, rel=1e-12)


def test_a_positive_solref_is_its_spring_and_damper(normal_acceleration) -> None:
    _, scene, acceleration = normal_acceleration
    positive = (0.025, 0.7)
    k, b = stiffness_from_solref(positive, effective_mass=1.0)
    models = [contact_model(solref, constant(0.8), scene=scene) for solref in (positive, (-k, -b))]
    by_time, direct = (acceleration(model, SPEED, -3.0) for model in models)
    assert by_time == pytest.approx(direct, rel=1e-12)


def test_refsafe_clips_at_two_timesteps(normal_acceleration) -> None:
    _, scene, acceleration = normal_acceleration
    limit = 2 * scene.timestep
    with pytest.warns(ContactWarning, match=r"refsafe clips the time constant 0.003 s at two timesteps, 0.004 s"):
        clipped = contact_model((0.75 * limit, 4.0), constant(0.8), scene=scene)
    with pytest.warns() as told:
        contact_model((limit / 4, 1.0), scene=scene)
    assert len(told) == 1  # stable as clipped
    safe = contact_model((limit, 4.0), constant(0.8), scene=scene)
    assert acceleration(clipped, SPEED, 0.0) == acceleration(safe, SPEED, 0.0)
    contact_model((0.009, 1.0), scene=load_scene("pusher"))  # refsafe is off there; warnings are errors here


@pytest.mark.parametrize(("stiffness", "damping"), [(1e3, 0.0), (2.5, 7.0), (1e7, 1e3)])
def test_units_round_trip(stiffness: float, damping: float) -> None:
    solref = solref_from_stiffness(stiffness, damping, effective_mass=0.05)
    assert solref == (-stiffness / 0.05, -damping / 0.05)
    assert stiffness_from_solref(solref, effective_mass=0.05) == pytest.approx((stiffness, damping), rel=1e-15)
    with pytest.raises(ValueError, match="mixes signs"):
        stiffness_from_solref((-1.0, 1.0), effective_mass=1.0)
    if damping:
        k, b = -solref[0], -solref[1]
        positive = (2 / b, b / (2 * math.sqrt(k)))
        assert stiffness_from_solref(positive, effective_mass=0.05) == pytest.approx((stiffness, damping), rel=1e-14)


def test_a_damping_ratio_of_one_is_critical() -> None:
    k, b = (-value for value in solref_from_stiffness(300.0, effective_mass=2.0, dampratio=1.0))
    assert b**2 == pytest.approx(4 * k, rel=1e-15)  # r'' + b r' + k r = 0 has a double root
    assert solref_from_stiffness(300.0, effective_mass=2.0) == (-150.0, -0.0)


def test_effective_masses() -> None:
    """Two masses m in series act like m / 2; a fixed one does not move; a pyramid has its edges' gain."""
    assert effective_mass(load_scene("pusher"), "pusher", "slider") == pytest.approx(0.05, rel=1e-12)
    for kind, parts in KINDS.items():
        assert effective_mass(ball_scene(*parts), "ball", "floor") == pytest.approx(edges_gain(kind) * MASS, rel=1e-12)


def test_effective_mass_errors() -> None:
    host = mujoco.MjModel.from_xml_string(floor_scene('<geom name="wall" size=".1"/>' + slider()))
    scene = put_scene(host, "here")
    with pytest.raises(ValueError, match="'floor' and 'wall' are both fixed"):
        effective_mass(scene, "floor", "wall")
    with pytest.raises(SceneError, match="here has no geom 'roof'; it has floor, wall, ball"):
        effective_mass(scene, "roof", "ball")


PAIRED = f"""<mujoco>{option()}<worldbody><geom name="floor" type="plane" size="1 1 1" priority="1"/>
  {slider().replace("ball", "one")}{slider().replace("ball", "two").replace('"0 0 0.1"', '"1 0 .1"')}</worldbody>
<contact><pair geom1="floor" geom2="one" condim="4"/></contact></mujoco>"""


def test_contact_parameters_reach_every_contact() -> None:
    """Geoms and explicit pairs alike, whatever the MJCF says of mixing; the margin counts once."""
    scene = scene_of(PAIRED)
    solimp, friction, margin = (0.3, 0.6, 0.002, 0.4, 3.0), (0.8, 0.02, 0.003), 0.0015
    contact = contact_model((-900.0, -3.0), solimp, friction, margin, scene=scene)
    data = jax.jit(lambda contact: mjx.fwd_position(apply_contact(scene.model, contact), scene.template))(contact)
    rows = data._impl.contact
    assert len(rows.dim) >= 3  # floor with each ball, and the balls
    for index in range(len(rows.dim)):
        np.testing.assert_array_equal(rows.solref[index], [-900.0, -3.0])
        np.testing.assert_array_equal(rows.solimp[index], solimp)
        np.testing.assert_array_equal(rows.friction[index], [0.8, 0.8, 0.02, 0.003, 0.003])
        assert rows.includemargin[index] == margin


def test_what_is_not_given_stays_the_mjcfs() -> None:
    scene = scene_of(PAIRED)
    model = apply_contact(scene.model, contact_model(DEFAULT_SOLREF, scene=scene))
    for name in ("geom_friction", "geom_margin", "pair_friction", "pair_margin"):
        assert getattr(model, name) is getattr(scene.model, name)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"solref": (-1.0, 1.0)}, "mixes signs and MuJoCo would fall back"),
        ({"solref": (math.inf, 1.0)}, "solref must be two finite numbers"),
        ({"solimp": (0.9, 0.95)}, "solimp must be five finite numbers"),
        ({"solimp": (0.0, 0.95, 0.001, 0.5, 2.0)}, "solimp's d_0 is 0.0, and MuJoCo would clip it"),
        ({"solimp": (0.9, 0.95, 0.0, 0.5, 2.0)}, "solimp's width must be positive, in m; got 0.0"),
        ({"solimp": (0.9, 0.95, 0.001, 0.5, 0.5)}, "solimp's power must be at least 1, got 0.5"),
        ({"friction": (0.5, -0.1, 0.0)}, "friction must be three numbers >= 0"),
        ({"margin": -0.1}, "margin must be >= 0 m, got -0.1"),
    ],
)
def test_bad_contact_models_are_refused(change, message: str) -> None:
    arguments = {"solref": DEFAULT_SOLREF, **change}
    with pytest.raises(ValueError, match=message):
        contact_model(**arguments, scene=load_scene("pusher"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"stiffness": 0.0}, "stiffness must be positive and finite, in N/m; got 0.0"),
        ({"effective_mass": 0.0}, "effective mass must be positive and finite, in kg; got 0.0"),
        ({"damping": -1.0}, "damping must be >= 0 and finite, in N s/m; got -1.0"),
        ({"dampratio": -1.0}, "damping ratio must be >= 0 and finite; got -1.0"),
        ({"damping": 1.0, "dampratio": 1.0}, "give damping in N s/m or a damping ratio, not both"),
    ],
)
def test_bad_units_are_refused(arguments, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        solref_from_stiffness(**{"stiffness": 1.0, "effective_mass": 1.0, **arguments})


@pytest.mark.parametrize("name", FAMILIES)
def test_every_family_builds(name: str) -> None:
    with pytest.raises(ValueError, match="unknown contact family 'rubber'; choose from penalty, impedance, mujoco"):
        family_model("rubber", load_scene("pusher"), stiffness=1.0, effective_mass=1.0)
    scene, family = load_scene("pusher"), FAMILIES[name]
    mass = effective_mass(scene, "pusher", "slider")
    if family.smoothing:
        pytest.importorskip("mujodico", reason="the extra laws is not installed")
    if family.solimp is None:
        with pytest.raises(ValueError, match="use None instead of a contact model"):
            family_model(name, scene, effective_mass=mass)
        return
    if not family.swept:
        contact = family_model(name, scene, effective_mass=mass)
        np.testing.assert_array_equal(contact.solref, family.solref)
        for given in ({"stiffness": 1.0}, {"damping": 1.0}):
            with pytest.raises(ValueError, match="is a single point and takes no stiffness or damping"):
                family_model(name, scene, effective_mass=mass, **given)  # type: ignore[arg-type]
        return
    contact = family_model(name, scene, stiffness=100.0, effective_mass=mass)
    with pytest.raises(ValueError, match="stiffness must be positive and finite, in N/m; got 0.0"):
        family_model(name, scene, stiffness=0.0, effective_mass=mass)
    if family.smoothing:  # another law: its stiffness is measured in test_law
        return
    stiffness, damping = stiffness_from_solref(np.asarray(contact.solref).tolist(), effective_mass=mass)
    assert stiffness == pytest.approx(100.0, rel=1e-15)
    assert damping == pytest.approx(2 * family.dampratio * math.sqrt(100.0 * mass), abs=1e-12)
    np.testing.assert_array_equal(contact.solimp, family.solimp)
    damped = family_model(name, scene, stiffness=100.0, damping=0.3, effective_mass=mass)
    assert float(damped.solref[1]) == pytest.approx(-0.3 / mass, rel=1e-15)
    with pytest.raises(ValueError, match=f"contact family '{name}' needs a stiffness in N/m"):
        family_model(name, scene, effective_mass=mass)


def test_mujocos_own_defaults_are_the_constants() -> None:
    host = mujoco.MjModel.from_xml_string(floor_scene(slider()))
    assert tuple(host.geom_solref[0]) == DEFAULT_SOLREF
    assert tuple(host.geom_solimp[0]) == DEFAULT_SOLIMP


@pytest.fixture(scope="module")
def pressed():
    """A frictionless ball under gravity, stepped under any contact model."""
    scene = scene_of(floor_scene(slider(1), option(extra='gravity="0 0 -10"'), 'condim="1"'))

    def advance(contact, point, warmstart):
        return step_flat(scene, apply_contact(scene.model, contact), point, warmstart)[:2]

    contact = contact_model(DEFAULT_SOLREF, scene=scene)
    return scene, compiled(advance, contact, jnp.zeros(6), jnp.zeros(3))


@pytest.mark.parametrize("relative_damping", [0.0, 0.5, 1.3])
def test_the_stability_limit(pressed, relative_damping: float) -> None:
    """h^2 k = 4 - 2 h b is where a pressed contact starts to make energy, and where the warning starts."""
    scene, advance = pressed
    timestep, impedance = scene.timestep, 0.5
    b = relative_damping / timestep
    limit = (4 - 2 * timestep * b) / timestep**2

    def growth(k: float) -> float:
        contact = contact_model((-k, -b), constant(impedance), scene=scene)
        rest = -(1 - impedance) * 10 / k  # where the spring carries its share of gravity
        point, warmstart, offset = np.array([0, 0, 0.9999 * rest, 0, 0, 0]), np.zeros(3), []
        for _ in range(25):
            point, warmstart = (np.asarray(part) for part in advance(contact, point, warmstart))
            offset.append(abs(point[2] / rest - 1))
        return max(offset[-2:]) / 1e-4

    # The linear map's root nearest -1 is 4 % of the distance over 1 + det away from it on either side; over 25 steps
    # that is at least a factor of two, and without damping a bounded beat below the limit.
    below = growth(0.96 * limit)
    with pytest.warns(ContactWarning, match=r"is not below 4 - 2 h b .*gains energy"):
        above = growth(1.04 * limit)
    roots = [
        max(abs(np.roots([1, -(2 - timestep * b - s * timestep**2 * limit), 1 - timestep * b]))) for s in (0.96, 1.04)
    ]
    assert roots[0] <= 1 + 1e-12 < roots[1]
    assert below < 6  # 1 / sqrt(1 - 0.96) = 5: the largest transient of the undamped map
    assert above > 0.3 * roots[1] ** 24
    assert above > below


@pytest.mark.parametrize(
    ("family", "given", "of_tasks", "told"),
    [
        ("penalty", None, [0.0], "spring K without damping, impedance"),
        ("penalty", None, [20.0], "spring K damped by 20 N s/m, impedance"),
        ("penalty", None, [1.0, 20.0], "spring K damped by 1 or 20 N s/m, impedance"),
        ("penalty", 0.0, [20.0], "spring K without damping, impedance"),
        ("mujoco", None, [20.0], "K critically damped"),
        ("mujoco", 5.0, [20.0], "K damped by 5 N s/m"),
        ("mujoco", 0.0, [20.0], "K without damping"),
        ("mujoco_default", None, [20.0], "MuJoCo's defaults: solref"),
    ],
)
def test_descriptions_tell_the_damping_in_force(
    family: str, given: float | None, of_tasks: list[float], told: str
) -> None:
    assert told in FAMILIES[family].described(given, of_tasks)
