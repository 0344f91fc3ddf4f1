"""Computation of a study's cells, here or on a cluster."""
