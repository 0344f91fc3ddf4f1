"""mjx-study bench."""

import argparse

from mjx_study.cli.options import configure_process, task_of, usage_errors
from mjx_study.cli.output import computing, print_report
from mjx_study.options.parser import Parser

EPILOG = """\
Rates in one run on this machine: rollouts and gradients, against jax.grad through mjx.step (with the one solver
iteration that it can differentiate) and against the C engine's centred mjd_transitionFD with an adjoint, on as many
threads.
"""


def add(command: Parser) -> None:
    command.add_task_options()
    command.add_option(
        "samples", many=False, interval="[1, 1e7]", default=1000, line="samples in the batch that is timed"
    )


def run(options: argparse.Namespace) -> int:
    from mjx_study.bench import plan_bench, run_bench

    with usage_errors():
        configure_process(options)
        plan = plan_bench(task_of(options), options.samples)
    with computing() as progress:
        report = run_bench(plan, progress)
    return print_report(options, report.as_json(), report.lines())
