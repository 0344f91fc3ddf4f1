"""Figures of docs/: the tasks as MJX simulates them, their physics against closed forms, and the onset term.

    python -m experiments.figures             all of them
    python -m experiments.figures physics     one of them: tasks, physics, onset-correction or onset-stiffness

It takes a minute or two, most of it to compile; compiled programs are kept between runs.
"""

import argparse

from experiments.figures.onset import correction_figure, stiffness_figure
from experiments.figures.physics import physics_figure
from experiments.figures.tasks import tasks_figure
from experiments.pages import save_figure
from mjx_study.runtime import configure

FIGURES = {
    "tasks": tasks_figure,
    "physics": physics_figure,
    "onset-correction": correction_figure,
    "onset-stiffness": stiffness_figure,
}


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help=", ".join(FIGURES))
    names = parser.parse_args().names or list(FIGURES)
    if unknown := sorted(set(names) - set(FIGURES)):
        parser.error(f"no figure {', '.join(unknown)}; choose from {', '.join(FIGURES)}")
    configure(cpu_devices=1)
    for name in names:
        save_figure(FIGURES[name](), name)


if __name__ == "__main__":
    main()
