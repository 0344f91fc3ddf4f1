"""A ledger of claims by the paper and by this project, each measured and given a verdict."""

from typing import Final

from mjx_study.claims import contact, descent, theory
from mjx_study.claims.claim import Claim, load_claims

CLAIMS: Final[dict[str, Claim]] = load_claims({"theory": theory, "contact": contact, "descent": descent})
"""Claims by id, in the order of the ledger."""
NUM_VERDICTS: Final = sum(len(claim.cases) for claim in CLAIMS.values() if not claim.of_laws)
"""Number of verdicts in the whole ledger, for which the intervals hold simultaneously; without those on other laws than
MuJoCo's, which are quadratures, without sampling error."""
