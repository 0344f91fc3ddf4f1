"""mjx-study tasks."""

import argparse

from mjx_study.cli.options import Commands, add_command, configure_process, print_report, usage_errors
from mjx_study.tasks import make_task, task_names


def add(commands: Commands) -> None:
    """Register the command."""
    add_command(commands, "tasks", "list the tasks", run)


def run(options: argparse.Namespace) -> int:
    """List the tasks."""
    with usage_errors():
        configure_process(options)
    tasks = [make_task(name) for name in task_names()]
    rows = [
        {"name": task.name, "params": task.policy.num_params, "horizon": task.horizon, "sigma": task.sigma}
        | {"effective_mass": task.effective_mass if task.contact_pair else None, "description": task.description}
        for task in tasks
    ]
    lines = [
        f"{row['name']:<17} {row['description']} ({row['params']} parameter{'s' * (row['params'] > 1)})" for row in rows
    ]
    print_report(options, {"tasks": rows}, lines)
    return 0
