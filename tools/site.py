"""Build the site that mkdocs.yml describes: stage its pages in build/pages, from which Zensical makes build/site.

The pages are written for GitHub and adapted in the copies: links lead from page to page, formulas become MathML (no
scripts, no network), and notebooks become pages with their outputs. Pages of public names, commands and variables come
from docstrings, the parser and `mjx_study.results.variables`.
"""

import ast
import base64
import io
import os
import re
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from contextlib import redirect_stdout, suppress
from importlib import import_module
from pathlib import Path
from typing import Final

import nbformat
from latex2mathml.converter import convert

from mjx_study import cli
from mjx_study.choices import KINDS
from mjx_study.results.kind import find_kind
from mjx_study.table import markdown_table

ROOT = Path(__file__).parents[1]
PAGES = ROOT / "build" / "pages"
PIPED: Final = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
PACKAGES = ("mjx_study", "mjx_study.gradcheck", "estimators")
OUTPUT = "image/gif", "image/png", "text/html", "text/plain"
"""Kinds of notebook outputs, the best first."""


def site_paths() -> dict[Path, Path]:
    """Return the site's path of each file of the project; both paths are relative."""
    paths = {Path("README.md"): Path("index.md")}
    paths |= {Path(f"{name}.md"): Path(f"{name.lower()}.md") for name in ("CHANGELOG", "CONTRIBUTING")}
    for path in [*sorted((ROOT / "docs").glob("*")), *(ROOT / "tools").glob("site.*")]:
        if path.suffix in (".css", ".gif", ".js", ".md", ".png"):
            paths[path.relative_to(ROOT)] = Path(path.name)
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        paths[path.relative_to(ROOT)] = Path("notebooks", f"{path.stem}.md")
    return paths


def adapted(text: str, page: Path, paths: dict[Path, Path]) -> str:
    """Adapt a page's links and formulas (a fence of `math`, or $`...`$) for the site.

    Links to files outside the site become plain text.
    """

    def link(found: re.Match[str]) -> str:
        bang, label, target = found.groups()
        file, _, anchor = target.partition("#")
        if not file or "://" in target:
            return found[0]
        source = Path(os.path.normpath(page.parent / file))
        if source in paths:
            there = os.path.relpath(paths[source], paths[page].parent)
            return f"{bang}[{label}]({there}{'#' * bool(anchor)}{anchor})"
        if not (ROOT / source).exists():
            raise FileNotFoundError(f"{page} links to {target}")
        return label

    text = re.sub(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)", link, text)
    text = re.sub(r"```math\n(.*?)```", lambda found: convert(found[1], display="block"), text, flags=re.DOTALL)
    return re.sub(r"\$`([^`]+)`\$", lambda found: f"<span>{convert(found[1])}</span>", text)


def parts_of_notebook(path: Path, paths: dict[Path, Path]) -> Iterator[str]:
    """Yield a notebook as Markdown, and write its pictures beside the page."""
    folder, pictures = (PAGES / paths[path]).parent, 0
    title, *cells = nbformat.read(ROOT / path, as_version=4).cells
    yield adapted(title.source, path, paths) + f"\n\n[Download the notebook]({path.name}){{ .notebook download }}"
    for cell in cells:
        if "install" in cell.metadata.get("tags", ()):
            continue
        yield adapted(cell.source, path, paths) if cell.cell_type == "markdown" else f"```python\n{cell.source}\n```"
        for output in cell.get("outputs", ()):
            if output.output_type == "stream":
                yield f"``` {{ .text .output }}\n{output.text.rstrip()}\n```"
                continue
            kind = next(kind for kind in OUTPUT if kind in output.data)
            if kind.startswith("image/"):
                pictures += 1
                picture = folder / f"{path.stem}-{pictures}.{kind.removeprefix('image/')}"
                picture.write_bytes(base64.b64decode(output.data[kind]))
                yield f"![Output of the cell above]({picture.name})"
            elif kind == "text/html":
                table = textwrap.dedent(output.data[kind]).replace(' border="1" class="dataframe"', "")
                yield f'<div class="output">\n{table.strip()}\n</div>'
            else:
                yield f"``` {{ .text .output }}\n{output.data[kind]}\n```"


def page_of_names(package: str) -> str:
    """Return the page of a package: every public name by module."""
    folder = ROOT / package.replace(".", "/")
    source = next(path for path in (folder / "_public.py", folder / "__init__.py") if path.is_file())
    public, names = import_module(package).__all__, dict[str, list[str]]()
    for node in ast.parse(source.read_text()).body:
        if isinstance(node, ast.ImportFrom) and node.module:
            imported = [alias.asname or alias.name for alias in node.names]
            if exported := [name for name in imported if name in public]:
                names.setdefault(node.module, []).extend(exported)
    parts = [f"# {package}", (import_module(package).__doc__ or "").strip()]
    for module, those in names.items():
        about = (import_module(module).__doc__ or "").strip().partition("\n")[0]
        parts += [f"## {module.partition('.')[2]}", about, *(f"::: {package}.{name}" for name in those)]
    return "\n\n".join(parts)


def page_of_variables() -> str:
    """Return the page of variables: a table for each kind of study."""
    parts = ["# Variables of a study", "Dimensions are those within a cell; see [studies](../studies.md#in-python)."]
    for kind in KINDS:
        variables = find_kind(kind).variables.items()
        rows = [(f"`{name}`", ", ".join(each.dims), each.unit, each.description) for name, each in variables]
        parts += [f"## {kind.capitalize()}", markdown_table(rows, ("name", "dimensions", "unit", "meaning"))]
    return "\n\n".join(parts)


def page_of_commands() -> str:
    """Return the page of commands: the help of each."""
    return "\n\n".join(
        ["# Command line", help_of(), *(f"## mjx-study {name}\n\n{help_of(name)}" for name in cli.COMMANDS)]
    )


def help_of(*command: str) -> str:
    text = io.StringIO()
    with redirect_stdout(text), suppress(SystemExit):
        cli.parser(*command).parse_args([*command, "--help"])
    return f"```text\n{text.getvalue()}```"


def main() -> None:
    """Stage all pages and build the site; any issue is an error."""
    shutil.rmtree(PAGES, ignore_errors=True)
    paths = site_paths()
    for source, path in paths.items():
        target = PAGES / path
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.suffix == ".ipynb":
            target.write_text("\n\n".join(parts_of_notebook(source, paths)))
            shutil.copy(ROOT / source, target.parent)
        elif source.suffix == ".md":
            target.write_text(adapted((ROOT / source).read_text(), source, paths))
        else:
            shutil.copy(ROOT / source, target)
    os.environ["COLUMNS"] = "100"  # of the help
    (PAGES / "reference").mkdir()
    pages = {"commands": page_of_commands(), "variables": page_of_variables()}
    for name, text in (pages | {name: page_of_names(name) for name in PACKAGES}).items():
        (PAGES / "reference" / f"{name}.md").write_text(text)
    build = subprocess.run([sys.executable, "-m", "zensical", "build", "--strict", "--clean"], cwd=ROOT, **PIPED)
    print(build.stdout, end="")
    if build.returncode or "griffe:" in build.stdout:  # what griffe says of a docstring is no issue to Zensical
        sys.exit("the site has issues")
    site = ROOT / "build" / "site"
    (site / "search.js").write_text(
        f"var __index = {(site / 'search.json').read_text()};"
    )  # for pages opened from disk


if __name__ == "__main__":
    main()
