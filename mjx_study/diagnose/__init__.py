"""One-page diagnosis of a model: where contact begins, whether derivatives and means are right, which estimator to use.

Every statement is measured and comes with the command that reproduces it.
"""
