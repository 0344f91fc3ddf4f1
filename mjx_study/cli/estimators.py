"""mjx-study estimators."""

import argparse

from estimators.catalogue import CATALOGUE, DENSITIES
from mjx_study.cli.options import print_report

WORDS = {
    "evaluation": "values",
    "pair": "pairs",
    "steps": "steps",
    "step_pair": "pairs by step",
    "differentiation": "gradients",
    "corrected": "corrected gradients",
    "step_differentiation": "gradients by step",
    "linearisation": "derivatives of steps",
}


def run(options: argparse.Namespace) -> int:
    entries = [
        {
            "name": item.name,
            "description": item.description,
            "needs": list(item.needs),
            "requires": [f"--{name.replace('_', '-')}" for name in item.required if name != "sigma"],
        }
        for item in CATALOGUE.values()
    ]
    densities = [{"name": name, "description": line} for name, line in DENSITIES.items()]
    rows = [[entry["name"], _needs(entry), entry["description"]] for entry in entries]
    width = max(len(row[0]) for row in rows), max(len(row[1]) for row in rows)
    lines = [f"{name:<{width[0]}}  {needs:<{width[1]}}  {description}" for name, needs, description in rows]
    lines += [
        "",
        "noise densities (--noise)",
        *(f"{item['name']:<{width[0]}}  {item['description']}" for item in densities),
    ]
    print_report(options, {"estimators": entries, "noises": densities}, lines)
    return 0


def _needs(entry) -> str:
    words = " + ".join(WORDS[name] for name in entry["needs"])
    return f"{words}, {', '.join(entry['requires'])}" if entry["requires"] else words
