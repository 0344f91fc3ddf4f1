"""Table of docs/contact-models.md: the mean of first-order gradients of a toss under every contact law.

    python -m experiments.laws

A few minutes on one core, with the extra `laws`. A ball of 1 kg slides at 1 m/s and falls at 1 m/s on a plane; its cost
is quadratic in its final height and linear in its place. The gap is normal with a mean of 50 mm, and the slope of the
mean cost over it is that of the sum over the score.
"""

import dataclasses
import time
from functools import partial
from typing import Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import mjx_study as study
from experiments.pages import markdown_row
from mjx_study.choices import DEFAULT_SOLIMP, DEFAULT_SOLREF, FAMILIES
from mjx_study.simulation.contact import ContactModel, apply_contact, contact_model
from mjx_study.simulation.dynamics import State, step
from mjx_study.simulation.law import LAWS, make_law
from mjx_study.simulation.scene import Scene, put_scene
from mjx_study.table import markdown_table

TIMESTEP, SECONDS, GAP, SPREAD, POINTS = 0.005, 0.4, 0.05, 0.005, 1000  # [s], [s], [m], [m]
TOSSED: Final = f"""<mujoco><option timestep="{TIMESTEP}"/>
  <worldbody><geom name="floor" type="plane" size="20 20 1" condim="3"/>
  <body pos="0 0 0.1"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
    <geom name="ball" size="0.1" mass="1" condim="3"/></body></worldbody></mujoco>"""
X, Z = 0, 1


def toss(scene: Scene, contact: ContactModel, gap: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the cost of a fall through a gap [m], and the largest relative residual of the solver."""
    model, rest = apply_contact(scene.model, contact), study.initial_state(scene)
    height = rest.qpos[Z]
    start = dataclasses.replace(rest, qpos=rest.qpos.at[Z].add(gap), qvel=rest.qvel.at[X].set(1.0).at[Z].set(-1.0))

    def advance(state: State, _: None) -> tuple[State, jax.Array]:
        return step(scene, model, state, jnp.zeros(0))

    last, residuals = jax.lax.scan(advance, start, None, length=round(SECONDS / TIMESTEP))
    above = last.qpos[Z] - height
    return 100 * above**2 + last.qpos[X] + above + 0.1, residuals.max()


def main() -> None:
    """Print the table."""
    jax.config.update("jax_enable_x64", True)
    scene = put_scene(mujoco.MjModel.from_xml_string(TOSSED), "toss")
    usual = contact_model(DEFAULT_SOLREF, DEFAULT_SOLIMP, scene=scene)
    gaps = 2 * GAP * (np.arange(POINTS) + 0.5) / POINTS
    score = (gaps - GAP) / SPREAD
    weights = np.exp(-(score**2) / 2) / np.exp(-(score**2) / 2).sum()
    print(markdown_table([], ("law", "slope", "E[FoBG]", "residual", "ms per gradient")))
    for name in (None, *LAWS):
        contact = dataclasses.replace(usual, law=None if name is None else make_law(name, FAMILIES[name].smoothing))
        run = jax.jit(jax.vmap(jax.value_and_grad(partial(toss, scene, contact), has_aux=True)))
        jax.block_until_ready(run(gaps))
        begin = time.perf_counter()
        (costs, residuals), slopes = jax.device_get(run(gaps))
        numbers = (weights * costs * score).sum() / SPREAD, (weights * slopes).sum()
        took = 1e3 * (time.perf_counter() - begin) / POINTS
        row = (*(f"{each:.4f}" for each in numbers), f"{residuals.max():.0e}", f"{took:.2f}")
        print(markdown_row(name or "MuJoCo's default", *row), flush=True)


if __name__ == "__main__":
    main()
