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
from mjx_study.results.variables import VARIABLES
from mjx_study.table import markdown_table

ROOT = Path(__file__).parents[1]
PAGES = ROOT / "build" / "pages"
PIPED: Final = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
PACKAGES = ("mjx_study", "mjx_study.gradcheck", "estimators")
OUTPUT = {"image/png": "png", "text/html": "html", "text/plain": "text"}
"""Kinds of notebook outputs, the best first."""


def places() -> dict[Path, Path]:
    """Return the site's path of each file of the project; both paths are relative."""
    own = {Path("README.md"): Path("index.md")}
    own |= {Path(f"{name}.md"): Path(f"{name.lower()}.md") for name in ("CHANGELOG", "CONTRIBUTING")}
    for path in sorted((ROOT / "docs").glob("*")):
        if path.suffix in (".css", ".gif", ".js", ".md", ".png"):
            own[path.relative_to(ROOT)] = Path(path.name)
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        own[path.relative_to(ROOT)] = Path("notebooks", f"{path.stem}.md")
    return own


def adapted(text: str, page: Path, own: dict[Path, Path]) -> str:
    """Adapt a page's links and formulas (a fence of `math`, or $`...`$) for the site.

    Links to files outside the site become plain text.
    """

    def link(found: re.Match[str]) -> str:
        bang, label, target = found.groups()
        place, _, anchor = target.partition("#")
        if not place or "://" in target:
            return found[0]
        source = Path(os.path.normpath(page.parent / place))
        if source in own:
            there = os.path.relpath(own[source], own[page].parent)
            return f"{bang}[{label}]({there}{'#' * bool(anchor)}{anchor})"
        if not (ROOT / source).exists():
            raise FileNotFoundError(f"{page} links to {target}")
        return label

    text = re.sub(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)", link, text)
    text = re.sub(r"```math\n(.*?)```", lambda found: convert(found[1], display="block"), text, flags=re.DOTALL)
    text = re.sub(r"\$`([^`]+)`\$", lambda found: f"<span>{convert(found[1])}</span>", text)
    return re.sub(
        r"```mermaid\n(.*?)```", lambda found: drawn(re.findall(r"(\w+) --> (\w+)", found[1])), text, flags=re.DOTALL
    )


def drawn(arrows: list[tuple[str, str]]) -> str:
    """A diagram without loops as SVG: each box below those that point to it, under the middle of them."""
    rows: dict[str, int] = {}
    boxes = dict.fromkeys(box for arrow in arrows for box in arrow)
    for _ in boxes:
        rows = {box: max((rows.get(start, 0) + 1 for start, end in arrows if end == box), default=0) for box in boxes}
    columns: dict[str, float] = {}
    for row in range(max(rows.values()) + 1):
        above = {box: [columns[start] for start, end in arrows if end == box] for box in boxes if rows[box] == row}
        wish = {box: sum(xs) / len(xs) if xs else 0.0 for box, xs in above.items()}
        order = sorted(wish, key=lambda box: wish[box])
        middle = sum(wish.values()) / len(wish)
        columns |= {box: middle + 130 * (place - (len(order) - 1) / 2) for place, box in enumerate(order)}
    left, right, bottom = min(columns.values()) - 60, max(columns.values()) + 60, 64 * max(rows.values()) + 34
    lines = [
        f'<line x1="{columns[a]:.0f}" y1="{64 * rows[a] + 31}" x2="{columns[b]:.0f}" y2="{64 * rows[b] - 4}"/>'
        for a, b in arrows
    ]
    texts = [
        f'<rect x="{x - 52:.0f}" y="{64 * rows[box] + 1}" width="104" height="30" rx="4"/>'
        f'<text x="{x:.0f}" y="{64 * rows[box] + 21}">{box}</text>'
        for box, x in columns.items()
    ]
    size = 'viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8"'
    head = f'<marker id="head" {size} orient="auto"><path d="M0 0L8 4L0 8z"/></marker>'
    return (
        f'<svg class="diagram" viewBox="{left:.0f} 0 {right - left:.0f} {bottom}">{head}{"".join(lines + texts)}</svg>'
    )


def parts_of_notebook(path: Path, own: dict[Path, Path]) -> Iterator[str]:
    """Yield a notebook as Markdown, and write its pictures beside the page."""
    folder, pictures = (PAGES / own[path]).parent, 0
    title, *cells = nbformat.read(ROOT / path, as_version=4).cells
    yield adapted(title.source, path, own) + f"\n\n[Download the notebook]({path.name}){{ .notebook download }}"
    for cell in cells:
        if "install" in cell.metadata.get("tags", ()):
            continue
        yield adapted(cell.source, path, own) if cell.cell_type == "markdown" else f"```python\n{cell.source}\n```"
        for output in cell.get("outputs", ()):
            if output.output_type == "stream":
                yield f"``` {{ .text .output }}\n{output.text.rstrip()}\n```"
                continue
            kind = next(kind for kind in OUTPUT if kind in output.data)
            if kind == "image/png":
                pictures += 1
                picture = folder / f"{path.stem}-{pictures}.png"
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
    for kind, variables in VARIABLES.items():
        rows = [(f"`{name}`", ", ".join(each.dims), each.unit, each.description) for name, each in variables.items()]
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
    own = places()
    for source, place in own.items():
        target = PAGES / place
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.suffix == ".ipynb":
            target.write_text("\n\n".join(parts_of_notebook(source, own)))
            shutil.copy(ROOT / source, target.parent)
        elif source.suffix == ".md":
            target.write_text(adapted((ROOT / source).read_text(), source, own))
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
