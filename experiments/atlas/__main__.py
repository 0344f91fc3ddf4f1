"""Atlas: where are first-order gradients worth having, over more than 10,000 cells, for docs/atlas.md.

    python -m experiments.atlas run --output DIR [--workers N] [--seconds S]    # cells that DIR/atlas.npz lacks
    python -m experiments.atlas run --families LAWS --output DIR    # of contact laws other than MuJoCo's (extra `laws`)
    python -m experiments.atlas jumps    # why means are off under them, by quadrature; to data/atlas_jumps.jsonl
    python -m experiments.atlas page [DIR/atlas.npz]    # adds them to data/atlas.npz; writes docs/atlas.md

A cell is one task at one timestep under one contact model, with one sigma and one theta, on random numbers of its own.
All that differs between the cells of a task and timestep is traced, so that they share two compiled programs; several
cells run in one call.
"""

import argparse
import math
import os
from pathlib import Path

from experiments.atlas.design import FAMILIES, LAWS
from experiments.atlas.run import RESULTS, merge, run
from mjx_study.runtime import configure


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    runner = commands.add_parser("run")
    runner.add_argument("--output", type=Path, required=True)
    runner.add_argument("--workers", type=int, default=os.cpu_count())
    runner.add_argument("--seconds", type=float, default=math.inf)
    runner.add_argument("--cells", type=int, help="number of cells of each job, for a pilot; all by default")
    runner.add_argument("--only", nargs="*", default=[""], help="parts of jobs' names, such as 'pusher at 0.01'")
    given = f"contact families; MUJOCO ({', '.join(FAMILIES)}; the default) or LAWS ({', '.join(LAWS)}) for all of them"
    groups = {"MUJOCO": FAMILIES, "LAWS": LAWS}
    runner.add_argument("--families", nargs="+", choices=(*groups, *FAMILIES, *LAWS), default=["MUJOCO"], help=given)
    commands.add_parser("jumps")
    page = commands.add_parser("page")
    page.add_argument("results", type=Path, nargs="?", default=RESULTS)
    options = parser.parse_args()
    if options.command == "run":
        families = [each for name in options.families for each in groups.get(name, [name])]
        run(options.output, options.workers, options.seconds, options.cells, options.only, families)
        return
    if options.command == "jumps":
        from experiments.atlas.jumps import measure_jumps

        configure(cpu_devices=1)
        measure_jumps()
        return
    from experiments.atlas.page import write_page  # not above: matplotlib takes a second in every worker

    if options.results != RESULTS:
        merge(options.results)
    write_page()


if __name__ == "__main__":
    main()
