"""A measured ledger as text, for the terminal and docs/claims.md, and as a figure."""

import math
from collections import Counter
from pathlib import Path
from typing import Any, Final

from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from mjx_study.claims.claim import VERDICTS
from mjx_study.claims.laboratory import FAMILIES
from mjx_study.plots.style import TITLES
from mjx_study.table import format_table, markdown_table

TEMPLATE: Final = Path(__file__).with_name("page.md")
COLOURS: Final = {"holds": "#0072B2", "fails": "#E69F00", "reversed": "#D55E00", "undecided": "#DDDDDD"}
SIGNS: Final = {"holds": "+", "fails": "×", "reversed": "−", "undecided": "?"}
"""Signs that distinguish verdicts without colours."""


def run_summary(document: dict[str, Any]) -> str:
    """Describe the run and the confidence of the intervals in one paragraph."""
    made = document["environment"]
    versions = ", ".join(f"{name} {version}" for name, version in made["versions"].items() if name != "mjx-study")
    return (
        f"All {document['verdicts']} intervals on MuJoCo's contact and on analytic systems, each at level "
        f"{document['level']:.5f}, hold at once with probability {1 - document['alpha']:g} (Bonferroni); those on "
        f"other laws have no sampling error. All include estimates of the quadrature error, which are not bounds. "
        f"Measured with `{document['command'] or 'measure_ledger'}` on {made['cores']} cores "
        f"({made['processor']}), {made['precision']}; {versions}."
    )


def verdict_counts(document: dict[str, Any]) -> str:
    found = Counter(each["verdict"] for claim in document["claims"] for each in claim["evidence"])
    listed = ", ".join(f"{found[verdict]} {verdict}" for verdict in VERDICTS if found[verdict])
    without = document.get("not_checked", 0)
    missing = f"; not checked: {without}, which need mjx-study[laws]" if without else ""
    return f"{len(document['claims'])} claims, {sum(found.values())} verdicts: {listed}{missing}"


def matrix_lines(document: dict[str, Any]) -> list[str]:
    """Format the matrix for a terminal: a row of families, then one for each claim."""
    rows, shown = matrix(document)
    summary = [[name, *(_summary(row.get(family, [])) for family in shown)] for name, row in rows.items()]
    return format_table(summary, ["", *shown])


def matrix(document: dict[str, Any]) -> tuple[dict[str, dict[str, list[str]]], list[str]]:
    """Verdicts of a claim's systems, by claim and family; and the families with any verdicts, which are its columns."""
    rows: dict[str, dict[str, list[str]]] = {}
    for claim in document["claims"]:
        row = rows.setdefault(claim["id"], {})
        for each in claim["evidence"]:
            row.setdefault(each["family"], []).append(each["verdict"])
    return rows, [family for family in FAMILIES if any(family in row for row in rows.values())]


def _summary(verdicts: list[str]) -> str:
    """Common verdict, or the share of systems for which the claim holds."""
    return "".join(verdicts[:1]) if len(set(verdicts)) < 2 else f"{verdicts.count('holds')}/{len(verdicts)}"


def undecided(document: dict[str, Any]) -> list[str]:
    """Return a line for each undecided verdict, with the samples that would decide it."""
    return [
        f"{claim['id']}, {each['system']}, {each['family']}: ({_interval(each)}), {_verdict(each)}"
        for claim in document["claims"]
        for each in claim["evidence"]
        if each["verdict"] == "undecided"
    ]


def markdown(document: dict[str, Any]) -> str:
    """Return the text of docs/claims.md."""
    return TEMPLATE.read_text().format(
        counts=verdict_counts(document),
        run=run_summary(document),
        claims="\n\n".join(map(_section, document["claims"])),
    )


def _section(claim: dict[str, Any]) -> str:
    """Evidence for a claim; a system is named once."""
    rows, before = [], ""
    for each in claim["evidence"]:
        estimate = f"{_number(each['estimate'])} ({_interval(each)})"
        system, before = "" if each["system"] == before else each["system"], each["system"]
        verdict = "" if each["verdict"] == "holds" else _verdict(each)
        rows.append([system, f"`{each['family']}`", estimate, verdict])
    table = markdown_table(rows, ("system", "contact", "estimate (interval)", "verdict"))
    return (
        f"## {claim['id']}\n\n{claim['statement']} *({claim['place']}.)*\n\n"
        f"Statistic: {claim['quantity']}; {claim['criterion']}. `{claim['show']}`\n\n{table}"
    )


def _verdict(each: dict[str, Any]) -> str:
    """The verdict; if it is undecided, with the number of samples that would decide it."""
    if each["verdict"] != "undecided":
        return each["verdict"]
    size = each["deciding"]
    return "undecided" if size is None else f"undecided ({float(f'{size:.2g}'):,.0f} {each['of']})"


def _interval(each: dict[str, Any]) -> str:
    return f"{_number(each['lower'], -math.inf)}, {_number(each['upper'])}"


def _number(value: float | None, absent: float = math.inf) -> str:
    return f"{absent if value is None else value:.3g}"


def draw_matrix(document: dict[str, Any]) -> Figure:
    """Draw a square for each claim and family, with a strip for each system."""
    rows, shown = matrix(document)
    figure = Figure(figsize=(3.6 + 0.5 * len(shown), 1.9 + 0.24 * len(rows)), layout="constrained")
    axes = figure.subplots()
    for down, row in enumerate(rows.values()):
        for across, family in enumerate(shown):
            verdicts = row.get(family, [])
            for index, verdict in enumerate(verdicts):
                width = 0.92 / len(verdicts)
                left = across - 0.46 + index * width
                axes.add_patch(Rectangle((left, down - 0.44), width, 0.88, color=COLOURS[verdict], linewidth=0))
                colour = "black" if verdict == "undecided" else "white"
                middle = left + width / 2
                axes.text(middle, down, SIGNS[verdict], ha="center", va="center", color=colour, fontsize=8)
    axes.set_xlim(-0.5, len(shown) - 0.5)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xticks(range(len(shown)), [TITLES[name] for name in shown], rotation=40, ha="left", fontsize=8)
    axes.set_yticks(range(len(rows)), list(rows), fontsize=8)
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    for spine in axes.spines.values():
        spine.set_visible(False)
    handles = [Rectangle((0, 0), 1, 1, color=COLOURS[verdict]) for verdict in VERDICTS]
    labels = [f"{SIGNS[verdict]} {verdict}" for verdict in VERDICTS]
    figure.legend(handles, labels, loc="outside lower center", ncols=len(VERDICTS), frameon=False, fontsize=8)
    return figure
