"""Write data/reference-gradients.npz and .json: entries that two independent ways agree on, from MuJoCo's contact.

python -m experiments.engines.certify [SCENE ...]

One way is this project's step and its derivative, with the slope by the score function; the other the C engine, with
differences of rollouts, and of the mean over the same noise. Both cover the noise by a grid, the one's between
the other's. What differs by more than `ALLOWED` is left out, counted and named.
"""

import sys
from typing import Any, Final

import mujoco
import numpy as np

from experiments import DATA, write_json
from experiments.engines.adapters import mujoco_family
from experiments.engines.references import NUMBERS
from experiments.engines.scenes import SCENES, TIMESTEPS, Scene, mjcf, mjcf_index, mjcf_state

STEM: Final = DATA / "reference-gradients"
SHIFTS: Final = np.linspace(-1.5, 1.5, 13) + 0.0137
"""Of an entry's parameter from the scene's, in standard deviations of the noise; round ones hit steps' boundaries."""
DENSE, REACH = 160, 5
"""Points of the grid per standard deviation of the noise, and the noise's reach in standard deviations."""
ALLOWED: Final = {"value": 1e-6, "derivative": 1e-4, "mean_value": 5e-3, "mean_derivative": 0.02, "slope": 0.02}
"""Relative uncertainty that an entry may have; of positions 1e-6 m."""
HOW: Final = {
    "value": "this project's step; MuJoCo's C engine",
    "derivative": "this project's step; differences of the C engine",
    "mean_value": "grid, this project's step; grid between, C engine; every second point",
    "mean_derivative": "grid, derivative of this project's step; grid between, differences of the C engine; halves",
    "slope": "score function, grid, this project's step; differences of the mean, same noise, C engine; halves",
}


def native(
    scene: Scene, timestep: float, thetas: np.ndarray, model: mujoco.MjModel | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the C engine's costs [points] and positions [points, bodies, 3], its solver run to convergence.

    `model`: in place of the scene's.
    """
    model = model or mujoco.MjModel.from_xml_string(mjcf(scene, timestep))
    model.opt.tolerance, model.opt.iterations, model.opt.ls_tolerance = 0, 200, 1e-6
    data = mujoco.MjData(model)
    is_velocity, index = mjcf_index(scene)
    positions = []
    for theta in thetas:
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = mjcf_state(scene, scene.center)
        (data.qvel if is_velocity else data.qpos)[index] = theta
        mujoco.mj_step(model, data, scene.steps(timestep))
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        positions.append(data.xipos[1:].copy())
    return np.array([scene.cost(each) for each in positions]), np.array(positions)


def central(scene: Scene, timestep: float, thetas: np.ndarray) -> np.ndarray:
    """Derivative of the cost in the C engine, [points]: the median of differences over three adjoining intervals.

    A jump between two parameters spoils one interval, and the median is another's.
    """
    reach = 1e-5 * scene.sigma
    values = [native(scene, timestep, thetas + by * reach)[0] for by in (-1.5, -0.5, 0.5, 1.5)]
    return np.median(np.diff(values, axis=0), axis=0) / reach


def entries(scene: Scene, timestep: float) -> list[dict[str, Any]]:
    """Return a scene's entries, with the uncertainty of each number: the largest difference between its ways."""
    simulate = mujoco_family.build(scene, timestep, "plain")
    half = round((SHIFTS[-1] + REACH) * DENSE)
    grid = (np.arange(-half, half + 1) + 0.2718) / DENSE
    other = grid + 0.5 / DENSE
    ours = simulate(scene.center + scene.sigma * grid)
    theirs, slopes = (way(scene, timestep, scene.center + scene.sigma * other) for way in (native, central))
    thetas = scene.center + scene.sigma * SHIFTS
    at, host, differences = simulate(thetas), native(scene, timestep, thetas), central(scene, timestep, thetas)
    found = []
    for i, shift in enumerate(SHIFTS):

        def mean(z, values, by=0.0, every=1, shift=shift):
            weights = np.exp(-((z[::every] - shift - by) ** 2) / 2)
            return float(weights @ values[::every] / weights.sum())

        def score(every, shift=shift):
            z = grid[::every] - shift
            weights = np.exp(-(z**2) / 2)
            return float((weights * z) @ ours.values[::every] / (weights @ z**2) / scene.sigma)

        def shifted(by):
            return (mean(other, theirs[0], by) - mean(other, theirs[0], -by)) / (2 * by * scene.sigma)

        # Two shifts cancel the second order's error of a central difference.
        ways = {
            "value": (float(at.values[i]), float(host[0][i])),
            "derivative": (float(at.derivatives[i]), float(differences[i])),
            "mean_value": (mean(grid, ours.values), mean(other, theirs[0]), mean(grid, ours.values, every=2)),
            "mean_derivative": (
                mean(grid, ours.derivatives),
                mean(other, slopes),
                mean(grid, ours.derivatives, every=2),
            ),
            "slope": (score(1), (4 * shifted(0.1) - shifted(0.2)) / 3, score(2)),
        }
        errors = {name: float(np.ptp(each)) for name, each in ways.items()}
        errors["position"] = float(np.max(np.abs(at.positions[i] - host[1][i])))
        entry = {name: each[0] for name, each in ways.items()} | {"uncertainty": errors, "position": at.positions[i]}
        found.append(entry | {"theta": float(thetas[i]), "sigma": scene.sigma, "timestep": timestep})
    return found


def faults(entry: dict[str, Any]) -> list[str]:
    """Return the numbers of an entry that its ways do not agree on."""
    errors = entry["uncertainty"]
    scale = {name: abs(entry[name]) + 1e-3 * abs(entry["value"]) for name in NUMBERS}
    wrong = [name for name in NUMBERS if not errors[name] <= ALLOWED[name] * scale[name]]
    return wrong + ["position"] * (not errors["position"] <= 1e-6)


def describe(name: str) -> dict[str, Any]:
    """Return what another project needs to simulate a scene."""
    scene = SCENES[name]
    qpos, qvel = mjcf_state(scene, scene.center)
    is_velocity, at = mjcf_index(scene)
    linear, quadratic, target = scene.coefficients().tolist()
    return {
        "mjcf": {str(timestep): mjcf(scene, timestep) for timestep in TIMESTEPS},
        "steps": {str(timestep): scene.steps(timestep) for timestep in TIMESTEPS},
        "qpos": qpos.tolist(),
        "qvel": qvel.tolist(),
        "theta": ["qvel" if is_velocity else "qpos", at],
        "cost": {"linear": linear, "quadratic": quadratic, "target": target},
        "bodies": len(scene.bodies),
    }


def main() -> None:
    """Measure the scenes named, or all, and write what is certified of them."""
    kept, names = [], sys.argv[1:] or list(SCENES)
    for name in names:
        for timestep in TIMESTEPS:
            every = entries(SCENES[name], timestep)
            good = [entry for entry in every if not faults(entry)]
            kept += [entry | {"scene": name} for entry in good]
            left = sorted({fault for entry in every for fault in faults(entry)})
            worst = {n: max(e["uncertainty"][n] for e in every) for n in (*NUMBERS, "position")}
            print(f"{name} {timestep}: {len(good)} of {len(every)} certified", *left, worst, flush=True)
    if not kept:
        sys.exit("nothing is certified")
    bodies = max(len(entry["position"]) for entry in kept)
    padded = [np.pad(entry["position"], ((0, bodies - len(entry["position"])), (0, 0))) for entry in kept]
    columns = {name: [entry[name] for entry in kept] for name in (*NUMBERS, "theta", "sigma", "timestep")}
    uncertain = {
        f"{name}_uncertainty": [entry["uncertainty"][name] for entry in kept] for name in (*NUMBERS, "position")
    }
    arrays: dict[str, Any] = {name: np.array(each) for name, each in {**columns, **uncertain}.items()}
    np.savez_compressed(STEM.with_suffix(".npz"), position=np.array(padded), **arrays)
    index = {
        "made_with": f"MuJoCo {mujoco.__version__}, float64",
        "certified_by": HOW,
        "scenes": {name: describe(name) for name in names},
        "entries": [{"scene": entry["scene"]} for entry in kept],
    }
    write_json(STEM.with_suffix(".json"), index)
    print(f"{len(kept)} entries")


if __name__ == "__main__":
    main()
