"""Parameters of contacts and stiffness in N/m where geoms differ: against the C engine and a static load."""

import copy
import itertools
from typing import Any

import mujoco
import numpy as np
import pytest

from mjx_study.choices import CONES, FAMILIES
from mjx_study.simulation.contact import (
    ContactModel,
    apply_to_host,
    contact_pair,
    effective_mass,
    family_model,
    stiffness_from_solref,
)
from mjx_study.simulation.contact_pair import ContactPair, contact_pairs
from mjx_study.simulation.scene import Scene, SceneError, put_scene
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import family_grid

MASS, GRAVITY, STIFFNESS = 1.3, 9.81, 50.0
FLOOR = {"friction": "1 .01 .001", "solref": ".02 1", "solimp": ".9 .95 .001 .5 2"}
# Attributes of the ball, of the floor, of an explicit pair, and of the option.
OVERRIDES: dict[str, tuple[str, str, str, str]] = {
    "equal": ("", "", "", ""),
    "priority of the ball": ('priority="1" friction=".3"', 'friction=".8"', "", ""),
    "priority of the floor": ('friction=".9" condim="4"', 'priority="2" friction=".4" solref=".05 .7"', "", ""),
    "explicit pair": ("", "", 'friction=".3 .4" solref="-300 -2" condim="3" margin=".004"', ""),
    "solmix": ('solmix="3" solref=".05 .5" solimp=".5 .6 .002 .5 2"', 'solmix="1"', "", ""),
    "no solmix": ('solmix="0" solref=".05 .5"', 'solmix="0"', "", ""),
    "solmix of one": ('solmix="0" solref=".05 .5"', 'solmix="2" solref=".03 .9"', "", ""),
    "a direct solref": ('solref="-400 -3"', "", "", ""),
    "margin and gap": ('margin=".003" gap=".001"', 'margin=".002"', "", ""),
    "condim 6": ('condim="6" friction=".5 .02 .01"', 'friction=".6 .01 .02"', "", ""),
    "no friction": ('friction="0 0 0"', 'friction="0 0 0"', "", ""),
    "frictionless": ('condim="1"', 'condim="1"', "", ""),
    "impratio": ("", "", "", 'impratio="4"'),
}


def host_of(override: str, cone: str = "pyramidal") -> mujoco.MjModel:
    ball, floor, pair, option = OVERRIDES[override]
    explicit = f'<contact><pair geom1="ball" geom2="floor" {pair}/></contact>' if pair else ""
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option cone="{cone}" timestep="1e-4" gravity="0 0 -{GRAVITY}" {option}/><worldbody>'
        f'<geom name="floor" type="plane" size="1 1 .1" {floor}/><body><joint type="slide" axis="0 0 1"/>'
        f'<geom name="ball" size=".1" mass="{MASS}" {ball}/></body></worldbody>{explicit}</mujoco>'
    )


def scene_of(host: mujoco.MjModel) -> Scene:
    return put_scene(host, "test")


@pytest.mark.parametrize("override", OVERRIDES)
def test_parameters_are_those_of_the_engines_contact(override: str) -> None:
    host = host_of(override)
    data = mujoco.MjData(host)
    data.qpos[0] = 0.099
    mujoco.mj_forward(host, data)
    (contact,), (pair,) = data.contact, contact_pairs(host)
    assert {pair.first, pair.second} == set(contact.geom.tolist())
    assert_same(pair, contact)
    assert pair.slides == (contact.dim > 1 and contact.friction[0] > 1e-5)


def test_parameters_of_many_geoms_are_the_engines() -> None:
    """Six overlapping balls with everything at random: the engine's contacts, pair by pair."""
    random = np.random.default_rng(3)
    pick = lambda *choices: random.choice(choices)  # noqa: E731
    for _ in range(20):
        balls = [
            f'<geom name="g{name}" size=".1" friction="{random.uniform():.3f} .1 .01" solmix="{pick(0, 1, 2.5)}" '
            f'priority="{random.integers(3)}" condim="{pick(1, 3, 4, 6)}" margin="{random.uniform():.3f}" '
            f'solref="{pick(".02 1", ".05 .4", "-300 -4", "-50 0")}" '
            f'solimp="{random.uniform(0.1, 0.8):.3f} .9 .01 .5 2"/>'
            for name in "abcdef"
        ]
        bodies = "".join(
            f'<body name="{name}"><freejoint/>{ball}</body>' for name, ball in zip("abcdef", balls, strict=True)
        )
        contact = '<pair geom1="ge" geom2="gb" solref=".05 .4" friction=".2 .3"/><exclude body1="c" body2="d"/>'
        host = mujoco.MjModel.from_xml_string(
            f"<mujoco><worldbody>{bodies}</worldbody><contact>{contact}</contact></mujoco>"
        )
        data = mujoco.MjData(host)
        mujoco.mj_forward(host, data)
        ours = {frozenset((pair.first, pair.second)): pair for pair in contact_pairs(host)}
        assert ours.keys() == {frozenset(contact.geom.tolist()) for contact in data.contact} and len(ours) == 14
        for contact in data.contact:
            assert_same(ours[frozenset(contact.geom.tolist())], contact)


def assert_same(pair: ContactPair, contact: Any) -> None:
    assert pair.condim == contact.dim
    assert pair.margin == pytest.approx(contact.includemargin, abs=1e-15)
    for name in ("friction", "solref", "solimp"):
        np.testing.assert_allclose(getattr(pair, name), getattr(contact, name), rtol=1e-13, err_msg=name)


REFUSED = {("no friction", "pyramidal"), ("frictionless", "elliptic")}


@pytest.mark.parametrize(("override", "cone"), sorted({*itertools.product(OVERRIDES, CONES)} - REFUSED))
def test_a_static_load_finds_the_stiffness(override: str, cone: str) -> None:
    """The spring carries (1 - d) of the weight: s^2 K r = (1 - d) m g, with s = d / d_width, in every family."""
    host = host_of(override, cone)
    scene = scene_of(host)
    pair, mass = contact_pair(scene, "floor", "ball"), effective_mass(scene, "ball", "floor")
    for name, family in {**FAMILIES, "mjcf": None}.items():
        if family is not None and family.smoothing:  # other laws: test_law
            continue
        if family is None:
            contact, solimp = None, pair.solimp
            stiffness = stiffness_from_solref(pair.solref.tolist(), effective_mass=mass)[0]
        else:
            contact = family_model(name, scene, effective_mass=mass, stiffness=STIFFNESS if family.swept else None)
            solimp = np.asarray(contact.solimp)
            solref = np.asarray(contact.solref).tolist()
            stiffness = STIFFNESS if family.swept else stiffness_from_solref(solref, effective_mass=mass)[0]
        depth = depth_at_rest(host, contact, pair.margin)
        impedance = impedance_at(depth, solimp)
        spring = (impedance / solimp[1]) ** 2 * stiffness * depth
        assert spring == pytest.approx((1 - impedance) * MASS * GRAVITY, rel=1e-6 + 1e-15 / depth), name


def depth_at_rest(host: mujoco.MjModel, contact: ContactModel | None, margin: float) -> float:
    """Penetration from the margin on at which the ball does not accelerate, by bisection in the C engine [m]."""
    loaded = copy.copy(host)
    apply_to_host(loaded, contact)
    data, low, high = mujoco.MjData(loaded), 0.0, 100.0
    for _ in range(80):
        depth = (low + high) / 2
        mujoco.mj_resetData(loaded, data)
        data.qpos[0] = 0.1 + margin - depth
        mujoco.mj_forward(loaded, data)
        low, high = (low, depth) if data.qacc[0] > 0 else (depth, high)
    return depth


def impedance_at(depth: float, solimp: np.ndarray) -> float:
    """MuJoCo's d(r) for a power of 2 and a midpoint of 1/2."""
    assert tuple(solimp[3:]) == (0.5, 2.0)
    share = min(depth / solimp[2], 1.0)
    rise = 2 * share**2 if share < 0.5 else 1 - 2 * (1 - share) ** 2
    return float(solimp[0] + rise * (solimp[1] - solimp[0]))


def test_geoms_that_never_collide_have_no_contact() -> None:
    host = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><geom name="floor" type="plane" size="1 1 .1" contype="0" conaffinity="0"/>'
        '<body><freejoint/><geom name="ball" size=".1"/></body><body><freejoint/><geom size=".1"/></body>'
        "</worldbody></mujoco>"
    )
    with pytest.raises(ValueError, match="geoms 'ball' and 'floor' never collide"):
        effective_mass(scene_of(host), "ball", "floor")


@pytest.mark.parametrize("pair", [("ball", "floor"), ("floor", "ball")])
@pytest.mark.parametrize("override", ["explicit pair", "priority of the floor", "solmix"])
def test_the_stiffness_of_an_mjcf_is_that_of_its_contact(pair: tuple[str, str], override: str) -> None:
    scene = scene_of(host_of(override))
    task = make_task("pusher").replace(scene=scene, contact_pair=pair)
    ((point,), _) = family_grid(task, ["mjcf"])
    solref = contact_pair(scene, *pair).solref.tolist()
    assert point.stiffness == stiffness_from_solref(solref, effective_mass=effective_mass(scene, *pair))[0]


def test_a_pyramid_without_friction_is_refused() -> None:
    with pytest.raises(SceneError, match="contact of floor and ball has no friction, which makes a pyramidal cone"):
        scene_of(host_of("no friction"))
    scene_of(host_of("no friction", "elliptic"))
