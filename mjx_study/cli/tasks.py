"""mjx-study tasks."""

import argparse

from mjx_study.choices import TASK_DESCRIPTIONS, registered_tasks
from mjx_study.cli.options import configure_process, usage_errors
from mjx_study.cli.output import print_report
from mjx_study.options.parser import Parser

EPILOG = ""


def add(command: Parser) -> None:
    """Add no options beyond --json."""


def run(options: argparse.Namespace) -> int:
    described = TASK_DESCRIPTIONS | dict.fromkeys(registered_tasks(), "registered by an installed package")
    lines, rows = [f"{name:<25} {description}" for name, description in described.items()], []
    if options.json:
        from mjx_study.tasks import make_task

        with usage_errors():
            configure_process(options)
            tasks = {name: make_task(name) for name in described}
        for name, task in tasks.items():
            mass = task.effective_mass if task.contact_pair else None
            row = {"name": name, "params": task.policy.num_params, "horizon": task.horizon, "sigma": task.sigma}
            rows.append(row | {"effective_mass": mass, "description": task.description})
    return print_report(options, {"tasks": rows}, lines)
