"""A ledger of the paper's claims and of this project's own, each measured and given a verdict."""
