"""MuJoCo's step with its derivatives: scenes, contact models, the constraint solve, and what MJX gets wrong patched."""
