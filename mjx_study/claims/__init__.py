"""A ledger of claims by the paper and by this project, each measured and given a verdict."""
