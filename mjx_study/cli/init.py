"""mjx-study init."""

import argparse
import shlex
from pathlib import Path

from mjx_study.choices import is_file
from mjx_study.cli.options import configure_process, usage_errors
from mjx_study.cli.output import attempt, print_report
from mjx_study.options.parser import Parser, UsageError

EPILOG = """\
Writes a Python file with a task beside the MJCF. Every command runs it as it is, and its comments explain its numbers.
Parameters are the actuators' controls, or without actuators initial velocities; the cost is a body's distance from a
goal. Noise, horizon, contact pair, stiffnesses and learning rate follow from test rollouts in MuJoCo's C engine.

examples:
  mjx-study init robot.xml             writes robot_task.py, with the task robot_task:robot
  mjx-study init robot.xml --force     again, over changes
"""


def add(command: Parser) -> None:
    command.add_argument("mjcf", metavar="FILE.xml", help="an MJCF that MJX runs")
    command.add_flag("--force", "replace an existing file")


def run(options: argparse.Namespace) -> int:
    from mjx_study.authoring.proposal import propose
    from mjx_study.authoring.task_file import function_name, module_name, source_of_task
    from mjx_study.disk import write_whole
    from mjx_study.simulation.scene import load_scene

    mjcf = Path(options.mjcf)
    if not is_file(options.mjcf):
        raise UsageError(f"init needs the path of an MJCF, FILE.xml, got {options.mjcf}")
    target = mjcf.with_name(f"{module_name(mjcf)}.py")
    with usage_errors():
        configure_process(options)
        scene = load_scene(mjcf)
        if (target.exists() or target.is_symlink()) and not options.force:
            raise UsageError(f"{target} exists: give --force to replace it")
        found = propose(scene)
    text = source_of_task(mjcf, found)
    written, unwritten = attempt(lambda: [write_whole(target, text.encode())])
    place = f"{module_name(mjcf)}:{function_name(mjcf)}"
    document = {
        "task": place,
        "written": [str(path) for path in written],
        "horizon": found.horizon,
        "sigma": found.drive.scale,
        "contact_pair": found.pair,
        "stiffnesses": found.stiffnesses,
        "learning_rate": found.learning_rate,
    }
    lines = [f"{target}: the task {place}; its comments say why its numbers are what they are"] if written else []
    if written and not found.touches:
        lines.append("nothing touched in its test rollouts: there is no contact to study unless start or goal move")
    if written:
        here = "" if mjcf.parent == Path() else f"cd {shlex.quote(str(mjcf.parent))} && "
        lines.append(f"next: {here}mjx-study compare {place} (or rollout, diagnose, optimise)")
    return print_report(options, document, lines, unwritten)
