"""Measure one cell, in the environment of its engine: prints one line of JSON. What is undecided is measured once more,
on a grid four times as fine.

python -m experiments.engines.worker ENGINE SCENE TIMESTEP [quick]
"""

import json
import os
import sys
from importlib import import_module, metadata

from experiments.engines.catalog import ENGINES
from experiments.engines.judge import FEW, MANY, MORE, measure, verdict
from experiments.engines.scenes import SCENES, CannotError


def main() -> None:
    """Run the command line."""
    # Before JAX is imported: models put on the device earlier would be float32, whose differences mislead.
    os.environ["JAX_ENABLE_X64"] = "1"
    name, scene, timestep = sys.argv[1:4]
    engine = ENGINES[name]
    counts = FEW if sys.argv[4:] else MANY
    try:
        build = import_module(f"experiments.engines.adapters.{engine.adapter}").build
        simulate = build(SCENES[scene], float(timestep), engine.variant)
        found = measure(simulate, SCENES[scene], counts, single=engine.single)
        if counts is MANY and verdict(found | {"scene": scene}) == "unknown":
            found = measure(simulate, SCENES[scene], MORE, single=engine.single)
    except CannotError as error:
        found = {"error": str(error)}
    versions = {package: metadata.version(package) for package in ("jax", "mujoco") if package in sys.modules}
    print(json.dumps({"engine": name, "scene": scene, "timestep": float(timestep), **found, "versions": versions}))


if __name__ == "__main__":
    main()
