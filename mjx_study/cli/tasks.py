"""mjx-study tasks."""

import argparse
from typing import Any

from mjx_study.choices import TASK_DESCRIPTIONS
from mjx_study.cli.options import configure_process, usage_errors
from mjx_study.cli.output import print_report
from mjx_study.options.parser import Parser

EPILOG = ""


def add(command: Parser) -> None:
    """Add no options beyond --json."""


def run(options: argparse.Namespace) -> int:
    lines = [f"{name:<25} {description}" for name, description in TASK_DESCRIPTIONS.items()]
    return print_report(options, {"tasks": _rows(options)} if options.json else {}, lines)


def _rows(options: argparse.Namespace) -> list[dict[str, Any]]:
    from mjx_study.tasks import make_task

    with usage_errors():
        configure_process(options)
    tasks = [make_task(name) for name in TASK_DESCRIPTIONS]
    return [
        {"name": task.name, "params": task.policy.num_params, "horizon": task.horizon, "sigma": task.sigma}
        | {"effective_mass": task.effective_mass if task.contact_pair else None, "description": task.description}
        for task in tasks
    ]
