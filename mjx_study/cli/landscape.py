"""mjx-study landscape."""

import argparse
import json
from pathlib import Path

import numpy as np

from mjx_study.cli.options import (
    Commands,
    add_command,
    add_contact_options,
    add_options,
    add_task_options,
    attempt,
    computing,
    configure_process,
    finish,
    print_report,
    task_of,
    usage_errors,
)
from mjx_study.cli.parameters import add_theta_option, theta_of
from mjx_study.disk import prepare_folder, write_whole
from mjx_study.plots.curves import plot_landscape
from mjx_study.plots.style import save_figure
from mjx_study.study.landscapes import Landscape, LandscapeConfig, landscape, plan_landscape
from mjx_study.table import format_table

EPILOG = """\
examples:
  mjx-study landscape ball_wall --output out             the launch angle's whole range, reference and MJX
  mjx-study landscape momentum_transfer --contact penalty,mujoco_default --stiffness 3000,100000
  mjx-study landscape pusher --direction 0 --span=-2,2   the first of 200 forces

Top row of the figure: the cost without noise, and the mean cost with noise (its smoothed objective) with a 95 % band.
Bottom row: the mean of ZoBG and of FoBG along the line, with theirs. Where the smoothed objective has a slope that the
mean of FoBG does not have, the cost jumps: a first-order gradient does not see jumps.

A decision of one number, made once from a fixed start, also gets both slopes without sampling error, by quadrature over
1500 rollouts and gradients of each contact model (more where --noise has heavy tails), whatever --points and --samples.
"""
FIELDS = "task contact stiffness damping points span direction samples sigma noise seed".split()


def add(commands: Commands) -> None:
    """Register the command."""
    summary = "draw a decision's cost, its smoothed cost and the slope that each estimator sees"
    command = add_command(commands, "landscape", summary, run, EPILOG)
    add_task_options(command)
    add_contact_options(command, analytic=False, stiffness="the middle one of the task's sweep")
    add_theta_option(command, "parameters that the line goes through")
    add_options(command, LandscapeConfig, "noise", "samples", "points", "span", "direction")
    command.add_argument("--no-reference", action="store_true", help="leave out the analytic reference")
    command.add_argument("--output", type=Path, metavar="DIR", help="write the figure and the numbers to this folder")


def run(options: argparse.Namespace) -> int:
    """Draw, print, and write where an output folder is given."""
    with usage_errors():
        configure_process(options)
        fields = {name: getattr(options, name) for name in FIELDS}
        given = {name: value for name, value in fields.items() if value is not None}
        config = LandscapeConfig(**given, theta=theta_of(options), reference=not options.no_reference)
        plan = plan_landscape(config, task_of(options))
        folder = None if options.output is None else prepare_folder(options.output)
    with computing() as progress:
        result = landscape(plan, progress)
    written, unwritten = ([], None) if folder is None else attempt(lambda: _save(result, folder))
    hint = [] if unwritten else _written(written)
    print_report(options, result.as_json(), [*_lines(result), *hint])
    return finish(unwritten)


def _save(result: Landscape, folder: Path) -> list[Path]:
    text = json.dumps(result.as_json(), indent=1, allow_nan=False) + "\n"
    return [
        write_whole(folder / "landscape.json", lambda file: file.write(text.encode())),
        *save_figure(plot_landscape(result), folder, "landscape"),
    ]


def _lines(result: Landscape) -> list[str]:
    config = result.config
    low, high = result.position[[0, -1]]
    where = "theta" if len(result.direction) == 1 else f"t, along direction {config.direction},"
    header = [
        f"{config.task}: {where} from {low:.3g} to {high:.3g} in {config.points} points, sigma {config.sigma:g},",
        f"{config.samples} samples at each, seed {config.seed}, {result.environment['precision']}",
        "",
        "where the mean cost is least on the line:",
    ]
    best = [int(np.nanargmin(curve.smoothed)) for curve in result.curves]
    rows = [
        [curve.label, f"{result.position[index]:.3g}", f"{curve.smoothed[index]:.4g} ± {curve.smoothed_se[index]:.1g}"]
        for curve, index in zip(result.curves, best, strict=True)
    ]
    lines = [*header, *format_table(rows, ["contact", "at", "mean cost"]), "", *result.findings()]
    for curve in result.curves:
        if curve.nonfinite:
            lines.append(f"warning: {curve.label}: {curve.nonfinite} samples are not finite and were left out")
    return lines + [f"warning: {message}" for message in result.warnings]


def _written(paths: list[Path]) -> list[str]:
    return [f"written: {', '.join(map(str, paths))}"] if paths else ["add --output DIR for a figure and the numbers"]
