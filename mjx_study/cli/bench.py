"""mjx-study bench."""

import argparse

from mjx_study import bench as benchmark
from mjx_study.cli.options import (
    Commands,
    add_command,
    add_option,
    add_task_options,
    computing,
    configure_process,
    print_report,
    task_of,
    usage_errors,
)
from mjx_study.option import OPTIONS

EPILOG = """\
Rates in one run on this machine: rollouts and gradients, against jax.grad through mjx.step (with the one solver
iteration that it can differentiate) and against the C engine's centred mjd_transitionFD with an adjoint, on as many
threads.
"""


def add(commands: Commands) -> None:
    """Register the command."""
    command = add_command(commands, "bench", "measure what rollouts and gradients cost here", run, EPILOG)
    add_task_options(command)
    add_option(command, OPTIONS["samples"], 1000)


def run(options: argparse.Namespace) -> int:
    """Measure and print."""
    with usage_errors():
        configure_process(options)
        plan = benchmark.plan_bench(task_of(options), options.samples)
    with computing() as progress:
        report = benchmark.bench(plan, progress)
    print_report(options, report.as_json(), report.lines())
    return 0
