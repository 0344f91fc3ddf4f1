"""What a user's code depends on, beyond its own file: a study goes on only where all of it is as it was.

Each case is a module that a task comes from, and a change outside its file, or in its file where the function that
counts is hidden behind something. The numbers of the cells are made up.
"""

import importlib
import json
import os
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from estimators import user_inputs
from mjx_study.execution.run import run_study
from mjx_study.experiment.plan import plan_study
from mjx_study.experiment.study import StudyCell, StudyError, StudyPlan
from mjx_study.options.configuration import StudyConfig
from mjx_study.options.files import read_theta
from mjx_study.sources import Sources
from mjx_study.storage.folder import Store
from tests.documents import planned_arrays, stub_cells
from tests.processes import run_script

TASK = """
import data, importlib, os
from functools import lru_cache, partial, wraps
from pathlib import Path
import jax, jax.numpy as jnp, numpy as np
from mjx_study.tasks.pusher import pusher

{text}

def hop(horizon=2, **options):
    return pusher(horizon=horizon, **options).replace(final_cost={cost})
"""
PLAIN = "lambda state: {} * state.qpos[0]"
HELD = """
def cost_with(held):
    def cost(state): return state.qpos[0] * jnp.arange(9.0)[held].sum()
    return cost
"""
TABLE, IN_TABLE, IN_TASK = "TABLE = [data.SCALE]\n", "global TABLE of", "task hopping:hop differs"
HEIR = "\nclass Heir(It): pass"


def in_class(text: str) -> str:
    """A class with one method, which reads the table."""
    return f"{TABLE}class It:\n    {text}"


CASES: dict[str, tuple[str, str, str]] = {
    "a global dict": ('TABLE = {"a": data.SCALE}', PLAIN.format('TABLE["a"]'), IN_TABLE),
    "__call__": (in_class("def __call__(self, state): return TABLE[0] * state.qpos[0]"), "It()", IN_TABLE),
    "a method": (in_class("def cost(self, state): return TABLE[0] * state.qpos[0]"), "It().cost", IN_TABLE),
    "an attribute of a class": (
        "class It:\n    by = data.SCALE\n    def cost(self, state): return self.by * state.qpos[0]", "It().cost",
        IN_TASK,
    ),
    "a static method": (in_class("@staticmethod\n    def by(): return TABLE[0]"), PLAIN.format("It.by()"), IN_TABLE),
    "a class method": (in_class("@classmethod\n    def by(cls): return TABLE[0]"), PLAIN.format("It.by()"), IN_TABLE),
    "a base class": (in_class("def by(self): return TABLE[0]") + HEIR, PLAIN.format("Heir().by()"), IN_TABLE),
    "a property": (in_class("@property\n    def by(self): return TABLE[0]"), PLAIN.format("It().by"), IN_TABLE),
    "under jit": (TABLE + "help = jax.jit(lambda x: TABLE[0] * x)", "lambda state: help(state.qpos[0])", IN_TABLE),
    "a helper under vmap": (
        "help = jax.vmap(lambda x, y: x + y[0], in_axes=(0, data.AXIS))",
        "lambda state: help(state.qpos, jnp.eye(2))[0] * 1.0", IN_TASK,
    ),
    "a rule of a custom derivative": (
        TABLE + "help = jax.custom_jvp(lambda x: x)\n"
        "@help.defjvp\ndef _(primals, tangents): return primals[0], TABLE[0] * tangents[0]",
        "lambda state: help(state.qpos[0])", IN_TABLE,
    ),
    "a cached helper": (TABLE + "@lru_cache\ndef help(): return TABLE[0]", PLAIN.format("help()"), IN_TABLE),
    "a partial": (
        "class It: pass\nit = It()\nit.by = data.SCALE\ndef cost(it, state): return it.by * state.qpos[0]",
        "partial(cost, it)", IN_TASK,
    ),
    "a slice in a closure": (HELD, "cost_with(slice(0, data.COUNT))", IN_TASK),
    "an attribute of a module": ("", PLAIN.format("data.SCALE"), "global SCALE of data"),
    "an attribute of a function": (
        "def cost(state): return cost.by * state.qpos[0]\ncost.by = data.SCALE", "cost", IN_TASK,
    ),
    "a default argument": ("def cost(state, by=[data.SCALE]): return by[0] * state.qpos[0]", "cost", IN_TASK),
    "a function made at run time": (
        "exec(f'def cost(state): return {data.SCALE} * state.qpos[0]')", "cost", "task hopping:hop",
    ),
    "which of two lambdas": (
        "COSTS = [lambda state: state.qpos[0], lambda state: state.qpos[1]]", "COSTS[int(data.SCALE) - 1]", IN_TASK,
    ),
    "which of two functions of one name": (
        "if data.SCALE > 1:\n    def cost(state): return state.qpos[0]\n"
        "else:\n    def cost(state): return state.qpos[1]", "cost", IN_TASK,
    ),
    "which of two classes of one name": (
        "if data.SCALE > 1:\n    class It:\n        def __call__(self, state): return state.qpos[0]\n"
        "else:\n    class It:\n        def __call__(self, state): return state.qpos[1]", "It()", IN_TASK,
    ),
    "which of two wrappers": (
        "def wrapped(cost):\n    @wraps(cost)\n    def near(state): return cost(state)\n"
        "    @wraps(cost)\n    def far(state): return 2 * cost(state)\n    return far if data.SCALE > 1 else near\n"
        "def cost(state): return state.qpos[0]", "wrapped(cost)", IN_TASK,
    ),
    "a lazy import": (
        "def cost(state):\n    import lazy\n    return lazy.BY * state.qpos[0]", "cost", "source of lazy.py",
    ),
    "an import of a lazy import": (
        "def cost(state):\n    import between\n    return between.help() * state.qpos[0]", "cost", "source of lazy.py",
    ),
    "an import by name": (
        "def cost(state): return importlib.import_module('la' + 'zy').BY * state.qpos[0]", "cost",
        "file lazy.py differs",
    ),
    "a variable": ("", PLAIN.format('float(os.environ["HOP_BY"])'), "variable HOP_BY differs"),
    "a variable by getenv": ("", PLAIN.format('float(os.getenv("HOP_BY", "1"))'), "variable HOP_BY differs"),
    "whether a variable is set": (
        "", PLAIN.format('(2.0 if "HOP_SET" in os.environ else 1.0)'), "variable HOP_SET differs",
    ),
    "a file": ("", PLAIN.format('float(Path("by.txt").read_text())'), "file by.txt differs"),
    "a file opened in C": ("", PLAIN.format('float(np.loadtxt("by.txt"))'), "file by.txt differs"),
    "a file below": ("", PLAIN.format('float(np.load("below/by.npy"))'), "file below/by.npy differs"),
}  # fmt: skip
"""By kind: text of the module, its cost, and what the refusal names."""


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Writes the files that the cases read, with other content each time; nothing is imported before."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(user_inputs, "_RECORDED", defaultdict(dict))
    (tmp_path / "below").mkdir()

    def write(scale: float) -> None:
        (tmp_path / "lazy.py").write_text(f"BY = {scale}\n")
        (tmp_path / "between.py").write_text("def help():\n    import lazy\n    return lazy.BY\n")
        (tmp_path / "by.txt").write_text(str(scale))
        np.save(tmp_path / "below" / "by.npy", scale)
        monkeypatch.setenv("HOP_BY", str(scale))
        monkeypatch.setenv("HOP_SET", "1") if scale > 1.5 else monkeypatch.delenv("HOP_SET", raising=False)
        for name in ("hopping", "data", "lazy", "between"):
            sys.modules.pop(name, None)
        data = type(sys)("data")  # numbers that come from no file, as from a database
        data.SCALE, data.COUNT, data.AXIS = scale, int(scale), int(scale) - 1
        data.__file__ = str(tmp_path / "data.py")
        sys.modules["data"] = data
        importlib.invalidate_caches()

    (tmp_path / "data.py").write_text("# what is here says nothing of the numbers\n")
    yield write
    for name in ("hopping", "data", "lazy", "between"):
        sys.modules.pop(name, None)


def swept(folder: Path, task: str = "hopping:hop") -> Any:
    config = StudyConfig(tasks=(task,), contact=("penalty",), stiffness=(10.0,), samples=(4,), seeds=1)
    return run_study(plan_study(config), folder)


@pytest.mark.usefixtures("stubbed")
@pytest.mark.parametrize("kind", CASES)
def test_a_change_is_refused_and_nothing_else(kind: str, tmp_path: Path, world: Callable[[float], None]) -> None:
    text, cost, named = CASES[kind]
    (tmp_path / "hopping.py").write_text(TASK.format(text=text, cost=cost))
    world(1.0)
    assert swept(tmp_path / "out").attrs["computed_cells"] == 1
    world(1.0)
    assert swept(tmp_path / "out").attrs["computed_cells"] == 0
    world(2.0)
    with pytest.raises(StudyError, match=f"holds another study .*{named}") as refused:
        swept(tmp_path / "out")
    assert "\n" not in str(refused.value)


LATE = """
def metrics(states): return {"by": float(Path("by.txt").read_text()) + states.qpos[0, 0]}

def late(**options): return hop(**options).replace(metrics=metrics)
"""


def test_inputs_read_while_computing_count(
    tmp_path: Path, world: Callable[[float], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Metrics are traced when the first cell is computed; until then nothing has been read."""
    (tmp_path / "hopping.py").write_text(TASK.format(text="", cost=PLAIN.format(1.0)) + LATE)

    def compute(plan: StudyPlan, cell: StudyCell) -> dict[str, np.ndarray]:
        assert plan.seen.keys() == {"file hopping.py"}
        plan.task_of(cell).metrics(SimpleNamespace(qpos=np.zeros((2, 1))))  # type: ignore[misc]
        return planned_arrays(plan, cell)

    stub_cells(monkeypatch, compute)
    world(1.0)
    swept(tmp_path / "out", "hopping:late")
    assert Store.open(tmp_path / "out").document["seen"].keys() == {"file by.txt", "file hopping.py"}
    world(2.0)
    with pytest.raises(StudyError, match="holds another study .file by.txt differs."):
        swept(tmp_path / "out", "hopping:late")
    (tmp_path / "by.txt").unlink()
    with pytest.raises(StudyError, match="holds another study .file by.txt differs."):
        swept(tmp_path / "out", "hopping:late")


OUTSIDE = """
import os
from pathlib import Path

def read():
    Path("mine.txt").read_text()
    Path("made.txt").write_text("made")
    Path("made.txt").read_text()
    Path("made.txt").unlink()
    open(os.devnull).close()
    return os.environ.get("MINE"), os.environ.get("PATH")
"""


def test_reads_of_users_count_and_no_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not those of this package and of libraries, nor of files that are made meanwhile, nor outside `observing`."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(user_inputs, "_RECORDED", defaultdict(dict))
    monkeypatch.delenv("MINE", raising=False)
    (tmp_path / "outside.py").write_text(OUTSIDE)
    (tmp_path / "mine.txt").write_text("mine")
    (tmp_path / "theta.json").write_text("[1.0]")
    outside = importlib.import_module("outside")
    outside.read()
    assert user_inputs.inputs_read(["outside"]) == {}
    with user_inputs.observing("outside"):
        outside.read()
        read_theta(tmp_path / "theta.json")
    found = user_inputs.inputs_read(["outside"])
    assert found.keys() == {"file mine.txt", "variable MINE", "variable PATH"} and found["variable MINE"] == "absent"
    assert user_inputs.inputs_now(found) == found and user_inputs.inputs_read(["another"]) == {}
    monkeypatch.setenv("MINE", "1")
    assert [name for name, digest in user_inputs.inputs_now(found).items() if digest != found[name]] == [
        "variable MINE"
    ]
    del sys.modules["outside"]


PRINTED = """
import json, sys
sys.path.insert(0, ".")
from mjx_study.identity import contents
from mjx_study.tasks import make_task
print(json.dumps(contents({name: [make_task(f"{name}:hop")] for name in sys.argv[1:]})))
"""
STATELESS = """
import logging, threading
from mjx_study.tasks.pusher import pusher

LOG, LOCK, NAMES = logging.getLogger(__name__), threading.Lock(), {"b", "a", "c"}

class Cost:
    def __init__(self): self.log, self.held = LOG, frozenset({"x", "y", "z"})

    def __call__(self, state):
        LOG.debug("%s %s", LOCK, "a" in {"a", "b", "c"})
        return state.qpos[0] + len(NAMES)

def hop(**options): return pusher(**options).replace(final_cost=Cost())
"""


def test_digests_are_the_same_in_every_process(tmp_path: Path, world: Callable[[float], None]) -> None:
    """Whatever the seed of Python's hashes, the addresses, and whether modules come from bytecode."""
    names = [f"part_{index}" for index in range(len(CASES))]
    for name, (text, cost, _) in zip(names, CASES.values(), strict=True):
        (tmp_path / f"{name}.py").write_text(TASK.format(text=text, cost=cost))
    (tmp_path / "stateless.py").write_text(STATELESS)
    world(1.0)
    (tmp_path / "data.py").write_text("SCALE, COUNT, AXIS = 1.0, 1, 0\n")
    found = []
    for seed in ("0", "1"):
        env = os.environ | {"PYTHONHASHSEED": seed, "PYTHONPATH": str(Path(__file__).parents[1])}
        found.append(json.loads(run_script(PRINTED, *names, "stateless", cwd=tmp_path, env=env).stdout))
    assert found[0] == found[1] and len(found[0]) > 3 * len(CASES)


def test_a_submodule_counts_where_it_is_imported_not_where_it_happens_to_be_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "pkg").mkdir()
    for name, text in {
        "__init__": "",
        "a": "from pkg.c import C\nfrom . import d\n",
        "b": "",
        "c": "C = 1",
        "d": "",
    }.items():
        (tmp_path / "pkg" / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    digests = []
    for name in ("pkg.a", "pkg.b"):
        importlib.import_module(name)
        sources = Sources()
        sources.add("pkg.a")
        digests.append(sources.digests)
    assert digests[0] == digests[1] and set(digests[0]) == {f"pkg/{name}.py" for name in ("__init__", "a", "c", "d")}
    for name in [each for each in sys.modules if each.partition(".")[0] == "pkg"]:
        del sys.modules[name]
