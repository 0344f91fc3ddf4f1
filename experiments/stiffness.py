"""Draws docs/variance.png, docs/bias*.png, docs/achieved.png and docs/map.png: what the README says about stiffness.

    python -m experiments.stiffness

Six sweeps, in results/study/; half an hour on two cores, and it goes on where it was stopped.
"""

from typing import Final

from experiments.pages import DOCS, ROOT, save_figure
from mjx_study.cli.output import shown_progress
from mjx_study.execution.run import run_study
from mjx_study.experiment.configuration import StudyConfig
from mjx_study.experiment.plan import plan_study
from mjx_study.plots.study import plot_study
from mjx_study.runtime import configure
from mjx_study.storage.folder import load_study


def decades(first: int, last: int, count: int) -> tuple[float, ...]:
    """Powers of ten, evenly spaced in their exponent."""
    return tuple(float(f"{10 ** (first + index * (last - first) / (count - 1)):.12g}") for index in range(count))


def bias_of_robot(task: str, *stiffness: float) -> StudyConfig:
    return StudyConfig(
        tasks=(task,),
        contact=("penalty", "mujoco", "smooth_onset"),
        stiffness=stiffness,
        samples=(1000,),
        reference_samples=20_000,
    )


SWEEPS: Final = {
    "variance": StudyConfig(
        tasks=("pusher",),
        contact=("penalty", "mujoco", "mujoco_stiff"),
        stiffness=decades(1, 4, 13),
    ),
    "bias": StudyConfig(
        tasks=("momentum_transfer",),
        contact=("penalty", "mujoco", "smooth_onset"),
        stiffness=decades(3, 5, 5),
        reference_samples=3000,
    ),
    "bias_gripper": bias_of_robot("gripper", 300.0, 1000.0, 3000.0),
    "bias_landing": bias_of_robot("landing", 1000.0, 3000.0, 10_000.0),
    "achieved": StudyConfig(
        tasks=("pusher",),
        contact=("penalty", "mujoco", "mujoco_stiff"),
        stiffness=decades(1, 4, 7),
        iterations=500,
        samples=(10,),
        seeds=5,
    ),
    "map": StudyConfig(
        tasks=("pusher",),
        contact=("penalty", "mujoco", "mujoco_stiff"),
        stiffness=decades(1, 4, 9),
        sigma=decades(-2, 0, 5),
        seeds=3,
    ),
}
FIGURES: Final = {"map": "map_stiffness_sigma", "bias_gripper": "bias", "bias_landing": "bias"}
"""Names of figures that are not their sweep's."""


def main() -> None:
    configure()
    for name, config in SWEEPS.items():
        folder = ROOT / "results" / "study" / name
        with shown_progress() as progress:
            run_study(plan_study(config), folder, progress)
        path = DOCS / f"{name}.png"
        save_figure(plot_study(load_study(folder))[FIGURES.get(name, name)], path)
        print(f"written: {path}")


if __name__ == "__main__":
    main()
