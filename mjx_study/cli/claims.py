"""mjx-study claims."""

import argparse
import json
from pathlib import Path

from mjx_study.choices import unknown
from mjx_study.cli.options import configure_process, usage_errors
from mjx_study.cli.output import RESUMABLE, attempt, computing, print_report
from mjx_study.options.parser import DEVICES, Parser, UsageError

EPILOG = """\
Each claim has a statistic, a range of values in which the claim holds, and a range in which its opposite holds. The
statistic's confidence interval decides between holds, fails, reversed and undecided; for the last, the number of
samples that would decide is printed. All intervals hold simultaneously with probability 95 % (Bonferroni), whichever
claims are run.

With --output, measurements are saved as they are made: a stopped run can be resumed, and a claim whose definition or
code has changed is measured again. The folder also gets claims.json, claims.md and claims.png. Claims on contact laws
other than MuJoCo's need the extra `laws`; without it they are counted as not checked.

examples:
  mjx-study claims --quick --output out
  mjx-study claims --only lemma-closed-form,friction-variance
"""


def add(command: Parser) -> None:
    effort = command.add_mutually_exclusive_group()
    effort.add_argument("--quick", dest="effort", action="store_const", const="quick", help="minutes (default)")
    effort.add_argument("--full", dest="effort", action="store_const", const="full", help="hours; narrower intervals")
    command.set_defaults(effort="quick")
    only = "run only these claims; may be repeated (default: all)"
    command.add_argument("--only", action="append", metavar="ID[,ID]", help=only)
    command.add_argument("--output", type=Path, metavar="DIR", help="folder for measurements and verdicts; resumable")
    command.add_flag("--list", "print the claims and their criteria; measure nothing")
    command.add_flag("--accept-versions", "resume studies in DIR begun by other versions of the software")
    command.add_option(DEVICES)


def run(options: argparse.Namespace) -> int:
    from mjx_study.claims import CLAIMS, NUM_VERDICTS
    from mjx_study.claims.ledger import measure_ledger
    from mjx_study.claims.page import draw_matrix, markdown, matrix_lines, run_summary, undecided, verdict_counts
    from mjx_study.disk import prepare_folder, write_whole
    from mjx_study.plots.style import save_figure
    from mjx_study.simulation.law import INSTALL, installed

    names = [name for part in options.only or CLAIMS for name in part.split(",")]
    for name in names:
        if name not in CLAIMS:
            raise UsageError(unknown("claim", name, CLAIMS))
    chosen = [claim for name, claim in CLAIMS.items() if name in names]
    if options.list:
        listed = [
            {"id": claim.id, "statement": claim.statement, "quantity": claim.criterion.quantity}
            | {"criterion": claim.criterion.lines(), "place": claim.place}
            for claim in chosen
        ]
        lines = [f"{each['id']}\n  {each['statement']}\n  {each['quantity']}: {each['criterion']}" for each in listed]
        return print_report(options, {"claims": listed}, lines)
    if all(claim.of_laws for claim in chosen) and not installed():
        raise UsageError(f"{chosen[0].id} {INSTALL}")
    if options.accept_versions and options.output is None:
        raise UsageError("--accept-versions needs the folder to resume: give --output")
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

    def write() -> list[Path]:
        texts = {
            "claims.json": json.dumps(document, indent=1, allow_nan=False) + "\n",
            "claims.md": markdown(document),
        }
        written = [write_whole(options.output / name, text.encode()) for name, text in texts.items()]
        return [*written, *save_figure(draw_matrix(document), options.output, "claims", ("png",))]

    written, failure = attempt(write) if options.output else ([], None)
    lines = [*matrix_lines(document), "", verdict_counts(document), run_summary(document)]
    lines += undecided(document)
    return print_report(options, document, [*lines, *(f"written: {path}" for path in written)], failure)
