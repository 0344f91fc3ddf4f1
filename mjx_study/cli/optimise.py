"""mjx-study optimise."""

import argparse
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from mjx_study.cli.console import number
from mjx_study.cli.options import (
    Commands,
    add_command,
    add_contact_options,
    add_estimator_options,
    add_options,
    add_task_options,
    add_versions_option,
    attempt,
    computing,
    configure_process,
    finish,
    print_report,
    usage_errors,
)
from mjx_study.cli.parameters import add_theta_option, theta_of
from mjx_study.disk import prepare_folder, write_whole
from mjx_study.plots.curves import plot_optimisation
from mjx_study.plots.style import save_figure, style_of
from mjx_study.study.dataset import as_plain
from mjx_study.study.descents import OptimiseConfig, OptimiseResult, Run, open_checkpoints, optimise, plan_optimise
from mjx_study.table import format_table

EPILOG = """\
Every estimator starts from the task's theta, or from --theta, and draws the same noise. Without --learning-rate,
--iterations and --samples the task's own are taken, which are the paper's: plain gradient descent.

With --output DIR: optimisation.png and .pdf (cost against iterations, rollouts and seconds; alpha), optimisation.json,
the best seed's policy of each estimator (policy-NAME.json, for rollout --policy), and run-NAME.npz, from which the same
command goes on where it was stopped, or with more --iterations.

examples:
  mjx-study optimise pusher --contact penalty --stiffness 1000 --output out
  mjx-study optimise ball_wall --reference --estimator zobg,fobg,aobg --seeds 5
  mjx-study optimise pusher --estimator ivw_h --optimizer adam --learning-rate 0.01
  mjx-study optimise tennis --network 16,16 --optimizer adam --learning-rate 0.003 --contact penalty
  mjx-study rollout pusher --policy out/policy-aobg.json

columns of the table:
  cost        mean cost with noise of the final policy over --evaluation-samples rollouts, the same for all, and its
              standard deviation over seeds
  hit, ...    what a task counts beside its cost, the mean over the same rollouts
  alpha       mean weight of first-order gradients in the last tenth of the iterations
  rollouts    simulated per seed, those that were differentiated and baselines included
"""
RESUMABLE = "the same command goes on from the last checkpoint, at most 20 s ago"
FIELDS = (
    "task estimators contact stiffness damping reference network iterations samples learning_rate decay optimizer "
    "seeds seed sigma noise baseline gamma published failure_probability variance_proxy radius max_norm window "
    "tolerance weights onset cone horizon model evaluation_samples chunk_size"
).split()


def add(commands: Commands) -> None:
    """Register the command."""
    command = add_command(commands, "optimise", "optimise a policy with any estimator", run, EPILOG)
    add_task_options(command, OptimiseConfig)
    add_theta_option(command, "parameters to start from")
    add_contact_options(command, OptimiseConfig, "the middle one of the task's sweep")
    command.add_argument("--reference", action="store_true", help="on the analytic reference in place of MJX")
    add_options(command, OptimiseConfig, "network", "estimators", estimators={"flag": "--estimator"})
    add_options(command, OptimiseConfig, "iterations", "samples", "seeds", "optimizer", "learning_rate", "decay")
    add_estimator_options(command, OptimiseConfig)
    add_options(command, OptimiseConfig, "evaluation_samples", "chunk_size")
    command.add_argument("--output", type=Path, metavar="DIR", help="write figure, numbers, policies and checkpoints")
    add_versions_option(command)


def run(options: argparse.Namespace) -> int:
    """Optimise, print, and write where an output folder is given."""
    with usage_errors():
        configure_process(options)
        fields: dict[str, Any] = {name: getattr(options, name) for name in FIELDS} | {"theta": theta_of(options)}
        plan = plan_optimise(OptimiseConfig(**{name: value for name, value in fields.items() if value is not None}))
        folder = None if options.output is None else prepare_folder(options.output)
        if folder is not None:  # refused here, before anything is computed
            open_checkpoints(folder, plan, accept_versions=options.accept_versions)
    with computing(*([] if folder is None else [RESUMABLE])) as progress:
        result = optimise(plan, folder, progress, accept_versions=options.accept_versions)
    document = as_document(result)
    written, unwritten = ([], None) if folder is None else attempt(lambda: _save(result, document, folder))
    print_report(options, document, _lines(result, written, hinted=folder is None))
    return finish(*result.unsaved, unwritten)


def as_document(result: OptimiseResult) -> dict[str, Any]:
    """A result as plain data; histories by iteration and seed."""
    runs = [
        {
            "estimator": run.estimator,
            "final_cost": run.final_cost.tolist(),
            "final_cost_se": run.final_cost_se.tolist(),
            "outcomes": {name: values.tolist() for name, values in run.outcomes.items()},
            "best_seed": run.best,
            "stopped": [{"seed": seed, "iteration": at, "reason": why} for seed, (at, why) in run.stopped.items()],
            "rollouts_per_iteration": run.rollouts,
            "seconds": run.seconds.tolist(),
            "history": {name: values.tolist() for name, values in run.history.items()},
            "theta": run.theta.tolist(),
        }
        for run in result.runs
    ]
    return as_plain(
        {
            "config": vars(result.config),
            "environment": result.environment,
            "start_cost": result.start_cost,
            "start_outcomes": result.start_outcomes,
            "warnings": list(result.warnings),
            "runs": runs,
        }
    )


def _save(result: OptimiseResult, document: dict[str, Any], folder: Path) -> list[Path]:
    text = json.dumps(document, allow_nan=False) + "\n"
    written = [write_whole(folder / "optimisation.json", lambda file: file.write(text.encode()))]
    for run in result.runs:
        policy = {
            "task": result.config.task,
            "estimator": run.estimator,
            "seed": run.best,
            "cost": float(run.final_cost[run.best]),
            "contact": result.config.contact,
            "stiffness": result.config.stiffness,
            "damping": result.config.damping,
            "cone": result.config.cone,
            "model": result.config.model,
            "horizon": result.config.horizon,
            "network": result.config.network,
            "theta": run.theta[run.best].tolist(),
        }
        content = (json.dumps(as_plain(policy)) + "\n").encode()
        name = f"policy-{run.estimator.replace(':', '.')}.json"
        written.append(write_whole(folder / name, lambda file, data=content: file.write(data)))
    return [*written, *save_figure(plot_optimisation(result), folder, "optimisation")]


def _lines(result: OptimiseResult, written: list[Path], *, hinted: bool) -> list[str]:
    config = result.config
    where = "analytic reference" if config.reference else config.contact
    if not config.reference and config.stiffness:
        where = f"{where}, K = {config.stiffness:g} N/m"
    outcomes = "".join(f", {name} {value:.3f}" for name, value in result.start_outcomes.items())
    decay = f" / i^{config.decay:g}" if config.decay else ""
    mean, error = result.start_cost
    lines = [
        f"{config.task}: {where}; {config.optimizer}, learning rate {config.learning_rate:g}{decay}, "
        f"{config.iterations} iterations",
        f"{config.samples} samples in each batch, {config.seeds} seeds from {config.seed}, sigma {config.sigma:g}; "
        f"cost at the start {number(mean, 4)} ± {number(error, 2)}{outcomes}",
        "",
        *format_table(
            [_row(run) for run in result.runs],
            ["estimator", "cost", "best", *result.start_outcomes, "alpha", "rollouts", "seconds"],
        ),
    ]
    for run in result.runs:
        for seed, (iteration, reason) in run.stopped.items():
            lines.append(f"{style_of(run.estimator)[0]}, seed {seed}: stopped at iteration {iteration}, {reason}")
    lines += [f"warning: {message}" for message in result.warnings]
    hint = "add --output DIR for a figure, the policies, and to go on later"
    if not written:
        return [*lines, hint] if hinted else lines
    return [*lines, f"written to {written[0].parent}: {', '.join(path.name for path in written)}"]


def _row(run: Run) -> list[str]:
    costs = run.final_cost[np.isfinite(run.final_cost)]
    tail = run.history["alpha"][-max(1, len(run.seconds) // 10) :]
    alpha = float(np.nanmean(tail)) if np.any(np.isfinite(tail)) else math.nan
    return [
        style_of(run.estimator)[0],
        _mean_and_spread(costs, 4),
        number(float(np.min(costs)), 4) if len(costs) else "nan",
        *(_mean_and_spread(values, 3) for values in run.outcomes.values()),
        "-" if math.isnan(alpha) else f"{alpha:.3f}",
        str(run.rollouts * len(run.seconds)),
        f"{run.seconds[-1]:.1f}" if len(run.seconds) else "-",
    ]


def _mean_and_spread(values: np.ndarray, digits: int) -> str:
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return "nan"
    spread = f" ± {number(float(np.std(values, ddof=1)), 2)}" if len(values) > 1 else ""
    return number(float(np.mean(values)), digits) + spread
