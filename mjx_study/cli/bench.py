"""mjx-study bench."""

import argparse

from mjx_study.cli.options import configure_process, task_of, usage_errors
from mjx_study.cli.output import computing, print_report
from mjx_study.options.parser import MIDDLE, Parser

EPILOG = """\
Measures rollouts and gradients per second in a single run on this machine, and compares them with jax.grad through
mjx.step (with one solver iteration, all that it can differentiate), on as many threads as are fastest, and with the C
engine's centred mjd_transitionFD and an adjoint, measured on one thread and scaled as if threading were free.
"""


def add(command: Parser) -> None:
    command.add_task_options()
    command.add_contact_options(MIDDLE, many=False, analytic=False)
    command.add_option(
        "samples", many=False, interval="[1, 1e7]", default=1000, line="samples in the batch that is timed"
    )


def run(options: argparse.Namespace) -> int:
    from mjx_study.bench import check_bench, run_bench
    from mjx_study.tasks.contact_grid import single_contact

    with usage_errors():
        configure_process(options)
        task = task_of(options)
        given = options.contact, options.stiffness, options.damping, options.smoothing
        contact, messages = single_contact(task, *given)
        check_bench(task, options.samples)
    with computing() as progress:
        report = run_bench(task, options.samples, contact, progress, options.seed or 0)
    lines = [*report.lines(), *(f"warning: {message}" for message in messages)]
    return print_report(options, report.as_json() | {"warnings": list(messages)}, lines)
