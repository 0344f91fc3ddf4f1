"""Figures from results; nothing here simulates."""
