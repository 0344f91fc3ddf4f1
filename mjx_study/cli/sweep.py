"""mjx-study sweep."""

import argparse
from pathlib import Path
from typing import Any

from mjx_study.choices import TASK_DESCRIPTIONS
from mjx_study.cli.options import study_fields
from mjx_study.options.configuration import BUILDER_OPTIONS, OPTIONS, StudyConfig
from mjx_study.options.option import OptionError, flag_of
from mjx_study.options.parser import Parser, UsageError, known_task

EPILOG = """\
Every combination of task, contact model, timestep, cone, sigma and number of samples is a cell: all its seeds and
estimators are computed together and written to DIR as one file. Stop whenever you like, with Ctrl-C or kill -9: the
same command computes what is missing, with the same numbers. Two such processes at once share the work.

Gradients are estimated at each task's initial theta. With --iterations, policies are optimised instead; with --points,
landscapes are computed: the cost along a line, and the slope that every estimator sees.

Numbers may be lists (10,100,1000) or ranges: FROM:TO:COUNT, or FROM:TO:COUNT:log for equal ratios.

examples:
  mjx-study sweep pusher --stiffness 10:1e5:13:log --contact penalty,mujoco --output out
  mjx-study sweep pusher --stiffness 10:1e4:7:log --iterations 500 --samples 10 --seeds 5 --output descents
  mjx-study sweep momentum_transfer --contact mujoco,smooth_onset --points 31 --timestep 0.001,0.002 --output slopes
  mjx-study sweep pusher,ball_wall --timestep 0.001,0.0025,0.005 --samples 30,100,300 --output steps
  mjx-study sweep ball_wall --solref='-1e5:-1e3:5:log;-10' --solimp 0.9,0.95,0.001,0.5,2 --output solref
  mjx-study sweep --config study.toml --output out
  mjx-study plot out
  mjx-study report out

A TOML file holds the same options under the names of their flags, with _ for -:
  tasks = ["pusher"]
  contact = ["penalty", "mujoco"]
  stiffness = "10:1e5:13:log"
  samples = [30, 100]
  seeds = 10
"""


def add(command: Parser) -> None:
    choices = f"one or more of: {', '.join(TASK_DESCRIPTIONS)}, module:name of your own, or an MJCF"

    def tasks(text: str) -> tuple[str, ...]:
        return tuple(map(known_task, OPTIONS["tasks"].parse(text)))

    command.add_argument("tasks", nargs="?", type=tasks, metavar="TASK[,TASK]", help=choices)
    command.add_argument("--config", type=Path, metavar="FILE.toml", help="options from a file; flags take precedence")
    command.add_options(
        "contact", "stiffness", "damping", "smoothing", "solref", "solimp", "timestep", "cone", "sigma", "samples"
    )
    command.add_option("seeds", line="batches for each cell, or descents")
    command.add_options("estimators", "kind", "network", "confidence")
    command.add_option("iterations", line="optimise policies, N iterations", unset="")
    command.add_option("points", line="landscapes, at N points of a line through theta")
    command.add_options("span", "direction", "optimizer", "learning_rate", "decay")
    command.add_options("stiffness_schedule", "sigma_schedule", "reference_samples", "evaluation_samples")
    command.add_estimator_options()
    command.add_backward_options()
    command.add_options(*BUILDER_OPTIONS, "chunk_size", "block_size")
    command.add_process_options()
    command.add_folder_options("folder for the study; required unless --dry-run is given")
    command.add_cluster_option()


def run(options: argparse.Namespace) -> int:
    if options.output is None and not options.dry_run:
        raise UsageError("no folder for the study: give --output, or --dry-run. See mjx-study sweep --help")
    from mjx_study.cli.studies import run_sweep
    from mjx_study.experiment.plan import StudyPlan, plan_study

    def planned() -> StudyPlan:
        fields = sweep_fields(options)
        try:
            return plan_study(StudyConfig(**fields))
        except OptionError as error:  # of an option from the file, too
            in_file = fields.keys() - study_fields(options).keys()
            key = f"{{}} in {options.config}".format
            raise UsageError(error.spelled(lambda name: key(name) if name in in_file else flag_of(name))) from error

    return run_sweep(options, planned)


def sweep_fields(options: argparse.Namespace) -> dict[str, Any]:
    """Fields of a sweep's configuration; flags take precedence over the file."""
    from mjx_study.options.files import read_toml

    fields = ({} if options.config is None else read_toml(options.config)) | study_fields(options)
    if "tasks" not in fields:
        raise ValueError("no task: name one, or give --config")
    if fields.get("solref") or fields.get("solimp"):
        fields.setdefault("contact", ())
    return fields
