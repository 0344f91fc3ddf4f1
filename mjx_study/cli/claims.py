"""mjx-study claims."""

import argparse
import json
from pathlib import Path
from typing import Any

from mjx_study.choices import unknown
from mjx_study.claims import CLAIMS, NUM_VERDICTS
from mjx_study.claims.ledger import Claim, measure_ledger
from mjx_study.claims.page import count, draw_matrix, markdown, table, told, undecided
from mjx_study.cli.options import UsageError, attempt, computing, configure_process, finish, print_report, usage_errors
from mjx_study.cli.studies import RESUMABLE
from mjx_study.disk import prepare_folder, write_whole
from mjx_study.plots.style import save_figure


def run(options: argparse.Namespace) -> int:
    """Measure the claims and print their verdicts."""
    chosen = _chosen(options.only)
    if options.list:
        listed = [{"id": claim.id, "statement": claim.statement, **_decides(claim)} for claim in chosen]
        lines = [f"{each['id']}\n  {each['statement']}\n  {each['quantity']}: {each['criterion']}" for each in listed]
        print_report(options, {"claims": listed}, lines)
        return 0
    with usage_errors():
        configure_process(options)
        if options.output is not None:
            prepare_folder(options.output)
    with computing(*([RESUMABLE] if options.output else [])) as progress:
        document = measure_ledger(
            chosen,
            options.effort,
            options.output,
            progress,
            verdicts=NUM_VERDICTS,
            command=options.command_line,
            accept_versions=options.accept_versions,
        )
    written, failure = attempt(lambda: _write(document, options.output)) if options.output else ([], None)
    lines = [*table(document), "", count(document), told(document)]
    lines += [f"undecided: {line}" for line in undecided(document)]
    print_report(options, document, [*lines, *(f"written: {path}" for path in written)])
    return finish(failure)


def _chosen(only: list[str] | None) -> list[Claim]:
    names = [name for part in only or [",".join(CLAIMS)] for name in part.split(",")]
    for name in names:
        if name not in CLAIMS:
            raise UsageError(unknown("claim", name, CLAIMS))
    return [claim for name, claim in CLAIMS.items() if name in names]


def _decides(claim: Claim) -> dict[str, str]:
    return {"quantity": claim.criterion.quantity, "criterion": claim.criterion.lines(), "place": claim.place}


def _write(document: dict[str, Any], folder: Path) -> list[Path]:
    """Write the document, the page and the figure."""
    texts = {"claims.json": json.dumps(document, indent=1, allow_nan=False) + "\n", "claims.md": markdown(document)}
    written = [
        write_whole(folder / name, lambda file, text=text: file.write(text.encode())) for name, text in texts.items()
    ]
    return [*written, *save_figure(draw_matrix(document), folder, "claims", ("png",))]
