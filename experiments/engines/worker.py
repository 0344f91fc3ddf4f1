"""Measure one cell, in the environment of its engine: prints one line of JSON. What is undecided is measured once more,
on a grid four times as fine, unless the two ways to the mean are further apart than `APART` slopes.

python -m experiments.engines.worker ENGINE SCENE TIMESTEP [quick]
"""

import json
import os
import sys
from importlib import import_module, metadata

from experiments.engines.catalog import ENGINES
from experiments.engines.judge import FEW, MANY, MORE, measure, verdict
from experiments.engines.scenes import CannotError, scene_named

VERSIONED = ("jax", "mujoco", "torch")  # packages whose version a cell records
APART = 10.0


def main() -> None:
    """Run the command line."""
    # Before JAX is imported: models put on the device earlier would be float32, whose differences mislead.
    os.environ["JAX_ENABLE_X64"] = "1"
    name, where, timestep, *how = sys.argv[1:]
    engine, scene = ENGINES[name], scene_named(where)
    counts = FEW if "quick" in how or engine.slow else MANY
    try:
        build = import_module(f"experiments.engines.adapters.{engine.adapter}").build
        simulate = build(scene, float(timestep), engine.variant)
        found = measure(simulate, scene, counts, single=engine.single)
        near = abs(found["mean"] - found["mean_of_strata"]) < APART * abs(found["slope"])
        if counts is MANY and near and verdict(found | {"scene": where}) == "unknown":
            found = measure(simulate, scene, MORE, single=engine.single)
    except CannotError as error:
        found = {"error": str(error)}
    versions = {package: metadata.version(package) for package in VERSIONED if package in sys.modules}
    print(json.dumps({"engine": name, "scene": where, "timestep": float(timestep), **found, "versions": versions}))


if __name__ == "__main__":
    main()
