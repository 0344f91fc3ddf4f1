"""The site has every page once, and adapts links and formulas that are written for GitHub."""

import dataclasses
import inspect
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from tools import site

ROOT = Path(__file__).parents[1]
PATHS = site.site_paths()


def pages_of(nav: Any) -> list[str]:
    if isinstance(nav, str):
        return [nav]
    return [page for part in (nav.values() if isinstance(nav, dict) else nav) for page in pages_of(part)]


def test_every_page_is_in_the_navigation_once() -> None:
    nav = pages_of(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"])
    staged = [str(place) for place in PATHS.values() if place.suffix == ".md"]
    made = [f"reference/{name}.md" for name in ("commands", "variables", *site.PACKAGES)]
    assert sorted(nav) == sorted(staged + made)
    assert {f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md")} <= {str(source) for source in PATHS}


@pytest.mark.parametrize(
    ("page", "text", "expected"),
    [
        ("README.md", "[a](docs/tasks.md#pusher)", "[a](tasks.md#pusher)"),
        ("docs/tasks.md", "[a](../README.md)", "[a](index.md)"),
        ("docs/tasks.md", "[a](../tests/test_site.py), a [b](https://b.org)", "a, a [b](https://b.org)"),
        ("notebooks/3_bring_your_own.ipynb", "![a [b]](../docs/map.png)", "![a [b]](../map.png)"),
        ("docs/tasks.md", "$HOME and $x$", "$HOME and $x$"),
    ],
)
def test_links_lead_to_pages_of_the_site(page: str, text: str, expected: str) -> None:
    assert site.adapted(text, Path(page), PATHS) == expected


def test_a_dead_link_is_refused() -> None:
    with pytest.raises(FileNotFoundError, match="nowhere"):
        site.adapted("[a](nowhere.md)", Path("docs/tasks.md"), PATHS)


def test_formulas_become_mathml() -> None:
    found = site.adapted("with $`a_0`$\n\n```math\n\\frac{a}{b}\n```\n", Path("README.md"), PATHS)
    assert "<msub><mi>a</mi><mn>0</mn></msub>" in found and "<mfrac>" in found and "`" not in found


def test_films_of_notebooks_are_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of docs/ are the same, of the last run."""
    monkeypatch.setattr(site, "PAGES", tmp_path)
    (tmp_path / "notebooks").mkdir()
    for stem in ("6_teach_a_robot", "7_teach_a_quadruped"):
        page = "\n".join(site.parts_of_notebook(Path("notebooks", f"{stem}.ipynb"), PATHS))
        (film,) = (tmp_path / "notebooks").glob(f"{stem}-*.gif")
        assert f"({film.name})" in page and "<IPython" not in page
        assert film.read_bytes() == (ROOT / "docs" / f"film_{stem}.gif").read_bytes()


@pytest.mark.parametrize("package", site.PACKAGES)
def test_the_page_of_a_package_has_all_public_names(package: str) -> None:
    page = site.page_of_names(package)
    names = [line.removeprefix("::: ") for line in page.splitlines() if line.startswith("::: ")]
    assert sorted(names) == sorted(f"{package}.{name}" for name in site.import_module(package).__all__)


def left_out(found: Any) -> set[str]:
    """Arguments or attributes that a docstring's section leaves out; none without a section."""
    text = inspect.cleandoc(found.__doc__ or "") + "\n"
    section = re.search(r"^(?:Args|Attributes):\n((?: .*\n|\n)+)", text, re.MULTILINE)
    if section is None:
        return set()
    named = ", ".join(re.findall(r"^ {4}(\S[^:\n]*):", section[1], re.MULTILINE)).replace("*", "").split(", ")
    if dataclasses.is_dataclass(found):
        declared = vars(found).get("__annotations__", {})  # a base class documents its fields
        own = {field.name for field in dataclasses.fields(found) if field.name in declared}
    else:
        own = inspect.signature(found).parameters.keys() - {"self"}
    return {name for name in own if not name.startswith("_")} - set(named)


@pytest.mark.parametrize("package", site.PACKAGES)
def test_docstrings_describe_all_arguments_or_attributes(package: str) -> None:
    module = site.import_module(package)
    public = {name: getattr(module, name) for name in module.__all__}
    for name, owner in list(public.items()):
        if isinstance(owner, type):
            methods = inspect.getmembers(owner, inspect.isroutine)
            public |= {f"{name}.{part}": method for part, method in methods if not part.startswith("_")}
    assert not {name: missing for name, each in public.items() if (missing := left_out(each))}
