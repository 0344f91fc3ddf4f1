"""Traces that outlive the process: found again to the bit, and never where anything that they are made of differs."""

import dataclasses
import importlib
import re
import sys
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import Primitive
from jax.interpreters import mlir

import estimators
from estimators import user_inputs
from mjx_study import compiled, identity
from mjx_study.compiled import Builds, Compiled
from mjx_study.execution.run import run_study
from mjx_study.experiment import gradient_numbers
from mjx_study.graph import build
from mjx_study.graph.native import SWITCH, native_identity
from mjx_study.objective import Simulator, programs
from mjx_study.objective.batches import compiled_rollout
from mjx_study.options.configuration import StudyConfig
from mjx_study.tasks import Task, make_task

KEYS = jax.random.split(jax.random.key(0), 2)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(compiled, "traces_folder", lambda: tmp_path)
    return tmp_path


def pusher(**options: Any) -> Task:
    return make_task("pusher", horizon=3, **options)


def evaluated(task: Task) -> np.ndarray:
    return np.asarray(Simulator(task, chunk_size=2).objective(None).evaluate(task.theta, jax.random.clone(KEYS)).value)


def untraceable(*_: Any, **__: Any) -> Any:
    raise AssertionError("traced")


def test_a_trace_is_found_again_and_gives_the_same_bits(folder: Path, monkeypatch: pytest.MonkeyPatch):
    first = evaluated(pusher())
    (path,) = folder.glob("*.trace")
    assert path.stat().st_size < 100_000
    with monkeypatch.context() as patch:
        patch.setattr(programs, "rollout_cost", untraceable)
        np.testing.assert_array_equal(evaluated(pusher()), first)
    monkeypatch.setattr(compiled, "traces_folder", lambda: None)
    np.testing.assert_array_equal(evaluated(pusher()), first)


def test_what_lowering_waits_for_does_not_hold_up_the_next_trace(compilations: list[str]) -> None:
    built, waiting = Event(), Primitive("waiting")
    waiting.def_abstract_eval(lambda x: x)
    mlir.register_lowering(waiting, lambda _, x: [x] if built.wait(60) else [])
    program, builds = Compiled(lambda x: waiting.bind(x) + 1.0, "waiting"), Builds(threads=1)
    kind = jax.ShapeDtypeStruct((3,), float)
    builds.start(program, kind)
    assert program.outputs(kind).shape == (3,)
    built.set()
    builds.wait()
    np.testing.assert_array_equal(program(np.zeros(3)), np.ones(3))
    assert [name for name in compilations if "waiting" in name] == ["jit(waiting)"]


def test_a_rollout_alone_is_found_again_though_its_native_code_is_not_for_batches(folder: Path) -> None:
    given = pusher().theta, None, jax.random.key(0), 1.0
    first = cost_of_one_rollout(*given)
    (path,) = folder.glob("*.trace")
    written = path.stat().st_mtime_ns
    np.testing.assert_array_equal(cost_of_one_rollout(*given), first)
    assert [path.stat().st_mtime_ns] == [each.stat().st_mtime_ns for each in folder.glob("*.trace")] == [written]


def cost_of_one_rollout(*given: Any) -> np.ndarray:
    return np.asarray(compiled_rollout(pusher())(*given)[2])


def test_a_damaged_file_is_made_again(folder: Path):
    first = evaluated(pusher())
    (path,) = folder.glob("*.trace")
    whole = path.read_bytes()
    for damaged in (b"", b"nonsense", whole[: len(whole) // 2]):
        path.write_bytes(damaged)
        np.testing.assert_array_equal(evaluated(pusher()), first)
        assert len(path.read_bytes()) == len(whole)


def heavier(by: float) -> Task:
    task = pusher()
    host = task.scene.host
    host.body_mass[1] *= by
    return task.replace(scene=dataclasses.replace(task.scene, host=host))


def on_device(task: Task) -> Task:
    scene = task.scene
    changed = scene.model.replace(dof_damping=scene.model.dof_damping + 1e-17 + np.spacing(scene.model.dof_damping))
    return task.replace(scene=dataclasses.replace(scene, model=changed))


OTHERS: dict[str, Callable[[], Task]] = {
    "horizon": lambda: make_task("pusher", horizon=4),
    "timestep": lambda: pusher(timestep=0.005 * (1 + 2**-52)),
    "sigma": lambda: pusher().replace(sigma=np.nextafter(pusher().sigma, 1)),
    "derivatives": lambda: pusher(adjoint="tape"),
    "onset term": lambda: pusher().replace(onset="linear"),
    "mass in the engine's model": lambda: heavier(1 + 2**-52),
    "damping in MJX's model": lambda: on_device(pusher()),
    "noise": lambda: pusher().replace(noise="laplace"),
}


@pytest.mark.parametrize("other", OTHERS)
def test_what_differs_in_a_bit_has_a_trace_of_its_own(other: str):
    same, different = (Compiled(jnp.sin, "rollout", task)._path("form") for task in (pusher(), OTHERS[other]()))
    assert same is not None and different is not None and same != different
    assert same == Compiled(jnp.cos, "rollout", pusher())._path("form")


def test_code_versions_settings_and_the_form_of_arguments_count(monkeypatch: pytest.MonkeyPatch):
    def path(form: str = "form") -> Path | None:
        program = Compiled(jnp.sin, "rollout", pusher())
        return program._path(program._key(form))

    ours = path()
    assert ours == path() != path("another")
    with monkeypatch.context() as patch:
        patch.setattr(identity, "computing_code", lambda: "other")
        assert path() != ours
    version = identity.version_of
    with monkeypatch.context() as patch:
        patch.setattr(identity, "version_of", lambda name: "9" if name == "jaxlib" else version(name))
        assert path() != ours
    with jax.numpy_dtype_promotion("strict"):
        assert path() != ours
    assert path() == ours


OWN = """
import os
from pathlib import Path
from tests.carts import cart

def scale():
    return {scale}

def mine():
    task = cart(running_cost=lambda state, control: 0.0 * state.qpos[0])
    return task.replace(final_cost=lambda state: scale() * state.qpos[0])
"""
SCALES = {
    "its own source": ("2.0", "3.0", lambda monkeypatch: None),
    "a file": ('float(Path("by.txt").read_text())', None, lambda monkeypatch: Path("by.txt").write_text("3.0")),
    "a variable": ('float(os.environ["CART_BY"])', None, lambda monkeypatch: monkeypatch.setenv("CART_BY", "3.0")),
    "an import by name": (
        '__import__("la" + "zy").BY', None, lambda monkeypatch: Path("lazy.py").write_text("BY = 3.0  # changed\n"),
    ),
}  # fmt: skip


def own_value(monkeypatch: pytest.MonkeyPatch, scale: str) -> np.ndarray:
    """Evaluate a task of the user's module `mine`, as a new process does."""
    Path("mine.py").write_text(OWN.format(scale=scale))
    for name in ("mine", "lazy"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    importlib.invalidate_caches()
    return evaluated(make_task("mine:mine"))


@pytest.fixture
def in_a_folder(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path_factory.mktemp("own"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(user_inputs, "_RECORDED", defaultdict(dict))
    monkeypatch.setenv("CART_BY", "2.0")
    Path("by.txt").write_text("2.0")
    Path("lazy.py").write_text("BY = 2.0\n")


@pytest.mark.usefixtures("in_a_folder")
@pytest.mark.parametrize("read", SCALES)
def test_a_trace_of_own_code_is_found_again_until_anything_that_it_reads_differs(
    read: str, folder: Path, monkeypatch: pytest.MonkeyPatch
):
    scale, other, change = SCALES[read]
    first = own_value(monkeypatch, scale)
    assert len(list(folder.glob("*.trace"))) == 1
    with monkeypatch.context() as patch:
        patch.setattr(programs, "rollout_cost", untraceable)
        np.testing.assert_array_equal(own_value(monkeypatch, scale), first)
    change(monkeypatch)
    np.testing.assert_allclose(own_value(monkeypatch, other or scale), first * 1.5)


@pytest.mark.usefixtures("in_a_folder")
def test_code_that_holds_what_cannot_be_digested_is_traced_in_every_process(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    compiled._say_untraceable.cache_clear()
    own_value(monkeypatch, "next(NUMBERS)\n\nNUMBERS = iter(lambda: 2.0, None)\nSAME = (each for each in (1, 2))")
    assert list(folder.glob("*.trace"))  # an iterator's state is data
    (path,) = folder.glob("*.trace")
    path.unlink()
    own_value(monkeypatch, "next(NUMBERS)\n\nNUMBERS = (each for each in 9 * [2.0])")
    assert not list(folder.glob("*.trace"))
    said = capsys.readouterr().err
    assert said.count("builtins.generator holds data that cannot be digested") == 1 and said.count("\n") == 1


def test_statistics_of_seeds_and_structures_come_back(folder: Path):
    chosen = (estimators.make_estimator("aobg"), estimators.make_estimator("fobg"))
    task = pusher()
    simulated = Simulator(task, chunk_size=2).objective(None)
    keys = jax.random.clone(KEYS)
    drawn = {
        "evaluation": simulated.evaluate(task.theta, keys),
        "differentiation": simulated.differentiate(task.theta, keys),
    }
    reference = chosen[1](drawn)
    batches, samples = jax.tree.map(lambda leaf: leaf[None], drawn), np.asarray(len(keys))
    others = samples, reference, jax.random.split(jax.random.key(1), 1)
    with jax.debug_key_reuse(False):
        first = gradient_numbers.seed_numbers(chosen, 0.9)(batches, *others)
        gradient_numbers.seed_numbers.cache_clear()
        again = gradient_numbers.seed_numbers(chosen, 0.9)(batches, *others)
        assert len(list(folder.glob("*.trace"))) == 3
        padded = jax.tree.map(lambda leaf: gradient_numbers.padded(leaf, 2 * len(keys)), batches)
        filled = gradient_numbers.seed_numbers(chosen, 0.9)(padded, *others)
    assert first[0]["alpha"] is not None and first[1]["alpha"] is None
    jax.tree.map(np.testing.assert_array_equal, again, first)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-12), filled, first)  # padding is not counted


@pytest.mark.parametrize("names", [("zobg", "aobg"), ("zobg", "fobg_onset")])
def test_statistics_are_compiled_for_the_batches_that_come(
    folder: Path, monkeypatch: pytest.MonkeyPatch, names: tuple[str, ...]
):
    """Beside the programs of rollouts, from their forms alone: with another form there would be another trace."""
    gradient_numbers.seed_numbers.cache_clear()
    needs = {oracle for name in names for oracle in estimators.find_estimator(name).needs}
    chosen = {"contact": ("penalty",), "stiffness": (100.0,), "horizon": 2, "seeds": 3}
    for samples in (6, 6, 5):  # the second time they are compiled; other sizes are padded to the same
        run_study(StudyConfig(tasks=("pusher",), estimators=names, samples=(samples,), **chosen))
    assert len(list(folder.glob("*.trace"))) == len(needs | {"differentiation"}) + 1


def test_outputs_of_a_class_that_cannot_be_pickled_are_traced_anew(folder: Path):
    class Own(NamedTuple):
        value: Any

    assert Compiled(lambda x: Own(2 * x), "own")(1.0).value == 2.0 and not list(folder.glob("*.trace"))
    for _ in range(2):
        assert Compiled(lambda x: {"a": (2 * x, [None, x])}, "ours")(1.0) == {"a": (2.0, [None, 1.0])}
    assert len(list(folder.glob("*.trace"))) == 1


def test_functions_that_call_back_are_traced_anew(folder: Path, capfd: pytest.CaptureFixture[str]):
    """JAX cannot serialise them."""

    def printing(x: Any) -> Any:
        jax.debug.print("called with {}", x)
        return 2 * x

    assert Compiled(printing, "own")(1.0) == 2.0 and not list(folder.glob("*.trace"))
    jax.effects_barrier()
    assert capfd.readouterr().out == "called with 1.0\n"


def test_names_say_which_settings_do_not_count():
    left_out = [name for name in jax.config.values if compiled.UNTRACED.search(name)]
    assert not [
        name for name in left_out if re.search("x64|prng|precision|promotion|threefry|nan|linearize|jit|dtype", name)
    ], left_out


def test_programs_have_options_unless_xla_flags_say_otherwise(monkeypatch: pytest.MonkeyPatch):
    for backend, part in (("cpu", "MEMORY"), ("gpu", "WHILE")):
        monkeypatch.setattr(jax, "default_backend", lambda backend=backend: backend)
        options = compiled.compiler_options.__wrapped__()
        assert options is not None  # this XLA knows the names
        ((option, value),) = options.items()
        assert part in value
        with monkeypatch.context() as patch:
            patch.setenv("XLA_FLAGS", f"--{option}=")
            assert compiled.compiler_options.__wrapped__() is None
        monkeypatch.setitem(compiled.OPTIONS, backend, (option, "OF_ANOTHER_VERSION"))
        assert compiled.compiler_options.__wrapped__() is None
    monkeypatch.setattr(jax, "default_backend", lambda: "tpu")
    assert compiled.compiler_options.__wrapped__() is None


@pytest.mark.skipif(native_identity() is None, reason="there is no C compiler")
def test_a_trace_is_made_again_where_a_library_that_it_calls_is_missing(folder: Path, monkeypatch: pytest.MonkeyPatch):
    evaluated(pusher())
    (path,) = folder.glob("*.trace")
    assert build.libraries_in(path.read_bytes()) <= set(build.known_libraries())
    monkeypatch.setattr(build, "_BUILT", {})
    monkeypatch.setattr(build, "libraries_folder", lambda: folder / "empty")
    monkeypatch.setattr(programs, "rollout_cost", untraceable)
    with pytest.raises(AssertionError, match="traced"):
        evaluated(pusher())


@pytest.mark.skipif(native_identity() is None, reason="there is no C compiler")
def test_traces_with_and_without_native_code_are_apart(folder: Path, monkeypatch: pytest.MonkeyPatch):
    first = evaluated(pusher())
    jax.clear_caches()
    monkeypatch.setenv(SWITCH, "xla")
    np.testing.assert_allclose(evaluated(pusher()), first, rtol=1e-12)
    called = [build.libraries_in(path.read_bytes()) for path in folder.glob("*.trace")]
    assert sorted(map(bool, called)) == [False, True], called
