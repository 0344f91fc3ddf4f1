"""The work of a cell: calls of each program, and the rest."""

import itertools
import math
from collections import Counter
from typing import Any

import jax
import numpy as np

from mjx_study.objective import contact_for, rounds
from mjx_study.study.gradients import CANDIDATES, takes_candidates
from mjx_study.study.landscapes import CHUNK, QUADRATURE, applies
from mjx_study.study.memory import batches_at_once
from mjx_study.study.plan import (
    StudyCell,
    StudyPlan,
    blocks_of,
    bytes_in_block,
    estimators_of,
    memory_of_seed,
    oracles_of,
    seeds_together,
)
from mjx_study.study.sampling import calls_of, rollouts_of
from mjx_study.study.times import Program, other_program, program_of


def rollouts(plan: StudyPlan, cell: StudyCell) -> tuple[int, int]:
    """Approximate number of rollouts of a cell, and of those differentiated."""
    config, group = plan.config, plan.groups[cell.group]

    def batches(oracles: Any) -> np.ndarray:
        return np.sum([rollouts_of(oracle, cell.samples, group.task.random_start) for oracle in oracles], axis=0)

    if config.kind == "descents":
        assert group.recipe is not None
        each = np.sum([batches(estimator.needs) for estimator in estimators_of(plan, cell)], axis=0)
        total = config.batches * group.recipe.iterations * each + [_evaluations(plan), 0]
    elif config.kind == "landscapes":
        exact = QUADRATURE if not cell.model.analytic and applies(group.task) else 0
        total = (config.points or 0) * config.batches * batches(oracles_of(config)) + [exact, exact]
    else:
        candidates = 0 if cell.model.analytic else CANDIDATES
        total = config.batches * batches(oracles_of(config))
        total = total + [2 * (config.reference_samples or 0) + candidates, candidates]
    return int(total[0]), int(total[1])


def calls(plan: StudyPlan, cell: StudyCell, devices: int) -> Counter[Program]:
    """Sequential calls of each program on several devices at once, without those that compile it.

    Descents of several estimators run in parallel, with calls in the order of the estimators; early stops take less.
    """
    found: Counter[Program] = Counter()
    if cell.model.analytic:
        return found
    task, config, recipe = plan.groups[cell.group].task, plan.config, plan.groups[cell.group].recipe

    def batch(program: str, rows: int, times: int = 1) -> None:
        found[_program(plan, cell, program, plan.chunk_size)] += times * rounds(rows, plan.chunk_size, devices)

    if config.kind == "descents":
        assert recipe is not None
        for estimator in estimators_of(plan, cell):
            found[iteration(plan, cell, estimator.needs)] += recipe.iterations
        batch("value", calls_of("evaluation", config.evaluation_samples or 0, task.random_start)[0][1], _costs(plan))
        return found
    groups = _in_turn(config.batches, seeds_together(plan, cell))
    draws = [some for seeds in groups for some in _in_turn(seeds, batches_at_once(cell.samples))]
    for some, oracle in itertools.product(draws, oracles_of(config)):
        for program, rows in calls_of(oracle, some * cell.samples, task.random_start):
            batch(program, rows, config.points or 1)
    if config.kind == "gradients":
        odd = takes_candidates(task)
        batch("value", (2 if odd else 3) * (config.reference_samples or 0))
        if odd:
            batch("gradient", CANDIDATES)
    elif applies(task):
        found[_program(plan, cell, "quadrature", CHUNK)] += rounds(QUADRATURE, CHUNK, devices)
    return found


def iteration(plan: StudyPlan, cell: StudyCell, needs: tuple[str, ...]) -> Program:
    """Program of an iteration of all seeds of an estimator that needs these oracles."""
    task = plan.groups[cell.group].task
    parts = [part for oracle in needs for part in calls_of(oracle, cell.samples, task.random_start)]
    # chunks of a seed, padded to full size, in sequence for all seeds at once
    rows = sum(math.ceil(rows / plan.chunk_size) * plan.chunk_size for _, rows in parts) * plan.config.batches
    return _program(plan, cell, "+".join(name for name, _ in parts), rows)


def rest(plan: StudyPlan, cell: StudyCell) -> Program:
    """The work of a cell besides its rollout programs, as one call: statistics, or all of an analytic system."""
    config, task = plan.config, plan.groups[cell.group].task
    content = str(config.kind), *config.estimators
    if cell.model.analytic:
        return other_program("analytic", rollouts(plan, cell)[0], task.name, *content, steps=task.horizon)
    if config.kind == "descents":
        numbers = _evaluations(plan) * task.policy.num_params
    elif blocks_of(plan, cell):
        numbers, content = cell.samples * bytes_in_block(plan, cell) // 8 * config.batches, (*content, "in blocks")
    else:
        numbers = memory_of_seed(plan, cell) // 8 * config.batches * (config.points or 1)
    return other_program("statistics", numbers, *content)


def setups(plan: StudyPlan, cell: StudyCell) -> dict[Any, Program]:
    """Programs to compile before a cell is computed, by what they are compiled for."""
    own, other = plan.program_of(cell), rest(plan, cell)
    found: dict[Any, Program] = {other: other}
    for program in calls(plan, cell, 1):
        found[own, program] = program
    if plan.config.kind == "descents" and own is not None:
        for estimator in estimators_of(plan, cell):
            found[own, estimator] = found.pop((own, program := iteration(plan, cell, estimator.needs)), program)
    return found


def _program(plan: StudyPlan, cell: StudyCell, kind: str, rows: int) -> Program:
    contact = contact_for(kind, cell.model.contact)
    return program_of(kind, plan.groups[cell.group].task, jax.tree.structure(contact), rows)


def _costs(plan: StudyPlan) -> int:
    """Number of evaluations of descents' costs: at the end for every seed, and once at the start."""
    return plan.config.batches * len(plan.config.estimators) + 1


def _evaluations(plan: StudyPlan) -> int:
    return _costs(plan) * (plan.config.evaluation_samples or 0)


def _in_turn(count: int, together: int) -> list[int]:
    """Sizes of the groups of at most `together` that make up `count`."""
    return [min(together, count - start) for start in range(0, count, together)]
