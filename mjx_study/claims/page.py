"""A measured ledger as text, for the terminal and docs/claims.md, and as a figure."""

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any, Final

from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from mjx_study.claims.ledger import FAMILIES, VERDICTS
from mjx_study.plots.style import TITLES
from mjx_study.table import format_table

HEAD: Final = """\
# Which claims survive

Which claims about these gradient estimators hold, and in which contact models? This ledger has claims of [Suh et al.
2022](https://arxiv.org/abs/2202.00817), answers to the questions that the paper leaves open, and claims of this
project. Each is measured on the analytic references and in MJX's [contact models](contact-models.md). A criterion next
to the claim in the code decides it: the values of one statistic for which the claim holds, and those for which the
opposite does.

```sh
mjx-study claims --full --output out           # all of them, in hours, resumable; out/claims.md is this page
mjx-study claims --quick --output out          # with fewer samples, in 11 minutes on two cores
mjx-study claims --only lemma-closed-form      # one, or several separated by commas
```

![Verdicts of all claims by contact family](claims.png)
"""
LEGEND: Final = """\
The *interval* of the statistic decides. If it lies inside the range that the claim requires, the claim **holds**; if it
lies inside the range of the opposite, the claim is **reversed**; if it lies outside the required range, the claim
**fails**. If the interval crosses a border, the claim is undecided, and the last column says how many samples would
decide it if the estimate stayed the same. In the picture, a square has a strip for each system, in the order of the
tables. "reference" is the analytic system, and "mjcf" a model without contact. The contact stiffness is 10 kN/m where
none is named.

Not everything was fixed before the first numbers were seen. The following were settled afterwards: the statistics of
`variance-hides-bias` and `bound-helps-at-jumps`, gamma in `aobg-gains-away`, the 2 s of `chaos-crossover`, some batch
sizes, the bar's angle of 0.75 rad (at 0.77 rad the bias of the default contact happens to pass through zero), and the
full recipe for the ball's descents (zeroth order clears the wall late). In quick runs, all other descents are cut to
40 % of their recipes and use twelve seeds (with five, little was decided). The claims on relaxed backward passes were
written after a look at one landscape of `momentum_transfer`, and the claim on the robot after one batch.

Both efforts have been run; `docs/claims_quick.json` is the quick ledger, which leaves 53 verdicts undecided. The full
ledger was measured in parts, by code that changed in between; 67 of its verdicts were measured again by the latest of
that code and came out the same to the last digit. The three claims on the onset term's accuracy and cost are newer:
they were measured again when the term came to cover the end of contact. The verdicts that only the full ledger decides
are mostly those where descents scatter or a variance has heavy tails. It does not confirm the following verdicts of the
quick ledger.
Under `smooth_onset` the derivative at the wall's edge has spikes that neither grid resolves (40 and 200 points per
standard deviation), so that `empirical-bias-in-contact` holds on the coarse grid and fails on the fine one, and
`ivw-inaccurate-at-jumps` becomes undecided. In `relaxed-backward-helps`, the bias of `impedance` with exact derivatives
is 1.0 % on the coarse grid and 0.2 % on the fine one, too close to zero to divide by. On `sliding_box` under
`mujoco_default`, one of thirty first-order descents ends far above the others, which leaves `aobg-as-good` undecided.
Estimates of quadrature errors are not bounds: on the dome under `smooth_onset` the relative bias goes from
0.48 ± 0.67 to -1.2 ± 1.0.

Not in the ledger: descents on the robots, means of `landing` ([there](tasks.md#landing)), and friction's slip tolerance
in MJX. Descents on `tennis` use 12 seeds and fewer samples than the task's recipe. With so few samples, first order
diverges on the reference, so that case is left out.
"""
COLOURS: Final = {"holds": "#0072B2", "fails": "#E69F00", "reversed": "#D55E00", "undecided": "#DDDDDD"}
SIGNS: Final = {"holds": "+", "fails": "×", "reversed": "−", "undecided": "?"}
"""Signs that distinguish verdicts without colours."""


def told(document: dict[str, Any]) -> str:
    """Describe the run and the confidence of the intervals in one paragraph."""
    made = document["environment"]
    versions = ", ".join(f"{name} {version}" for name, version in made["versions"].items() if name != "mjx-study")
    return (
        f"Measured with `{document['command'] or 'measure_ledger'}` ({document['effort']['name']} effort) on "
        f"{made['cores']} cores ({made['processor']}), {made['precision']}; {versions}. The ledger has "
        f"{document['verdicts']} verdicts. Each interval is at level {document['level']:.5f}, that is 1 - "
        f"{document['alpha']:g} / {document['verdicts']} (Bonferroni): with a probability of at least "
        f"{1 - document['alpha']:g}, no interval of the whole ledger misses its value by chance. "
        "Intervals include estimates of the quadrature error, which are not bounds."
    )


def count(document: dict[str, Any]) -> str:
    """Count the verdicts of each kind."""
    found = Counter(each["verdict"] for claim in document["claims"] for each in claim["evidence"])
    listed = ", ".join(f"{found[verdict]} {verdict}" for verdict in VERDICTS if found[verdict])
    return f"{len(document['claims'])} claims, {sum(found.values())} verdicts: {listed}"


def table(document: dict[str, Any]) -> list[str]:
    """Format the matrix for a terminal."""
    header, *rows = cells(document)
    return format_table(rows, header)


def matrix(document: dict[str, Any]) -> tuple[dict[str, dict[str, list[str]]], list[str]]:
    """Verdicts of a claim's systems, by claim and family; and the families with any verdicts, which are its columns."""
    rows: dict[str, dict[str, list[str]]] = {}
    for claim in document["claims"]:
        row = rows.setdefault(claim["id"], {})
        for each in claim["evidence"]:
            row.setdefault(each["family"], []).append(each["verdict"])
    return rows, [family for family in FAMILIES if any(family in row for row in rows.values())]


def cells(document: dict[str, Any]) -> list[list[str]]:
    """Matrix as text: a row of families, then one for each claim."""
    rows, shown = matrix(document)
    summary = [[name, *(_summary(row.get(family, [])) for family in shown)] for name, row in rows.items()]
    return [["", *shown], *summary]


def _summary(verdicts: list[str]) -> str:
    """Common verdict, or the number of systems for which the claim holds."""
    if len(set(verdicts)) < 2:
        return "".join(verdicts[:1])
    return f"{verdicts.count('holds')} of {len(verdicts)} hold"


def undecided(document: dict[str, Any]) -> list[str]:
    """Return a line for each undecided verdict, with the samples that would decide it."""
    return [
        f"{claim['id']}, {each['system']}, {each['family']}: {_interval(each)}, {_deciding(each)}"
        for claim in document["claims"]
        for each in claim["evidence"]
        if each["verdict"] == "undecided"
    ]


def markdown(document: dict[str, Any]) -> str:
    """Return the text of docs/claims.md."""
    header, *rows = cells(document)
    linked = [[f"[{name}](#{name})", *verdicts] for name, *verdicts in rows]
    parts = [HEAD, f"*{count(document)}.* {told(document)}\n", LEGEND, _pipes(header, linked)]
    for claim in document["claims"]:
        parts.append(
            f"## {claim['id']}\n\n{claim['statement']} *({claim['place']}.)*\n\n"
            f"- Statistic: {claim['quantity']}; {claim['criterion']}.\n- Shown by `{claim['show']}`.\n"
        )
        rows = []
        for each in claim["evidence"]:
            decided = each["verdict"] != "undecided"
            verdict, size = (f"**{each['verdict']}**", "") if decided else ("undecided", _deciding(each))
            number = _number(each["estimate"])
            rows.append([each["system"], f"`{each['family']}`", number, _interval(each), verdict, size])
        parts.append(_pipes(("system", "contact", "estimate", "interval", "verdict", "would decide"), rows))
    return "\n".join(parts)


def _pipes(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(header)} |", f"|{' --- |' * len(header)}", *(f"| {' | '.join(row)} |" for row in rows)]
    return "\n".join(lines) + "\n"


def _deciding(each: dict[str, Any]) -> str:
    if each["deciding"] is None:
        return "unknown"
    size = float(format(each["deciding"], ".2g"))
    return f"{size:,.0f} {each['of']} in place of {each['samples']:,}"


def _interval(each: dict[str, Any]) -> str:
    return f"{_number(each['lower'], -math.inf)} to {_number(each['upper'])}"


def _number(value: float | None, absent: float = math.inf) -> str:
    value = absent if value is None else value
    return f"{value:.3g}"


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
