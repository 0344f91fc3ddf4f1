"""The README's example runs, and its tables are complete."""

import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml

from mjx_study.simulation.contact import FAMILIES
from mjx_study.tasks import TASKS

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def blocks(language: str, text: str = README) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def test_the_python_example_runs(tmp_path: Path) -> None:
    (code,) = blocks("python")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, timeout=600)
    assert done.returncode == 0, done.stderr
    (shown,) = (block for block in blocks("text") if block.startswith("K = "))
    rows = [re.findall(r"^(.*)  variance (.*)$", text, re.MULTILINE) for text in (shown, done.stdout)]
    expected, found = ({label: float(variance) for label, variance in each} for each in rows)
    assert found == pytest.approx(expected, rel=0.5) and len(found) == 9, done.stdout
    assert expected["K = 800000 N/m  fobg"] > 1e9 * expected["K =  10000 N/m  fobg"]
    assert list(tmp_path.iterdir()) == []


def test_the_citation_has_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == version("mjx-study") and f"version = {{{version('mjx-study')}}}" in README
    assert {"cff-version", "message", "title", "authors"} <= set(citation)  # what the schema requires
    assert citation["title"] in README and citation["references"][0]["title"] in README


def test_every_task_is_explained() -> None:
    assert all(f"`{name}`" in README for name in TASKS)


def test_every_target_exists() -> None:
    makefile = (Path(__file__).parents[1] / "Makefile").read_text()
    targets = re.findall(r"^make (\w+)", "".join(blocks("sh")), re.MULTILINE)
    assert targets == ["demo", "test"]
    for target in targets:
        assert re.search(rf"^{target}:", makefile, re.MULTILINE)


@pytest.mark.parametrize("name", list(FAMILIES))
def test_every_family_is_explained(name: str) -> None:
    assert f"| `{name}` |" in README
