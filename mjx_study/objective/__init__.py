"""Turn a task and a contact model into the Objective that estimators take.

Batching, chunks and devices are handled only here. A `Simulator` holds the compiled programs of a task, one for each
kind of batch that estimators need; contact parameters, theta, sigma and keys are arguments, so sweeping them compiles
nothing new. Samples run in fixed-size chunks that bound memory, on all devices at once: each chunk is one call of a
program on one device, so that devices leave the solver's loop independently. The contents of a chunk do not depend on
the devices, and neither do the bits of the result.
"""

from mjx_study.objective.batches import BlankObjective, MjxObjective, Simulator, TracedObjective, compiled_rollout
from mjx_study.objective.chunks import MAX_CHUNK, chunk_for, natively, spread
from mjx_study.objective.cost import rollout_cost, simulate
from mjx_study.objective.programs import SamplePrograms

__all__ = [
    "BlankObjective", "MAX_CHUNK", "MjxObjective", "SamplePrograms", "Simulator", "TracedObjective", "chunk_for",
    "compiled_rollout", "natively", "rollout_cost", "simulate", "spread",
]  # fmt: skip
