"""Folders of studies that are forged, drawn and resumed."""

import random
import shutil
from pathlib import Path
from typing import Final

from tests.fuzz.answers import Row, WrongError
from tests.fuzz.forgeries import FORGERIES
from tests.fuzz.studies import STUDIES, draw, make, resume

FORGED: Final = dict.fromkeys(FORGERIES, 100)
"""Kinds, and numbers of folders at full size."""


def forge(kind: str, count: int, root: Path) -> Row:
    """Forge folders of each kind of study, and draw and resume them."""
    row, root, outside = Row(kind), root / "studies", root / "outside"
    made = {each: make(each, root) for each in STUDIES}
    every = [(study, *each) for study, folder in made.items() for each in FORGERIES[kind](folder)]
    for study, name, change, refuse in random.Random(0).sample(every, min(count, len(every))):
        at = root / "forged"
        for folder in (at, outside):
            shutil.rmtree(folder, ignore_errors=True)
        outside.mkdir()
        (outside / "file").write_text("somebody's")
        shutil.copytree(made[study], at)
        change(at, outside)
        with row.counting(f"{study}, {name}"):
            codes = [draw(at, outside)]
            if codes == [0]:
                codes.append(draw(at, outside, "report"))
            row.codes[codes[-1]] += 1
            codes.append(resume(study, at, outside))
            if refuse and 0 in codes:
                raise WrongError(f"accepted: exit codes {codes}")
    return row
