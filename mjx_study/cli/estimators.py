"""mjx-study estimators."""

import argparse

from estimators.choices import DENSITIES, ORACLES
from estimators.registry import ESTIMATORS, options_of_estimators
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
        examples = {option: field.metadata["example"] for option, field in options_of_estimators(name).items()}
        examples.pop("sigma", None)  # that of the noise
        values = {f"--{option.replace('_', '-')}": examples[option] for option in examples if option in item.required()}
        command = f"mjx-study compare pusher --estimators {name}"
        command += "".join(f" {flag} {value}" for flag, value in values.items())
        entry = {part: getattr(item, part) for part in ("name", "label", "description", "needs", "formula", "unbiased")}
        entries.append(entry | {"requires": list(values), "options": list(examples), "example": command})
        needs = " + ".join(ORACLES[oracle].contents for oracle in item.needs)
        rows.append((name, ", ".join([needs, *values]), item.description))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [f"{name:<{widths[0]}}  {needs:<{widths[1]}}  {description}" for name, needs, description in rows]
    lines += ["", "noise densities (--noise)"]
    lines += [f"{name:<{widths[0]}}  {description}" for name, description in DENSITIES.items()]
    densities = [{"name": name, "description": description} for name, description in DENSITIES.items()]
    return print_report(options, {"estimators": entries, "noises": densities}, lines)
