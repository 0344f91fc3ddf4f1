"""Measure one cell, in the environment of its engine: prints one line of JSON.

python -m experiments.engines.worker ENGINE SCENE TIMESTEP [quick]
"""

import json
import os
import sys
from importlib import import_module

from experiments.engines.catalog import ENGINES
from experiments.engines.judge import FEW, MANY, measure
from experiments.engines.scenes import SCENES, CannotError


def main() -> None:
    """Run the command line."""
    # Before JAX is imported: models put on the device earlier would be float32, whose differences mislead.
    os.environ["JAX_ENABLE_X64"] = "1"
    name, scene, timestep = sys.argv[1:4]
    engine = ENGINES[name]
    build = import_module(f"experiments.engines.adapters.{engine.adapter}").build
    counts = FEW if sys.argv[4:] or engine.slow else MANY
    try:
        found = measure(
            build(SCENES[scene], float(timestep), engine.variant), SCENES[scene], counts, single=engine.single
        )
    except CannotError as error:
        found = {"error": str(error), "verdict": "none" if "derivative" in str(error) else "unknown"}
    print(json.dumps({"engine": name, "scene": scene, "timestep": float(timestep), **found}))


if __name__ == "__main__":
    main()
