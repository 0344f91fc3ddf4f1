"""mjx-study optimise."""

import argparse
import json
from pathlib import Path
from typing import Any

from mjx_study.choices import REFERENCE
from mjx_study.cli.options import study_fields
from mjx_study.disk import write_whole
from mjx_study.options.configuration import BUILDER_OPTIONS, UNSET_TASK, StudyConfig
from mjx_study.options.option import OptionError
from mjx_study.options.parser import MIDDLE, Parser
from mjx_study.results.variables import DESCENTS, explained

EPILOG = f"""\
All estimators start from the task's theta, or from --theta, and draw the same noise. --learning-rate, --iterations and
--samples default to the task's recipe, the paper's plain gradient descent.

--output DIR writes a study: its numbers (for plot, report, load_study), descent.png and .pdf (cost against iterations,
rollouts and seconds; alpha), and for each estimator the policy of its best seed (policy-NAME.json, for --theta). The
same command resumes a stopped run, repeating at most 20 s, or extends it to more --iterations.

examples:
  mjx-study optimise pusher --contact penalty --stiffness 1000 --output out
  mjx-study optimise ball_wall --reference --estimators zobg,fobg,aobg --seeds 5
  mjx-study optimise pusher --estimators ivw_h --optimizer adam --learning-rate 0.01
  mjx-study optimise tennis --network 16,16 --optimizer adam --learning-rate 0.003 --contact penalty
  mjx-study rollout pusher --theta out/policy-aobg.json

columns of the table:
{explained(DESCENTS, "final_cost", "best_cost", "alpha", "seed_rollouts", "seconds")}

Each task metric, such as hit, has its own column. Costs and metrics are means over --evaluation-samples rollouts, the
same for all estimators, ± the standard deviation over seeds; alpha is the mean over the last tenth of the iterations.
"""


def add(command: Parser) -> None:
    command.add_task_options()
    command.add_theta_option("parameters to start from")
    command.add_contact_options(MIDDLE, many=False)
    command.add_flag("--reference", "use the analytic reference instead of MJX")
    command.add_options("network", "estimators", "iterations")
    command.add_option("samples", many=False, unset=UNSET_TASK)
    command.add_option("seeds", line="number of descents, each with independent noise")
    command.add_options("optimizer", "learning_rate", "decay", "stiffness_schedule", "sigma_schedule")
    command.add_estimator_options()
    command.add_backward_options(many=False)
    command.add_options("evaluation_samples", "chunk_size")
    command.add_folder_options()


def run(options: argparse.Namespace) -> int:
    from mjx_study.cli.console import descent_lines, descents
    from mjx_study.cli.studies import run_one
    from mjx_study.experiment.plan import plan_study
    from mjx_study.experiment.study import StudyPlan

    def planned() -> StudyPlan:
        if options.reference and options.contact not in (None, REFERENCE):
            raise OptionError("contact", f"{options.contact} is what --reference replaces: omit one of them")
        fields = study_fields(options)
        if options.reference:
            fields["contact"] = (REFERENCE,)
        return plan_study(StudyConfig(**fields, kind="descents"), single=True)

    def best_policies(document: dict[str, Any]) -> dict[str, Any]:
        return {run["estimator"]: run["theta"][run["best_seed"]] for run in document["runs"]}

    offer = "a figure, the policies, and a run that can be resumed"
    return run_one(options, planned, descents, descent_lines, offer, _save_policies, best_policies)


def _save_policies(document: dict[str, Any], folder: Path) -> list[Path]:
    from mjx_study.options.files import digest_of_json

    config, written = document["config"], []
    names = "task", "stiffness", "damping", "smoothing", "cone", *BUILDER_OPTIONS, "network"
    kept = {name: config[name] for name in names}
    kept |= {"contact": None if config["contact"] == REFERENCE else config["contact"]}
    kept |= {"timestep": config["timestep"][0] if config["timestep"] else None}
    for run in document["runs"]:
        best = run["best_seed"]
        policy = kept | {"estimator": run["estimator"], "seed": best, "cost": run["final_cost"][best]}
        policy |= {"theta": run["theta"][best]}
        content = (json.dumps(policy | {"digest": digest_of_json(policy)}) + "\n").encode()
        name = f"policy-{run['estimator'].replace(':', '.')}.json"
        written.append(write_whole(folder / name, content))
    document["policies"] = list(map(str, written))
    return written
