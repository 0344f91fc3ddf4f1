"""Inputs that once ended in a traceback, in no answer or in exit code 0: each is refused in one line that says why."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjx_study.experiment.iteration import make_optimizer
from mjx_study.options.files import digest_of_json, read_theta
from mjx_study.runtime import default_cache
from mjx_study.simulation.scene import SceneError, load_model
from mjx_study.storage.manifest import read_document, sealed
from tests.documents import study_document
from tests.fuzz.forgeries import npy

LONG_DOUBLE = np.finfo(np.longdouble).max.tobytes()
BODY = "<worldbody><body><freejoint/><geom size='0.1'/></body></worldbody>"


@pytest.mark.parametrize("name", ["clip", "freeze", "lbfgs", "polyak_sgd", "chain", "zero_nans", "__name__", "no such"])
def test_no_optimiser(name: str) -> None:
    with pytest.raises(ValueError, match="optax has no optimiser"):
        make_optimizer(name, 0.1, 0.0)


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ("<asset><hfield name='h' nrow='1000000' ncol='1000000' size='1 1 1 1'/></asset>", "<hfield> with nrow x ncol"),
        ("<asset><texture name='t' builtin='flat' width='1000000' height='1000000'/></asset>", "<texture> with w"),
        ("<size memory='100T'/>", "<size> with memory of 1.1e+14"),
        ("<size nuserdata='1000000000'/>", "<size> with nuserdata of 1e+09"),
        ("<size nuser_body='1000000000'/>", "<size> with nuser_body of 1e+09"),
        ("<worldbody><replicate count='500'><replicate count='500'><site/></replicate></replicate></worldbody>",
         "mine.xml asks for 2.5e+05 elements, with those of <replicate>"),
        ("<include file='other.xml'/>", "other.xml asks for <size> with nkey of 1e+09; the limit is 10000"),
        ("<option timestep='0'/>", "the timestep must be positive and finite, got 0"),
        ("<option timestep='nan'/>", "timestep of <option> must be finite, got 'nan'"),
    ],
)  # fmt: skip
def test_sizes_of_an_mjcf(body: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "other.xml").write_text("<mujocoinclude><size nkey='1000000000'/></mujocoinclude>")
    path = tmp_path / "mine.xml"
    path.write_text(f"<mujoco>{body}{BODY}</mujoco>")
    with pytest.raises(SceneError, match=says.replace("+", r"\+")):
        load_model(path)
    path.write_text(f"<mujoco>{BODY}</mujoco>")
    assert load_model(path).nbody == 2


NO_ARRAY = "theta.npy is not a .npy array of finite numbers"


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ('{"task": "pusher", "theta": {"a": 1}}', "theta must be a list, got {'a': 1}"),
        ('{"task": "pusher", "theta": [1, "2"]}', "theta must be a number, got '2'"),
        ('{"task": "pusher", "theta": []}', "there are no parameters"),
        ('{"task": 3, "theta": [1]}', "task must be the name of a task, got 3"),
        ('{"task": "pusher", "theta": [1], "horizon": "x"}', "horizon must be a whole number, got 'x'"),
        ('{"task": "pusher", "theta": [1], "network": [0]}', "network must be at least 1"),
        ("[" * 100_000, "not JSON: maximum recursion depth exceeded"),
        *((text, "theta must be ") for text in ("[0.0, false]", '["0.0", 1]', "[1e400]", "[NaN]", "[null]", "1")),
        *((npy(shape), NO_ARRAY) for shape in ("(1000000000000, 1000000)", "(-1,)", "(" * 90, "None")),
        (npy((1,), "<g", LONG_DOUBLE), NO_ARRAY),
    ],
    ids=lambda text: str(text)[:40],
)
def test_parameters_or_a_policy_that_are_none(content: str | bytes, says: str, tmp_path: Path) -> None:
    path = tmp_path / ("theta.json" if isinstance(content, str) else "theta.npy")
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(ValueError, match=f"^{tmp_path}.*{says}") as error:
        read_theta(path)
    assert "\n" not in str(error.value)


def test_a_policy_is_as_it_was_written_or_has_no_digest(tmp_path: Path) -> None:
    path, policy = tmp_path / "policy.json", {"task": "pusher", "theta": [1.0, 2.0]}
    for digest in ({}, {"digest": digest_of_json(policy)}):
        path.write_text(json.dumps(policy | digest))
        assert read_theta(path)[0] == (1.0, 2.0)
    path.write_text(path.read_text().replace("2.0", "3.0"))
    with pytest.raises(ValueError, match="policy.json: the digest does not match, so the file is damaged; if you"):
        read_theta(path)


def test_parameters_come_in_json_and_as_arrays(tmp_path: Path) -> None:
    (tmp_path / "theta.json").write_text("[0.5, 2]")
    np.save(tmp_path / "theta.npy", np.array([[0.5], [2.0]]))
    assert read_theta(tmp_path / "theta.json")[0] == read_theta(tmp_path / "theta.npy")[0] == (0.5, 2.0)


@pytest.mark.parametrize(
    ("place", "value", "says"),
    [
        (("config", "estimators"), ["gobg"], "config.estimators has 'gobg', which is neither built in nor described"),
        (("config", "seeds"), "ten", "config.seeds: Input should be a valid integer"),
        (("config", "kind"), "poems", "config.kind: Input should be"),
        (("config", "iterations"), 10**7, "a variable would have more than 500000000 numbers"),
        (("axes", "sigma"), [], "axes.sigma: List should have at least 1 item"),
        (("axes", "samples"), [100, 100], "axes.samples has a value twice"),
        (("models",), [], "there are 0 models, and 2 values of axes.model"),
        (("cells",), [{"label": "a", "at": {"task": 7}}], "cells.0.at is no place on the axes"),
        (("environment",), None, "environment: Input should be"),
        (("warnings",), "none", "warnings: Input should be a valid array"),
    ],
)  # fmt: skip
def test_a_study_that_is_none(place: tuple[str, ...], value: Any, says: str) -> None:
    document = study_document(2, seeds=100)
    assert read_document(sealed(document)).items() >= document.items()
    part = document
    for key in place[:-1]:
        part = part[key]
    part[place[-1]] = value
    with pytest.raises(ValueError, match=says):
        read_document(sealed(document))


def test_no_home_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", homeless)
    assert default_cache() is None


@pytest.mark.parametrize(
    ("changes", "shell", "code", "says"),
    [
        ({}, "estimators > /dev/full", 1, "cannot write to standard output: No space left"),
        ({"MPLBACKEND": "nonsense"}, "plot nowhere", 2, "nowhere holds no study"),
        ({"JAX_PLATFORMS": "nonsense"}, "tasks --json", 2, "JAX has no device to compute on: Unable to"),
        ({"PYTHONIOENCODING": "ascii"}, "estimators >&-", 0, ""),
    ],
)  # fmt: skip
def test_the_surroundings(changes: dict[str, str], shell: str, code: int, says: str) -> None:
    """A backend of matplotlib that is none has no effect; what else is wrong gets one line."""
    command = f"{sys.executable} -m mjx_study {shell}"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, env=os.environ | changes, timeout=120)
    assert done.returncode == code and done.stderr.count("\n") == bool(says), done.stderr
    assert says in done.stderr
