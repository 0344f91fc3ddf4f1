"""What commands on a task of one's own build, by JAX's own events: nothing twice, and nothing again later.

All commands run in one process, which drops JAX's caches in memory between them, as a new process would.
"""

import json
import os
from pathlib import Path
from typing import Any, Final

import pytest

from mjx_study.graph.native import computes_steps
from tests.processes import ROOT, run_script

SCRIPT = """
import contextlib, io, json, sys, threading
import jax
from mjx_study import cli
from mjx_study.experiment import gradient_numbers
from mjx_study.objective import programs

built, traced, hit = [], [], threading.local()
rollout_cost = programs.rollout_cost

def tracing(*arguments, **options):
    traced.append("rollout")
    return rollout_cost(*arguments, **options)

programs.rollout_cost = tracing

def compiled(event, seconds, *, fun_name="", **_):
    if event.endswith("backend_compile_duration"):
        if not getattr(hit, "it", False):
            built.append(fun_name.removeprefix("jit(").removesuffix(")"))
        hit.it = False

def read(event, **_):
    hit.it = hit.it if hasattr(hit, "it") and not event.endswith("cache_hits") else event.endswith("cache_hits")

jax.monitoring.register_event_duration_secs_listener(compiled)
jax.monitoring.register_event_listener(read)
for command in json.loads(sys.argv[1]):
    jax.clear_caches()
    gradient_numbers.seed_numbers.cache_clear()
    built.clear(), traced.clear()
    with contextlib.redirect_stdout(io.StringIO()):
        assert cli.main(command.split()) == 0, command
    print(json.dumps({"built": built, "traced": traced}), flush=True)
"""
LARGE: Final = {"value", "gradient", "numbers_of_seeds", "descent"}
"""Programs that take more than a moment."""


def builds_of(folder: Path, *commands: str) -> list[dict[str, list[str]]]:
    """Names of the programs that commands compile, and traces of rollouts, in the user's folder."""
    environment: dict[str, Any] = os.environ | {"XDG_CACHE_HOME": str(folder / "cache"), "PYTHONPATH": str(ROOT)}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    done = run_script(SCRIPT, json.dumps(commands), cwd=folder, env=environment, timeout=900)
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_studies_of_an_own_task_build_nothing_twice(tmp_path: Path) -> None:
    """The second command is another one, on the same task, with other samples and seeds.

    Through XLA and in NumPy, other numbers of samples are other chunks, which are other programs.
    """
    (tmp_path / "mine.py").write_text("from tests.carts import cart\n")
    compare = "compare mine:cart --contact mjcf --samples 20 --reference-samples 20"
    optimise = "optimise mine:cart --iterations 2 --samples 8 --learning-rate 0.1 --evaluation-samples 20 --seeds 2"
    other = f"{optimise} --samples 9 --learning-rate 0.2 --seeds 3 --seed 4"
    others = f"{compare} --samples 30 --seed 1 --chunk-size 60", "landscape mine:cart --samples 20 --points 3"
    first, again, others, line, descents, later, more = builds_of(
        tmp_path, compare, compare, *others, optimise, optimise, other
    )
    assert sorted(set(first["built"]) & LARGE) == ["gradient", "numbers_of_seeds", "value"]
    for found in (first, again, others, line, descents, later, more):
        large = [name for name in found["built"] if name in LARGE]
        descents_of_three_estimators = 2 * ("descent" in large)
        assert len(large) == len(set(large)) + descents_of_three_estimators, large
    native = computes_steps() == "native"
    assert again["built"] == later["built"] == [] and (not native or others["built"] == more["built"] == [])
    assert len(first["traced"]) == 2 and descents["traced"]
    for found in (again, later, *((others, line, more) if native else ())):
        assert not LARGE & {*found["built"]} and not found["traced"], found
    assert {name for name in descents["built"] if name in LARGE} == {"descent"}


@pytest.mark.slow
def test_a_diagnosis_of_an_own_task_builds_nothing_twice(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("from tests.carts import walled_cart\n")
    command = "diagnose mine:walled_cart --samples 30"
    first, again = builds_of(tmp_path, command, command)
    large = [
        name for name in first["built"] if name in {*LARGE, "corrected", "converged_steps", "derivatives_of_a_step"}
    ]
    assert len(large) == len(set(large)) and {"value", "gradient", "corrected", "derivatives_of_a_step"} <= set(large)
    assert again["built"] == []


@pytest.mark.slow
def test_no_command_on_an_own_task_builds_anything_again(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("from tests.carts import cart\n")
    commands = ["sweep mine:cart --contact mjcf --samples 20 --output", "rollout mine:cart --output"]
    twice = [f"{command} {name}{place}" for place, command in enumerate(commands) for name in "ab"]
    twice += [command for command in ("gradcheck mine:cart", "bench mine:cart --samples 50") for _ in range(2)]
    found = builds_of(tmp_path, *twice)
    assert all(first["built"] and not again["built"] for first, again in zip(found[::2], found[1::2], strict=True))
