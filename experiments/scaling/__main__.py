"""Measurements and figure of docs/scaling.md and docs/performance.md.

    python -m experiments.scaling engine --workers 20 --cells 10000 --seconds 0.1
    python -m experiments.scaling cost --seconds 600 --output experiments/data/scaling_cpu.json
    python -m experiments.scaling devices --tasks pusher tennis --samples 100000 1000000
    python -m experiments.scaling figure experiments/data/scaling_cpu.json experiments/data/scaling_gpu.json

`engine` runs cells that sleep on local workers. `cost` times rollouts and gradients on whatever JAX finds (leave
JAX_PLATFORMS unset on an accelerator); each measurement alternates with the same rollouts of the pusher, and the ratio
is what counts. `devices` compares one device with all, and the results bit for bit. All but `figure` print JSON.
"""

import argparse
import json
from pathlib import Path

from experiments.pages import save_figure
from experiments.scaling.cost import measure_cost, measure_devices
from experiments.scaling.engine import measure_engine
from experiments.scaling.figure import scaling_figure


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    engine = commands.add_parser("engine")
    engine.add_argument("--workers", type=int, default=20)
    engine.add_argument("--cells", type=int, default=10_000)
    engine.add_argument("--seconds", type=float, default=0.1, help="sleep of each cell")
    engine.add_argument("--programs", type=int, default=20)
    engine.add_argument("--numbers", type=int, default=1000, help="numbers in the arrays of a cell")
    cost = commands.add_parser("cost")
    cost.add_argument("--seconds", type=float, default=600, help="time limit; processor time on CPUs")
    cost.add_argument("--axes", nargs="+", default=[], help="axes to measure (again); all that are missing by default")
    cost.add_argument("--output", type=Path, required=True)
    devices = commands.add_parser("devices")
    devices.add_argument("--tasks", nargs="+", default=["pusher", "tennis"])
    devices.add_argument("--samples", type=int, nargs="+", default=[100_000, 1_000_000])
    figure = commands.add_parser("figure")
    figure.add_argument("measured", type=Path, nargs="+")
    options = vars(parser.parse_args())
    command = options.pop("command")
    if command == "engine":
        print(json.dumps(measure_engine(**options)))
    elif command == "figure":
        save_figure(scaling_figure([json.loads(path.read_text()) for path in options["measured"]]), "scaling")
    else:
        {"cost": measure_cost, "devices": measure_devices}[command](**options)


if __name__ == "__main__":
    main()
