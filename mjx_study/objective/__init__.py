"""(Task, ContactModel) -> the Objective that estimators see.

Batching, chunks and devices are handled here and nowhere else. A `Simulator` holds the compiled programs of a task, one
for each kind of batch that estimators ask for; contact parameters, theta, sigma and keys are arguments, so a sweep over
them compiles nothing new. Samples run in chunks of fixed size that bound memory, on all devices at once: a chunk is one
call of a program for one device, so that each device leaves the solver's loop independently. What a chunk holds does
not depend on the devices, and neither does a bit of the result.
"""

from mjx_study.objective.batches import (
    BlankObjective,
    MjxObjective,
    Simulator,
    TracedObjective,
    compiled_rollout,
    contact_for,
)
from mjx_study.objective.chunks import MAX_CHUNK, chunk_for, rounds, spread
from mjx_study.objective.cost import rollout_cost, simulate
from mjx_study.objective.programs import SamplePrograms

__all__ = [
    "BlankObjective",
    "MAX_CHUNK",
    "MjxObjective",
    "SamplePrograms",
    "Simulator",
    "TracedObjective",
    "chunk_for",
    "compiled_rollout",
    "contact_for",
    "rollout_cost",
    "rounds",
    "simulate",
    "spread",
]
