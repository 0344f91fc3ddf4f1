"""Table of docs/robots.md: what a robot's native step computes and moves, against what an H100 can.

    python -m experiments.work

Operations are those of the statements, in loops as often as `STATES` states in contact run them. Loads and stores are
those that the best allocation of an H100's registers leaves, of the statements in their order: a value is put into
memory if others that are used sooner need its register, and is read again when it is used.
"""

import heapq
import os
from collections import defaultdict
from collections.abc import Iterable, Iterator
from typing import Any, Final

import jax
import numpy as np

import mjx_study
from experiments import DOCS
from experiments.drop_in import start_states
from experiments.native import number
from experiments.pages import write_tables
from experiments.robots import ROBOTS, SAMPLES, loaded, results, standing
from mjx_study.graph import numpy_code
from mjx_study.graph.c import Writer
from mjx_study.graph.native import SWITCH
from mjx_study.graph.parts import Loop, Statement
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.native_step import solved_graph
from mjx_study.table import markdown_table

STATES: Final = 256
REGISTERS: Final = 255 // 2  # of 64 bits, that a thread of an H100 has
OPERATIONS: Final = 34e12 / 2
"""Operations in float64 per second of an H100 (SXM), a fused multiplication and addition as one [data sheet]."""
BANDWIDTH: Final = 3.35e12  # bytes per second of an H100's memory [data sheet]


def passes_of(name: str) -> dict[str, float]:
    """Mean passes per sample of each loop of a step, by the name that NumPy's source has for it."""
    os.environ[SWITCH], found, looped = "0", defaultdict[str, float](float), numpy_code._looped

    def counted(one_pass: Any, inputs: Any, carried: Any, fixed: Any) -> Any:
        def one(*arguments: Any) -> Any:
            again, after = one_pass(*arguments)
            found[one_pass.__name__] += float(np.sum(np.broadcast_to(again, arguments[2][0].shape)))
            return again, after

        return looped(one, inputs, carried, fixed)

    numpy_code._looped = counted
    host = loaded(ROBOTS[name])
    model, data = mjx.put_model(host), mjx.make_data(host)
    qpos, qvel = start_states(host, STATES)
    data = data.replace(ctrl=standing(host))
    advance = lambda qpos, qvel: mjx_study.step(model, data.replace(qpos=qpos, qvel=qvel)).qvel  # noqa: E731
    jax.block_until_ready(jax.jit(jax.vmap(advance))(qpos, qvel))
    assert found
    return {each: count / STATES for each, count in found.items()}


def in_order(items: Iterable[Statement | Loop], passes: dict[str, float]) -> Iterator[tuple[Any, float]]:
    """Statements with how often they run; those of a loop twice, so that the second time shows a pass among others."""
    numbers = {at: place for place, at in enumerate(_inner_first(items))}

    def along(items: Iterable[Statement | Loop], often: float) -> Iterator[tuple[Any, float]]:
        for each in items:
            if isinstance(each, Statement):
                yield each, often
            else:
                inside = [*each.test, *each.body]
                yield from along(inside, 0.0)
                yield from along(inside, passes.get(f"pass{numbers[id(each)]}", 0.0) if often else 0.0)

    return along(items, 1.0)


def _inner_first(items: Iterable[Statement | Loop]) -> list[int]:
    found: list[int] = []
    for each in items:
        if isinstance(each, Loop):
            found += [*_inner_first([*each.test, *each.body]), id(each)]
    return found


def moved(steps: list[tuple[Statement, float]], inputs: Iterable[int]) -> float:
    """Loads and stores of a thread with `REGISTERS`, by the rule that gives up the value that is used last."""
    uses: dict[int, list[int]] = {}
    for place, (each, _) in reversed(list(enumerate(steps))):
        for at in each.uses:
            uses.setdefault(at, []).append(place)
    kept, stored, found, never = dict[int, int](), set(inputs), 0.0, len(steps)
    order: list[tuple[int, int]] = []

    def following(at: int, place: int) -> int:
        left = uses.get(at, [])
        while left and left[-1] <= place:
            left.pop()
        return left[-1] if left else never

    def keep(at: int, place: int, often: float) -> float:
        kept[at] = following(at, place)
        heapq.heappush(order, (-kept[at], at))
        moves = 0.0
        while len(kept) > REGISTERS:
            when, last = heapq.heappop(order)
            if kept.get(last) != -when:
                continue
            del kept[last]
            if -when < never and last not in stored:
                stored.add(last)
                moves += often
        return moves

    for place, (each, often) in enumerate(steps):
        for at in each.uses:
            found += 0 if at in kept else often
            found += keep(at, place, often)
        for at in each.defines:
            stored.discard(at)
            found += keep(at, place, often)
        found += 0 if each.defines else often
    return found


def work(name: str) -> tuple[float, float]:
    """Operations, and bytes loaded and stored, of a sample's step."""
    host = loaded(ROBOTS[name])
    found = solved_graph(mjx.put_model(host), mjx.make_data(host))
    assert found is not None
    solved, (*_, used) = found
    writer = Writer(solved.of(used))
    items, *_ = writer.written(None)
    steps = list(in_order(items, passes_of(name)))
    return sum(often * each.size for each, often in steps if each.defines), 8 * moved(steps, writer.loads)


def main() -> None:
    """Write the table."""
    mjx_study.configure()
    found, lines = results(), []
    measured = {name: found.get(("gpu", name, "native", SAMPLES["gpu"], "float64")) for name in ROBOTS}
    for name, rates in measured.items():
        if rates is None:
            continue
        rate = 1e6 * rates["rollouts"]["rate"]
        operations, memory = work(name)
        shares = f"{rate * operations / OPERATIONS:.0%}", f"{rate * memory / BANDWIDTH:.0%}"
        lines.append([f"`{name}`", number(rate / 1e6), f"{operations:,.0f}", f"{memory / 1e3:,.0f}", *shares])
    header = ["robot", "million steps/s", "operations per step", "kB per step", "of the operations", "of the bandwidth"]
    write_tables(DOCS / "robots.md", {"work": markdown_table(lines, header)})


if __name__ == "__main__":
    main()
