"""First-order gradients through contact, of many engines: at points, and on average under noise.

`scenes` defines what is simulated, `adapters` how each engine does, `judge` what is measured, `catalog` names the
engines and their pinned environments, and `python -m experiments.engines.worker ENGINE SCENE TIMESTEP` measures one
cell, in the engine's own environment and process, and prints it as a line of data/engines.jsonl.
"""
