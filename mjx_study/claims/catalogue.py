"""All claims, in the order of the ledger."""

from typing import Final

from mjx_study.claims import contact, descent, robots, theory
from mjx_study.claims.ledger import Claim

CLAIMS: Final[dict[str, Claim]] = {
    claim.id: claim for claim in (*theory.CLAIMS, *contact.CLAIMS, *descent.CLAIMS, *robots.CLAIMS)
}
"""Claims by id."""
VERDICTS: Final = sum(len(claim.cases) for claim in CLAIMS.values())
"""Number of verdicts in the whole ledger, for which the intervals hold simultaneously."""
