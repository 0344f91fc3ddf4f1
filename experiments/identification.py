"""Tables of docs/identification.md: parameters of contact and masses from ten simulated tosses.

    python -m experiments.identification

Ten minutes on two cores. A spinning ball is thrown onto a cart that slides, so that friction moves the cart, and what
is recorded every 2 ms are the positions of both and the ball's angle, with noise.
"""

import time
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import mjx_study
from experiments.pages import markdown_row
from mjx_study.identification import engine_trajectories, identify, profile, trajectories, with_masses
from mjx_study.simulation._mjx import mjx

MJCF: Final = """<mujoco><option timestep="0.002"/><worldbody>
  <body name="cart"><joint type="slide" axis="1 0 0"/>
    <geom name="deck" type="box" size="3 0.2 0.05" pos="0 0 -0.05" mass="1"/></body>
  <body name="ball">
    <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint type="hinge" axis="0 1 0"/>
    <geom name="ball" size="0.05" mass="0.5" friction="0.2" solref="0.02 0.5" priority="1"/></body>
</worldbody></mujoco>"""
TRUTH: Final = {"friction": 0.2, "time constant": 0.02, "damping ratio": 0.5, "mass": 0.5}
GUESS: Final = {name: 1.3 * value for name, value in TRUTH.items()}
MORE: Final = {**TRUTH, "mass of cart": 1.0, "solimp[0]": 0.9, "solimp[1]": 0.95, "width": 0.001}
DEVIATION: Final = np.array([1e-3, 1e-3, 1e-3, 1e-2])
"""Of the noise: positions [m] of cart and ball, angle of the ball [rad]."""
TOSSES, STEPS, NOISES = 10, 300, 8

host = mujoco.MjModel.from_xml_string(MJCF)


def changed(model: mjx.Model, values: Any) -> mjx.Model:
    """Put parameters into the model; those that are not given stay."""
    v = {**MORE, **values}
    model = model.replace(
        geom_friction=model.geom_friction.at[1, 0].set(v["friction"]),
        geom_solref=model.geom_solref.at[1].set(jnp.stack([jnp.asarray(v["time constant"]), v["damping ratio"]])),
        geom_solimp=model.geom_solimp.at[1, :3].set(
            jnp.stack([jnp.asarray(v["solimp[0]"]), v["solimp[1]"], v["width"]])
        ),
    )
    return with_masses(model, mjx.make_data(host), jnp.stack([jnp.asarray(0.0), v["mass of cart"], v["mass"]]))


def changed_host(model: mujoco.MjModel, values: Any) -> None:
    """`changed` for the C engine."""
    model.geom_friction[1, 0], model.geom_solref[1] = (
        values["friction"],
        [values["time constant"], values["damping ratio"]],
    )
    model.body_inertia[2] *= values["mass"] / model.body_mass[2]
    model.body_mass[2] = values["mass"]


def thrown(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities at the start: cart, ball sideways and upwards, angle."""
    zero = np.zeros(count)
    qpos = [zero, rng.uniform(-0.3, 0.3, count), rng.uniform(0.1, 0.3, count), zero]
    spin = rng.uniform(40, 100, count) * rng.choice([-1, 1], count)
    return np.stack(qpos, 1), np.stack([zero, rng.uniform(-1, 1, count), rng.uniform(-1.5, 0, count), spin], 1)


def main() -> None:
    """Print the tables."""
    mjx_study.configure()
    rng = np.random.default_rng(0)
    starts = thrown(TOSSES, rng)
    model, data = mjx.put_model(host), mjx.make_data(host)
    plain, term = (trajectories(model, data, changed, starts, STEPS, onset=onset) for onset in ("none", "linear"))
    engine = engine_trajectories(host, changed_host, starts, STEPS)
    exact = engine(TRUTH)
    records = [exact + DEVIATION * rng.standard_normal(exact.shape) for _ in range(NOISES)]
    methods = {
        "first order": (plain, "exact"),
        "first order with the onset term": (term, "exact"),
        "zeroth order": (plain, "smoothed"),
        "C engine, Nelder-Mead": (engine, "none"),
    }
    print(markdown_row("method", *TRUTH, "largest error", "misfit", "predictions", "seconds", "converged"))
    for name, (predict, derivatives) in methods.items():
        fits, began = [], 0.0
        for index, record in enumerate(records):
            began = time.perf_counter() if index == 1 else began
            fits.append(identify(predict, record, DEVIATION, GUESS, derivatives=derivatives))
        seconds = (time.perf_counter() - began) / (NOISES - 1)
        shown = [f"{fits[0].values[key]:.4g} ± {196 * error:.2g} %" for key, error in fits[0].standard_errors.items()]
        worst = {key: max(abs(fit.values[key] / true - 1) for fit in fits) for key, true in TRUTH.items()}
        largest = f"{100 * max(worst.values()):.2g} % ({max(worst, key=lambda key: worst[key])})"
        gain = np.mean([fit.misfit - fit.size for fit in fits])
        cost = np.mean([fit.predictions for fit in fits])
        row = markdown_row(
            name,
            *shown,
            largest,
            f"{gain:.1f}",
            f"{cost:.0f}",
            f"{seconds:.1f}",
            f"{sum(fit.converged for fit in fits)}/{NOISES}",
        )
        print(row, flush=True)
    print("\nFisher information of eight parameters: standard errors of directions, over the logarithms")
    for onset, predict in (("first order", plain), ("with the term", term)):
        fit = identify(predict, exact, DEVIATION, MORE, iterations=0)
        print(onset, {key: f"{100 * error:.2g} %" for key, error in fit.standard_errors.items()})
        for error, weights in zip(*fit.directions, strict=True):
            parts = [
                f"{weight:+.2f} {key}" for key, weight in zip(fit.values, weights, strict=True) if abs(weight) > 0.1
            ]
            print(markdown_row(f"{100 * error:.2g} %", ", ".join(parts)), flush=True)
    everything = identify(plain, records[0], DEVIATION, {key: MORE[key] for key in (*TRUTH, "mass of cart")})
    for name, factors in (("mass of cart", (0.5, 0.8, 1.25, 2.0)), ("friction", (0.97, 0.99, 1.01, 1.03))):
        found = profile(plain, records[0], DEVIATION, everything, name, everything.values[name] * np.array(factors))
        print("profile of", name, dict(zip(factors, found.round(2).tolist(), strict=True)), flush=True)
    averaged(model, data, np.random.default_rng(1))


def averaged(model: mjx.Model, data: mjx.Data, rng: np.random.Generator, count: int = 400) -> None:
    """Print derivatives of the mean over unknown starts, of the height at the end by the logarithms of parameters."""
    starts = thrown(count, rng)
    by_onset = [
        trajectories(model, data, changed, starts, STEPS, lambda data: data.qpos[2], onset=onset)
        for onset in ("none", "linear")
    ]

    def ends(predict: Any, shift: Any) -> Any:
        return predict({name: value * jnp.exp(shift[index]) for index, (name, value) in enumerate(TRUTH.items())})[
            :, -1
        ]

    means = [np.asarray(jax.jacfwd(lambda shift, p=p: ends(p, shift))(jnp.zeros(4))) for p in by_onset]
    for index, name in enumerate(TRUTH):
        step = 0.05 * np.eye(4)[index]
        difference = np.asarray(ends(by_onset[0], step) - ends(by_onset[0], -step)) / 0.1
        cells = [
            f"{1e3 * each.mean():.2f} ± {1e3 * each.std() / count**0.5:.2f}"
            for each in (difference, *(m[:, index] for m in means))
        ]
        gaps = [
            f"{1e3 * (m[:, index] - difference).mean():.2f} ± {1e3 * (m[:, index] - difference).std() / count**0.5:.2f}"
            for m in means
        ]
        print(markdown_row(name, *cells, *gaps), flush=True)


if __name__ == "__main__":
    main()
