"""One module per engine; each has `build(scene, timestep, variant)`, which returns a `scenes.Rollout`.

They run in environments of their own, on Python 3.10 or newer, and import engines by name when they build.
"""
