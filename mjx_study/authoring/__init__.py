"""Task files for models that have none, proposed from test rollouts in MuJoCo's C engine."""
