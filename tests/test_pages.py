"""Pages: links lead to a file and a heading, names of modules exist, and the README's example runs and is complete."""

import os
import pkgutil
import re
import subprocess
from importlib.metadata import version
from pathlib import Path

import nbformat
import pytest
import yaml

from mjx_study.simulation.contact import FAMILIES
from mjx_study.tasks import TASKS
from tests.processes import ROOT, run_script

README = (ROOT / "README.md").read_text()
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "notebooks").glob("*.ipynb")]


def prose(path: Path) -> str:
    """The Markdown of a page or notebook, without code."""
    text = path.read_text()
    if path.suffix == ".ipynb":
        cells = nbformat.reads(text, as_version=4).cells
        text = "\n\n".join(cell.source for cell in cells if cell.cell_type == "markdown")
    return re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)


def anchors(path: Path) -> list[str]:
    """Anchors of a page's headings, as GitHub and the site make them."""
    headings = re.findall(r"^#+ (.*)$", prose(path), re.MULTILINE)
    return [re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-") for heading in headings]


def dead_links(text: str, page: Path) -> list[str]:
    """Links of a page that lead nowhere."""
    dead = []
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        place, _, anchor = target.partition("#")
        path = Path(os.path.normpath(page.parent / place)) if place else page
        if not target.startswith("https://") and not (path.exists() and (not anchor or anchor in anchors(path))):
            dead.append(target)
    return dead


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    assert not dead_links(prose(page), page)


def test_a_dead_link_is_found() -> None:
    text = "[a](docs/tasks.md#pusher) [b](docs/tasks.md#pushed) [c](nowhere.md) [d](https://b.org) [e](#tasks)"
    assert dead_links(text, ROOT / "README.md") == ["docs/tasks.md#pushed", "nowhere.md"]


@pytest.mark.parametrize("page", [page for page in PAGES if page.name != "CHANGELOG.md"], ids=lambda page: page.name)
def test_modules_and_names_exist(page: Path) -> None:
    for name in re.findall(r"`((?:mjx_study|estimators)(?:\.\w+)+)(?:\(.*?\))?`", prose(page)):
        assert pkgutil.resolve_name(name) is not None


def test_no_file_has_a_conflict_marker() -> None:
    found = subprocess.run(
        ["git", "grep", "-I", "--name-only", f"^{7 * '<'} "], cwd=ROOT, capture_output=True, text=True
    )
    assert (found.returncode, found.stdout) in ((1, ""), (128, ""))  # nothing found, or not a checkout


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_the_python_example_runs(tmp_path: Path) -> None:
    (code,) = blocks("python")
    done = run_script(code, cwd=tmp_path, timeout=600)
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


def test_every_task_and_family_is_explained() -> None:
    assert all(f"`{name}`" in README for name in TASKS)
    assert all(f"| `{name}` |" in README for name in FAMILIES)
