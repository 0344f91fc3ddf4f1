"""Measure what data/laws*.jsonl lack, with the extra `laws`, or write the tables of docs/which-contact.md.

python -m experiments.laws                       # all that is missing
python -m experiments.laws gradcheck             # the same of one scene, or kind of scene
python -m experiments.laws stack --row conic     # one cell
python -m experiments.laws --into FILE           # apart from the data, to which its lines are added later
python -m experiments.laws --points 200 --into FILE    # coarse, for a trial
python -m experiments.laws list                  # what is missing, by scene and row
python -m experiments.laws page                  # write the tables
"""

import argparse
import itertools
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from experiments import DOCS, append_line
from experiments.laws import measure, page
from experiments.pages import write_tables
from mjx_study.runtime import configure
from mjx_study.simulation.law import LAWS as OTHERS

MORE: Final = (
    *("skid", "tennis", "landing", "box", "corners"),
    *("roll", "stack", "stacked_corners", "quadruped standing", "quadruped landing"),
)


def cells() -> dict[tuple[str, str], Callable[[], dict[str, Any]]]:
    """What is measured, by scene and row."""
    found: dict[tuple[str, str], Callable[[], dict[str, Any]]] = {}
    for scene, (row, each) in itertools.product(("throw", "faithful", "ball_wall"), page.LAWS.items()):
        means = partial(measure.integrated, scene, *each)
        found[scene, row] = partial(measure.faithful, each[0]) if scene == "faithful" else means
    for name in measure.TRAINED:
        for row, each in page.LAWS.items():
            found[f"train {name}", row] = partial(measure.trained, name, *each, "fobg")
        found[f"train {name}", page.ZEROTH] = partial(measure.trained, name, *page.LAWS["MuJoCo's default"], "zobg")
        for row, longer in page.LONGER.items():
            found[f"train {name}", row] = partial(measure.trained, name, *longer)
        for row, each in page.LAWS.items() if name == "ball_wall" else ():
            found["pusher", row] = partial(measure.sampled, "pusher", *each)
    for row, scale in itertools.product(OTHERS, (0.1, 10.0)):
        found[f"throw, kappa {scale:g}", row] = partial(measure.integrated, "throw", row, "none", scale)
    for scene, (row, each) in itertools.product(MORE, page.LAWS.items()):
        found[scene, row] = partial(measure.sampled if scene in measure.SAMPLED else measure.integrated, scene, *each)
    found |= {(scene, row): partial(measure.integrated, scene, *page.LAWS[row]) for scene, row in page.TOSSES}
    plain = {row: law for row, (law, onset) in page.LAWS.items() if onset == "none"} | {page.RIGID: page.RIGID}
    found |= {("faithful bodies", row): partial(measure.bodies, law) for row, law in plain.items()}
    found |= {("corner", row): partial(measure.corner, **changes) for row, changes in page.CORNER.items()}
    found |= {("afloat", row): partial(measure.afloat, *each) for row, each in page.AFLOAT.items()}
    for name, law, cone in itertools.product(page.CHECKED, OTHERS, ("", "pyramidal")):
        if not cone or (name, law) in page.PYRAMIDAL:
            for kind, compute in (("gradcheck", measure.checked), ("compare", measure.compared)):
                found[f"{kind} {name}{' ' * bool(cone)}{cone}", law] = partial(compute, name, law, cone)
    return found


def wanted(scenes: list[str], rows: list[str]) -> dict[tuple[str, str], Callable[[], dict[str, Any]]]:
    """Cells of the scenes, or kinds of scenes, and rows named; of all where none is."""
    return {
        (scene, row): compute
        for (scene, row), compute in cells().items()
        if (not scenes or {scene, scene.partition(" ")[0]} & set(scenes)) and (not rows or row in rows)
    }


def run(asked: dict[tuple[str, str], Callable[[], dict[str, Any]]], into: Path | None) -> None:
    """Append what is missing of the cells asked for."""
    known = page.measured(*filter(None, [into]))
    for (scene, row), compute in asked.items():
        if (scene, row) in known:
            continue
        begin = time.perf_counter()
        try:
            numbers = compute()
        except ValueError as error:
            numbers = {"refused": str(error)}
        numbers = {
            name: float(each) if np.ndim(each) == 0 and not isinstance(each, str | None) else each
            for name, each in numbers.items()
        }
        checks = scene.startswith(("gradcheck", "compare", "corner", "afloat"))
        append_line(into or (page.CHECKS if checks else page.CELLS), {"scene": scene, "row": row, **numbers})
        print(f"{scene}, {row}: {time.perf_counter() - begin:.0f} s", flush=True)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.laws", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", nargs="*", help="scenes or kinds of scenes; or page, or list")
    parser.add_argument("--row", nargs="+", default=[], help="rows, by name")
    parser.add_argument("--into", type=Path, help="file in place of the data")
    parser.add_argument("--points", type=int, default=measure.POINTS, help="of quadrature, samples, pairs")
    arguments = parser.parse_args()
    if arguments.what == ["page"]:
        write_tables(DOCS / "which-contact.md", page.tables())
        return
    asked = wanted([each for each in arguments.what if each != "list"], arguments.row)
    if "list" in arguments.what:
        known = page.measured()
        print(*(json.dumps(key) for key in asked if key not in known), sep="\n")
        return
    if arguments.points != measure.POINTS and arguments.into is None:
        parser.error("--points needs --into: the data have one number of points")
    measure.POINTS = arguments.points
    configure(cpu_devices=1)
    run(asked, arguments.into)


if __name__ == "__main__":
    main()
