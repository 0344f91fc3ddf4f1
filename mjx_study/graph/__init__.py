"""Graphs of scalar operations: functions of small arrays, entry by entry."""
