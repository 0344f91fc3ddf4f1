"""Add measured claims to data/claims.json or claims_quick.json, by their effort, and write docs/claims.md.

    mjx-study claims --full --only laws-unbiased,laws-mend --output DIR && python -m experiments.claims DIR/claims.json

Claims of the code's ledger that were not measured again keep their evidence.
"""

import json
import sys
from pathlib import Path
from typing import Any

from experiments import DATA, DOCS, write_json
from experiments.pages import save_figure
from mjx_study.claims import CLAIMS
from mjx_study.claims.page import draw_matrix, markdown

KEPT = ("effort", "alpha", "level", "verdicts")
"""What measurements of one ledger have in common, beside their versions."""


def merged(stored: dict[str, Any], found: dict[str, Any]) -> dict[str, Any]:
    """Return a stored ledger with the claims of another, in the order of the code.

    Raises:
        ValueError: they have another effort, level or environment, or a claim of the code is in neither.
    """
    if different := [name for name in KEPT if stored[name] != found[name]]:
        raise ValueError(f"measured with another {different[0]} than what is stored")
    if stored["environment"]["versions"] != found["environment"]["versions"]:
        raise ValueError("measured with other versions than what is stored")
    claims = {claim["id"]: claim for each in (stored, found) for claim in each["claims"]}
    if missing := [name for name in CLAIMS if name not in claims]:
        raise ValueError(f"never measured: {', '.join(missing)}")
    revisions = sorted({claims[name]["revision"] or "unknown" for name in CLAIMS})
    return stored | {"revisions": revisions, "not_checked": 0, "claims": [claims[name] for name in CLAIMS]}


def main() -> None:
    """Run the command line."""
    for given in map(Path, sys.argv[1:]):
        found = json.loads(given.read_text())
        path = DATA / ("claims.json" if found["effort"]["name"] == "full" else "claims_quick.json")
        write_json(path, merged(json.loads(path.read_text()), found))
        print(f"written: {path}")
    ledger = json.loads((DATA / "claims.json").read_text())
    (DOCS / "claims.md").write_text(markdown(ledger))
    save_figure(draw_matrix(ledger), "claims")


if __name__ == "__main__":
    main()
