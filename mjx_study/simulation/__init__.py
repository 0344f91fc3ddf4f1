"""MuJoCo's step with derivatives: scenes, contact models, the constraint solve, and patches for faults of MJX."""
