"""Identity by content: what changes a number changes a digest, names and places do not; versions are told."""

import copy
import dataclasses
import json
import re
import subprocess
import sys
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

from mjx_study import identity
from mjx_study.digest import digest_of
from mjx_study.execution.run import run_study
from mjx_study.experiment.plan import plan_study
from mjx_study.experiment.study import StudyError
from mjx_study.identity import contents, differences, git_revision
from mjx_study.options.configuration import StudyConfig
from mjx_study.results.warnings import warnings_of
from mjx_study.simulation.scene import models_folder
from mjx_study.storage import folder
from mjx_study.storage.folder import Store, load_study
from mjx_study.tasks import make_task
from mjx_study.tasks.task import StudyDefaults, Task
from tests.documents import altered, content, study_document
from tests.faults import Killed, kill_after


def digest(task: Task) -> dict[str, str]:
    return contents({"it": [task]})


def changed(one: Task, other: Task) -> set[str]:
    first, second = digest(one), digest(other)
    return {name for name in first | second if first.get(name) != second.get(name)}


def test_a_model_counts_by_what_it_simulates(tmp_path: Path) -> None:
    text = (models_folder() / "pusher.xml").read_text()

    def pusher(name: str, content: str) -> Task:
        (tmp_path / name).write_text(content)
        return make_task("pusher", horizon=2, model=str(tmp_path / name))

    base = pusher("a.xml", text)
    assert changed(base, pusher("b.xml", text.replace("<mujoco", "<!-- a remark --><mujoco"))) == set()
    heavier = re.sub(r'timestep="[^"]*"', 'timestep="0.004"', text)
    assert heavier != text
    assert "model of it" in changed(base, pusher("a.xml", heavier))
    scene = base.scene
    model = scene.model.replace(body_mass=2 * scene.model.body_mass)
    moved = base.replace(scene=dataclasses.replace(scene, model=model))
    assert changed(base, moved) == {"model of it"}
    small = 1e-11 * model.body_inertia  # of a sphere of 2 mm, in kg m2
    host = copy.deepcopy(scene.host)
    host.body_inertia[:] = small
    tiny, doubled = (
        base.replace(scene=dataclasses.replace(scene, host=host, model=model.replace(body_inertia=each)))
        for each in (small, 2 * small)
    )
    assert changed(tiny, doubled) == {"model of it"}


def test_every_part_of_a_task_counts() -> None:
    """But for the words that describe it."""
    task = make_task("pusher", horizon=2)
    parts: dict[str, list[Any]] = {
        "theta": [jnp.full(2, 0.3)], "final_cost": [lambda state: state.qpos[0]], "sigma": [0.2],
        "defaults": [StudyDefaults(gamma=3.0), StudyDefaults(stiffnesses=(1.0, 2.0))],
    }  # fmt: skip
    for name, part in ((name, each) for name, several in parts.items() for each in several):
        assert "task it" in changed(task, task.replace(**{name: part})), name
    assert changed(task, task.replace(description="other words")) == set()


def test_arrays_count_by_value_to_twelve_digits() -> None:
    array = np.array([1.0, -0.3, 0.0, np.inf, np.nan])
    assert digest_of(array) == digest_of(array * (1 + 1e-15)) != digest_of(array * (1 + 1e-9))
    for power in (0.5, 1.0, -2.0):
        assert digest_of(np.nextafter(power, 0)) == digest_of(power) == digest_of(np.nextafter(power, 9 * power))
    others = (array, -array, array[:4], array.reshape(5, 1), [1.0, 2.0], (2.0, 1.0))
    assert len(set(map(digest_of, others))) == len(others)
    cycle: list[Any] = [1]
    cycle.append(cycle)
    assert digest_of(cycle) == digest_of(cycle)


def test_a_function_made_by_exec_counts_by_its_code() -> None:
    def made(text: str) -> Any:
        namespace: dict[str, Any] = {}
        exec(f"def cost(state): return {text}", namespace)
        return namespace["cost"]

    assert digest_of(made("state + 1")) == digest_of(made("state + 1")) != digest_of(made("state - 1"))


class Mapped(dict[str, float]):
    """A dict with an attribute."""

    def __init__(self, by: float):
        self.by = by


class Slotted:
    """Without a dict of attributes."""

    __slots__ = ("by",)

    def __init__(self, by: float):
        self.by = by


CONTAINERS: dict[str, Callable[[int], Any]] = {
    "dict": lambda by: {"a": {"b": [by]}},
    "list": lambda by: [1, by],
    "set": lambda by: {1, by},
    "deque": lambda by: deque([by]),
    "subclass of dict": Mapped,
    "slots": Slotted,
    "attributes": lambda by: SimpleNamespace(by=by),
    "range": range,
    "slice": slice,
    "array of objects": lambda by: np.array([{"a": by}], dtype=object),
    "random generator": np.random.default_rng,
    "partial": lambda by: partial(max, by),
}


@pytest.mark.parametrize("kind", CONTAINERS)
def test_data_count_by_what_they_hold(kind: str) -> None:
    make = CONTAINERS[kind]
    assert digest_of(make(2)) == digest_of(make(2)) != digest_of(make(3))


# Studies.

SMALL: dict[str, Any] = {
    "tasks": ("pusher",), "contact": ("penalty",), "stiffness": (10.0, 100.0), "samples": (4,), "seeds": 1,
    "horizon": 2,
}  # fmt: skip


def swept(folder: Path, **changes: Any):
    accept = {name: changes.pop(name) for name in list(changes) if name == "accept_versions"}
    return run_study(plan_study(StudyConfig(**(SMALL | changes))), folder, **accept)


@pytest.mark.usefixtures("stubbed")
def test_a_study_of_another_precision_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    swept(tmp_path / "out")
    monkeypatch.setattr(identity, "precision", lambda: "float32")
    with pytest.raises(StudyError, match="holds another study .precision float64 there and float32 here"):
        swept(tmp_path / "out")


def other_jax(monkeypatch: pytest.MonkeyPatch) -> None:
    version = identity.version_of
    monkeypatch.setattr(identity, "version_of", lambda name: "99.0" if name == "jax" else version(name))


@pytest.mark.usefixtures("stubbed")
def test_other_versions_need_a_flag_and_are_remembered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "out"
    assert swept(folder).attrs["mixed_versions"] == ""
    other_jax(monkeypatch)
    read = swept(folder)
    assert read.attrs["computed_cells"] == 0  # nothing is left to compute, so nothing is mixed
    assert any("these numbers were computed with other versions (jax " in text for text in warnings_of(read))
    (folder / "cells" / "00001.npz").unlink()
    with pytest.raises(StudyError, match="with other versions .jax .* there and 99.0 here.; .*--accept-versions"):
        swept(folder)
    result = swept(folder, accept_versions=True)
    assert result.attrs["computed_cells"] == 1
    assert any("different versions: jax" in text and "99.0" in text for text in warnings_of(result))
    assert any("different versions: jax" in text for text in warnings_of(load_study(folder)))


@pytest.mark.usefixtures("stubbed")
def test_a_cell_counts_in_its_place_alone(tmp_path: Path) -> None:
    swept(tmp_path)
    axes = json.loads((tmp_path / "study.json").read_text())["axes"]
    altered(tmp_path / "study.json", axes=axes | {"model": ["penalty 11", *axes["model"][1:]]})
    with pytest.raises(StudyError, match="is another cell"):
        load_study(tmp_path)


# Descents.


DESCENT: dict[str, Any] = {
    "kind": "descents", "contact": ("reference",), "stiffness": (1000.0,), "estimators": ("zobg", "fobg"), "seeds": 2,
    "samples": (5,), "evaluation_samples": 5, "optimizer": "adam", "learning_rate": 0.01,
}  # fmt: skip
"""By an optimiser that remembers the gradients before."""


def descended(folder: Path | None, iterations: int) -> xr.Dataset:
    return run_study(StudyConfig(tasks=("ball_wall",), **DESCENT, iterations=iterations), folder)


def test_a_longer_run_is_neither_cut_nor_lost(tmp_path: Path) -> None:
    whole = descended(tmp_path, 6)
    kept = content(tmp_path)
    with pytest.raises(StudyError, match="holds 6 iterations, and 4 are asked for: give --iterations 6 or more, or"):
        descended(tmp_path, 4)
    assert kept == content(tmp_path)
    longer, undisturbed = descended(tmp_path, 8), descended(None, 8)
    assert longer.drop_vars("seconds").equals(undisturbed.drop_vars("seconds")) and longer.sizes["iteration"] == 8
    assert np.any(whole["theta"].values != longer["theta"].values)
    assert load_study(tmp_path).equals(longer)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"state_0_0": np.zeros(3)}, "state_0_0 has shape .3,. and type float64"),
        ({"history_1_cost": np.zeros((1, 2))}, "history_1_cost has shape .1, 2. and type float64"),
        ({"seconds_0": np.zeros(9)}, "it has 9 iterations"),
        ({"history_0_cost": None}, "no 'history_0_cost'"),
    ],
)
def test_a_checkpoint_of_other_arrays_is_refused(tmp_path: Path, changes: dict[str, Any], says: str) -> None:
    descended(tmp_path, 2)
    store = Store.open(tmp_path)
    arrays, versions = store.read_with_versions(0)
    changed = {name: array for name, array in (arrays | changes).items() if array is not None}
    store.file(0, part=True).write(changed, versions)
    store.path(0).unlink()
    with pytest.raises(StudyError, match=f"00000.part.npz does not fit the study .{says}.; move it away to compute"):
        descended(tmp_path, 2)


@pytest.mark.parametrize("moment", range(1, 4))
def test_a_run_made_longer_survives_a_kill(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: int) -> None:
    """Killed at each write of the step from six iterations to eight, it is done again, to the same numbers."""
    descended(tmp_path, 6)
    with monkeypatch.context() as patch, pytest.raises(Killed):
        kill_after(patch, lambda path, count: count == moment, folder)
        descended(tmp_path, 8)
    assert descended(tmp_path, 8).drop_vars("seconds").equals(descended(None, 8).drop_vars("seconds"))


CLAIMING = """
import fcntl, sys
file = open(sys.argv[1], "r+")
fcntl.lockf(file, fcntl.LOCK_EX, 1, 1)
print(flush=True)
input()
"""


def test_a_run_that_another_process_computes_is_not_made_longer(tmp_path: Path) -> None:
    """Its second cell is claimed; what it finds would be of another study."""
    short, longer = (study_document(2, kind="descents", iterations=length) for length in (2, 4))
    (tmp_path / "study.lock").touch()
    Store.create(tmp_path, short)
    before = content(tmp_path)
    command = [sys.executable, "-c", CLAIMING, str(tmp_path / "study.lock")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None and other.stdout.readline()
        with pytest.raises(StudyError, match="another process computes descents in .*: make them longer once it has"):
            Store.create(tmp_path, longer)
        other.kill()
    assert content(tmp_path) == before
    assert Store.create(tmp_path, longer).document["config"]["iterations"] == 4


def test_what_differs_is_told() -> None:
    assert differences({"a": 1, "b": 2}, {"b": 3, "c": 4}) == (
        "a 1 there and none here, b 2 there and 3 here, c none there and 4 here"
    )
    assert differences({"model": "0123456789ab"}, {"model": "0123456789ac"}) == "model differs"
    assert differences({"a": [1]}, {"a": [1]}) is None


# Git.


def test_the_revision_is_that_of_git(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a checkout and in a worktree of it; not in a folder within one, nor before the first commit."""
    root, tree = tmp_path / "checkout", tmp_path / "tree"

    def git(*arguments: str) -> str:
        identity = ["-c", "user.name=me", "-c", "user.email=me@example.org", "-c", "commit.gpgsign=false"]
        return subprocess.run(
            ["git", "-C", root, *identity, *arguments], check=True, capture_output=True
        ).stdout.decode()

    (root / "package").mkdir(parents=True)
    git("init")
    assert git_revision(root) is None
    git("commit", "--allow-empty", "--message", "first")
    revision = git("rev-parse", "HEAD").strip()
    git("worktree", "add", str(tree))
    monkeypatch.setenv("GIT_DIR", str(tmp_path))  # as in a hook
    assert len(revision) == 40 and git_revision(root) == git_revision(tree) == revision
    assert git_revision(root / "package") is None
    monkeypatch.setenv("PATH", str(tmp_path))
    assert git_revision(root) is None
