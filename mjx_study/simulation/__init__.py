"""MuJoCo's step with its derivatives: scenes, contact models, the constraint solve, and patches for MJX's faults."""
