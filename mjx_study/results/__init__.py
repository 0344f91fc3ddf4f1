"""Quantities of a study, and the findings that they support."""
