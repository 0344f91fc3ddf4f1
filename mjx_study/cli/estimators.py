"""mjx-study estimators."""

import argparse

from estimators.choices import DENSITIES, ORACLES
from estimators.registry import ESTIMATORS
from mjx_study.cli.output import print_report
from mjx_study.options.parser import Parser

EPILOG = """\
The second column says what each needs: values (rollouts), pairs (of opposite noise), steps (costs to go), gradients, or
derivatives of every step. compare, optimise and sweep accept any of them in --estimators.
"""


def add(command: Parser) -> None:
    """Add no options beyond --json."""


def run(options: argparse.Namespace) -> int:
    entries, rows = [], []
    for name, item in ESTIMATORS.items():
        flags = [f"--{option.replace('_', '-')}" for option in item.required() if option != "sigma"]
        needs = " + ".join(ORACLES[oracle].contents for oracle in item.needs)
        entries.append({"name": name, "description": item.description, "needs": list(item.needs), "requires": flags})
        rows.append((name, ", ".join([needs, *flags]), item.description))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [f"{name:<{widths[0]}}  {needs:<{widths[1]}}  {description}" for name, needs, description in rows]
    lines += ["", "noise densities (--noise)"]
    lines += [f"{name:<{widths[0]}}  {description}" for name, description in DENSITIES.items()]
    densities = [{"name": name, "description": description} for name, description in DENSITIES.items()]
    return print_report(options, {"estimators": entries, "noises": densities}, lines)
