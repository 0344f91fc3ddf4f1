"""mjx-study rollout."""

import argparse
from pathlib import Path

from mjx_study.choices import FILM_FORMATS, PLANES, RENDERERS
from mjx_study.options.option import Option
from mjx_study.options.parser import MIDDLE, Parser

EPILOG = """\
Simulates one rollout and shows it: strip.png (pictures at equal intervals), stroboscope.png (one picture with ghosts),
rollout.gif or .mp4, and trajectory.npz (time [s], qpos, qvel, controls). Without OpenGL everything is drawn from the
model's geometry; with it, MuJoCo renders strip and film.

TASK may also be any MJCF file (FILE.xml), which MuJoCo's C engine simulates for 2 s, or for --horizon steps, from its
first keyframe if it has one.

examples:
  mjx-study rollout pusher
  mjx-study rollout ball_wall --theta 0.75 --stiffness 1e4 --slow 4
  mjx-study rollout tennis --noisy --seed 3 --theta learnt.npy
  mjx-study rollout humanoid.xml --horizon 500 --view xz --format mp4
"""


def add(command: Parser) -> None:
    command.add_task_options()
    command.add_contact_options(MIDDLE, many=False, analytic=False)
    command.add_flag("--noisy", "add noise, drawn with --seed (default: none)")
    command.add_theta_option("parameters, and of a policy also its contact, horizon and MJCF options")
    command.add_option(Option("frames", int, "N", "frames in the film strip", "[1, 100]", default=6))
    command.add_argument("--view", choices=["auto", *PLANES], default="auto", help="default: auto, by the motion")
    command.add_argument("--renderer", choices=RENDERERS, default="auto", help="default: auto, opengl where it works")
    command.add_argument("--format", choices=FILM_FORMATS, default="gif", help="format of the film (default: gif)")
    command.add_option(Option("slow", float, "FACTOR", "slow-motion factor", "(0, 1000]", default=1.0))
    command.add_argument("--output", type=Path, metavar="DIR", help="default: results/TASK-rollout")


def run(options: argparse.Namespace) -> int:
    from mjx_study.cli.motions import run_rollout

    return run_rollout(options)
