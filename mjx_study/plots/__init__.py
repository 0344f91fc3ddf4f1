"""Figures from results; nothing here simulates."""

import mjx_study._matplotlib  # noqa: F401
