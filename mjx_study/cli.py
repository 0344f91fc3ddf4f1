"""The command line: parse, check, call, print; exit codes.

0 what was asked was done; 1 a check that was asked for failed; 2 a bad option or file, in one line, with nothing
written; 130 interrupted.
"""

import argparse
import json
import sys
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any, NoReturn

from estimators import BASELINES, ESTIMATORS
from mjx_study import bench as benchmark
from mjx_study import gradcheck as check
from mjx_study.comparison import CompareConfig
from mjx_study.console import alarms, print_comparison, progress_bar
from mjx_study.contact import FAMILIES
from mjx_study.plots import plot_comparison, save_figure
from mjx_study.results import as_json, prepare_folder, save
from mjx_study.runtime import PRECISIONS, configure
from mjx_study.scene import CONES
from mjx_study.study import compare, plan_compare
from mjx_study.tasks import TASKS, make_task

EXAMPLES = {
    "main": """\
start here:
  mjx-study compare pusher                       which estimator, at which contact stiffness? 20 s once compiled
  mjx-study compare pusher --output out          the same, with a figure and the numbers on disk
  mjx-study gradcheck pusher                     are the derivatives right? exit code 1 if not
  mjx-study bench pusher                         what does a gradient cost on this machine?
""",
    "compare": """\
examples:
  mjx-study compare pusher --stiffness 10,1000 --contact penalty,mujoco_default
  mjx-study compare pusher --estimators zobg,fobg,aobg,ivw --gamma 50 --samples 1000
  mjx-study compare pusher --json > pusher.json

estimators:
{estimators}

contact families (K: from --stiffness):
{families}

columns of the table:
  variance        trace of the sample covariance of one gradient sample, with a jackknife interval
  relative error  distance of the mean to a reference gradient, over the norm of the reference
  alpha           weight of the first-order batch in AoBG
  epsilon, B      confidence radius of the zeroth-order mean; distance between the two means
  residual        largest relative imbalance left by MuJoCo's constraint solver
  ms              computing time of one sample in milliseconds, compilation excluded
  lost            samples that overflowed or became NaN; they are left out, and a warning says so
""",
    "gradcheck": """\
Compares, at each contact model: reverse mode with forward mode and with central differences of the whole cost over
a sweep of step sizes; a step's Jacobian with MuJoCo's C engine along the rollout; and, in the penalty family, the
gradient with a hand-derived one. Where the two one-sided differences disagree, the cost has a kink or a jump, and the
derivative is not called wrong.
""",
    "bench": """\
Rates in one run on this machine: rollouts and gradients, against jax.grad through mjx.step (with the one solver
iteration that it can differentiate) and against the C engine's centred mjd_transitionFD with an adjoint, on as many
threads.
""",
}


class UsageError(ValueError):
    """A bad option or file: one line, exit code 2."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message} (see {self.prog} --help)")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    try:
        options = _parser().parse_args(arguments)
        return options.run(options)
    except UsageError as error:
        print(f"mjx-study: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("mjx-study: interrupted; nothing was written", file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 1


def run_compare(options: argparse.Namespace) -> int:
    """mjx-study compare."""
    with _usage_errors():
        _configure(options)
        fields = {name: getattr(options, name) for name in _COMPARE_FIELDS}
        config = CompareConfig(**{name: value for name, value in fields.items() if value is not None})
        plan = plan_compare(config)
        folder = None if options.output is None else prepare_folder(options.output)
    with progress_bar() as progress:
        result = compare(plan, progress)
    written = []
    if folder is not None:
        written = save(result, folder) + save_figure(plot_comparison(result), folder, "comparison")
    if options.json:
        print(json.dumps(as_json(result), allow_nan=False))
        for warning in alarms(result):
            print(f"warning: {warning}", file=sys.stderr)
    else:
        print_comparison(result)
        if written:
            print(f"written: {', '.join(map(str, written))}")
        else:
            print("add --output DIR for a figure and the numbers on disk")
    return 0


def run_gradcheck(options: argparse.Namespace) -> int:
    """mjx-study gradcheck."""
    with _usage_errors():
        _configure(options)
        plan = check.plan_gradcheck(_task(options), options.contact, options.stiffness, seed=options.seed)
    with progress_bar() as progress:
        report = check.gradcheck(plan, progress)
    _print_report(options, report.as_json(), report.lines())
    return 0 if report.passed else 1


def run_bench(options: argparse.Namespace) -> int:
    """mjx-study bench."""
    with _usage_errors():
        _configure(options)
        plan = benchmark.plan_bench(_task(options), options.samples)
    with progress_bar() as progress:
        report = benchmark.bench(plan, progress)
    _print_report(options, report.as_json(), report.lines())
    return 0


def run_tasks(options: argparse.Namespace) -> int:
    """mjx-study tasks."""
    with _usage_errors():
        configure(cpu_devices=1)
    tasks = [make_task(name) for name in TASKS]
    rows = [
        {"name": task.name, "params": task.policy.num_params, "horizon": task.horizon, "sigma": task.sigma}
        | {"effective_mass": task.effective_mass, "description": task.description}
        for task in tasks
    ]
    _print_report(
        options, {"tasks": rows}, [f"{row['name']:<12} {row['description']} ({row['params']} params)" for row in rows]
    )
    return 0


def _print_report(options: argparse.Namespace, document: dict[str, Any], lines: Sequence[str]) -> None:
    if options.json:
        print(json.dumps(document, allow_nan=False))
    else:
        print("\n".join(lines))


def _configure(options: argparse.Namespace) -> None:
    configure(precision=options.precision, cpu_devices=options.devices)


def _task(options: argparse.Namespace) -> Any:
    chosen = {name: getattr(options, name) for name in ("cone", "horizon", "model")}
    task = make_task(options.task, **{name: value for name, value in chosen.items() if value is not None})
    return task if options.sigma is None else task.replace(sigma=options.sigma)


@contextmanager
def _usage_errors() -> Generator[None]:
    """Turns what a user can get wrong into a UsageError; used around checks only, never around computing."""
    try:
        yield
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from error


def _numbers(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(",") if part.strip())
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of numbers such as 10,100,1000") from None


def _names(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(",") if part.strip())


def _gamma(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number nor inf") from None


def _radius(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


_COMPARE_FIELDS = (
    "task stiffness contact estimators samples reference_samples sigma seed baseline gamma failure_probability "
    "variance_proxy radius confidence damping cone horizon model chunk_size"
).split()


def mjx_study_summary() -> str:
    """What the package is for, as its metadata says it."""
    return f"{metadata.metadata('mjx-study')['Summary']}."


def _parser() -> argparse.ArgumentParser:
    listing = {
        "estimators": "\n".join(f"  {item.name:<15} {item.description}" for item in ESTIMATORS.values()),
        "families": "\n".join(f"  {item.name:<15} {item.description}" for item in FAMILIES.values()),
    }
    parser = _Parser(
        prog="mjx-study",
        description=mjx_study_summary(),
        epilog=EXAMPLES["main"],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"mjx-study {metadata.version('mjx-study')}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def add(name: str, summary: str, run: Callable[[argparse.Namespace], int]) -> argparse.ArgumentParser:
        command = commands.add_parser(
            name,
            help=summary,
            description=summary[0].upper() + summary[1:] + ".",
            epilog=EXAMPLES.get(name, "").format(**listing),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        command.set_defaults(run=run)
        command.add_argument("--json", action="store_true", help="print the figures as JSON on standard output")
        return command

    command = add("compare", "compare gradient estimators over contact models", run_compare)
    _add_task_options(command)
    command.add_argument("--estimators", type=_names, metavar="NAME[,NAME]", help="default: zobg,fobg,aobg")
    command.add_argument("--samples", type=int, metavar="N", help="samples in each batch (default: 400)")
    command.add_argument(
        "--reference-samples", type=int, metavar="N", help="pairs of rollouts behind each reference (default: 600)"
    )
    command.add_argument(
        "--damping", type=float, metavar="B", help="contact damping in N s/m, in place of the family's"
    )
    command.add_argument("--baseline", choices=list(BASELINES), help="of zeroth-order samples (default: zero_noise)")
    command.add_argument(
        "--gamma", type=_gamma, metavar="G", help="AoBG's accuracy bound; inf for none (default: the task's)"
    )
    command.add_argument(
        "--failure-probability", type=float, metavar="P", help="that epsilon's interval misses (default: 0.05)"
    )
    command.add_argument(
        "--variance-proxy", metavar="S2", help="variance or second_moment, in epsilon (default: variance)"
    )
    command.add_argument(
        "--radius", type=_radius, metavar="R", help="max_deviation or a number, in epsilon (default: max_deviation)"
    )
    command.add_argument("--confidence", type=float, metavar="P", help="of the reported intervals (default: 0.95)")
    command.add_argument(
        "--chunk-size", type=int, metavar="N", help="samples per device and call (default: by --samples)"
    )
    command.add_argument("--output", type=Path, metavar="DIR", help="write the figure and the numbers to this folder")

    command = add("gradcheck", "check derivatives against differences, the C engine and a closed form", run_gradcheck)
    _add_task_options(command)
    command.set_defaults(stiffness=check.STIFFNESS, contact=check.CONTACT)

    command = add("bench", "measure what rollouts and gradients cost here", run_bench)
    _add_task_options(command, contact=False)
    command.add_argument("--samples", type=int, default=1000, metavar="N", help="samples in a batch (default: 1000)")

    add("tasks", "list the tasks", run_tasks)
    return parser


def _add_task_options(command: argparse.ArgumentParser, *, contact: bool = True) -> None:
    command.add_argument("task", metavar="TASK", help=f"one of: {', '.join(TASKS)}")
    if contact:
        command.add_argument(
            "--stiffness",
            type=_numbers,
            metavar="K[,K]",
            help="contact stiffnesses in N/m (default: a sweep)",
        )
        command.add_argument("--contact", type=_names, metavar="FAMILY[,FAMILY]", help=f"of: {', '.join(FAMILIES)}")
    command.add_argument("--sigma", type=float, metavar="S", help="noise on each control (default: the task's)")
    command.add_argument("--seed", type=int, default=0, metavar="N", help="of all randomness (default: 0)")
    command.add_argument("--precision", choices=PRECISIONS, default="float64", help="default: float64")
    command.add_argument("--cone", choices=list(CONES), help="friction cone (default: the MJCF's)")
    command.add_argument("--horizon", type=int, metavar="H", help="steps (default: the task's)")
    command.add_argument("--model", metavar="FILE.xml", help="an MJCF in place of the task's own")
    command.add_argument(
        "--devices", type=int, metavar="N", help="CPU devices (default: one per core; with JAX 0.11 one)"
    )
