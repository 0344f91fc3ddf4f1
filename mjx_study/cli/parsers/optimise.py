"""Options of mjx-study optimise."""

import argparse

from mjx_study.cli.options import (
    add_backward_options,
    add_contact_options,
    add_estimator_options,
    add_folder_options,
    add_option,
    add_options,
    add_task_options,
    add_theta_option,
)
from mjx_study.option import OPTIONS
from mjx_study.study.configuration import StudyConfig

SEEDS = 3
EPILOG = """\
Every estimator starts from the task's theta, or from --theta, and draws the same noise. --learning-rate, --iterations
and --samples default to the task's own, which are the paper's: plain gradient descent.

With --output DIR, a study is written: its numbers (for plot, report, load_study), descent.png and .pdf (cost against
iterations, rollouts and seconds; alpha), and each estimator's policy of its best seed (policy-NAME.json, for rollout
--policy). The same command resumes a stopped run, repeating at most 20 s, or extends it with more --iterations.

examples:
  mjx-study optimise pusher --contact penalty --stiffness 1000 --output out
  mjx-study optimise ball_wall --reference --estimators zobg,fobg,aobg --seeds 5
  mjx-study optimise pusher --estimators ivw_h --optimizer adam --learning-rate 0.01
  mjx-study optimise tennis --network 16,16 --optimizer adam --learning-rate 0.003 --contact penalty
  mjx-study rollout pusher --policy out/policy-aobg.json

columns of the table:
  cost        mean cost with noise of the final policy over --evaluation-samples rollouts, the same for all, and its
              standard deviation over seeds
  hit, ...    what a task counts besides its cost, averaged over the same rollouts
  alpha       mean weight of first-order gradients in the last tenth of the iterations
  rollouts    number simulated per seed, including differentiated ones and baselines
"""


def add(command: argparse.ArgumentParser) -> None:
    add_task_options(command)
    add_theta_option(command, "parameters to start from")
    add_contact_options(command, "the middle one of the task's sweep", many=False)
    command.add_argument("--reference", action="store_true", help="use the analytic reference instead of MJX")
    add_options(command, StudyConfig, "network", "estimators", "iterations")
    add_option(command, OPTIONS["samples"].within("[3, 1e7]"))
    add_option(command, OPTIONS["seeds"], SEEDS)
    add_options(command, StudyConfig, "optimizer", "learning_rate", "decay", optimizer={"unset": "sgd"})
    add_options(command, StudyConfig, "stiffness_schedule", "sigma_schedule")
    add_estimator_options(command, StudyConfig)
    add_backward_options(command, many=False)
    add_options(command, StudyConfig, "evaluation_samples", "chunk_size", evaluation_samples={"unset": "200"})
    add_folder_options(command)
