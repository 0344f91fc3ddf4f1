"""Inputs that once ended in a traceback, in no answer or in exit code 0: each is refused in one line that says why."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from estimators import AlphaOrder
from mjx_study import cli
from mjx_study.cli import options
from mjx_study.experiment.iteration import make_optimizer
from mjx_study.experiment.plan import plan_study
from mjx_study.limits import MOST_CELLS, MOST_MODELS, check_count
from mjx_study.options.configuration import StudyConfig
from mjx_study.options.files import digest_of_json, read_theta
from mjx_study.options.option import OPTIONS, Interval
from mjx_study.runtime import default_cache
from mjx_study.simulation.scene import SceneError, load_model
from mjx_study.storage.folder import open_store
from mjx_study.storage.manifest import read_document, sealed

BODY = "<worldbody><body><freejoint/><geom size='0.1'/></body></worldbody>"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ("compare pusher --seed 100000000000000000000000000", "--seed: must be at least 0 and at most 4294967295"),
        ("compare pusher --seed 1e26", "--seed: must be at least 0 and at most 4294967295"),
        ("compare pusher --samples inf", "--samples: must be a whole number, got 'inf'"),
        ("compare pusher --horizon 1000000", "GiB of memory, and the limit is 16 GiB"),
        ("compare pusher --horizon -1", "--horizon: must be at least 1 and at most 1000000, got -1"),
        ("compare pusher --samples=--", "--samples needs a value, got --"),
        ("compare pusher --theta=--", "--theta needs a value, got --"),
        ("compare pusher --devices 1000000", "--devices: must be at least 1 and at most 256, got 1000000"),
        ("compare pusher --stiffness 1:1e9:1000000000", "must be of at most 10000 values"),
        ("compare pusher --stiffness 1:1e9:10000", "30000 contact models are planned, and the limit is 5000"),
        ("compare sys:exit", "is neither a Task nor a function that returns one"),
        ("compare os:abort", "is neither a Task nor a function that returns one"),
        ("landscape pusher --points 1000000000000", "--points: must be at least 2 and at most 100000"),
        ("optimise pusher --seeds 100000", "GiB of memory, and the limit is 16 GiB"),
        ("optimise pusher --optimizer clip", "optax has no optimiser 'clip'"),
        ("optimise pusher --network 10000000000000000000000", "--network: must be at least 1 and at most 100000"),
        ("optimise pusher --network 100000,100000", "parameters of a network are planned, and the limit is 10000000"),
        ("sweep pusher --samples 1000000000000 --output x", "--samples: must be at least 3 and at most 10000000"),
        ("sweep pusher --sigma 1:10:3000 --output x", "54000 cells are planned, and the limit is 50000: give fewer"),
        ("sweep pusher --timestep 1e-9 --output x", "horizon must be at least 1 and at most 1000000"),
        ("sweep pusher --timestep 1e-3:1e-2:600 --output x", "600 programs are planned, and the limit is 500"),
        ("compare pusher --max-norm 3", "--max-norm has no effect on zobg, fobg, aobg: omit it, or name one that it "),
        ("optimise pusher --reference --window 3", "that it acts on: fobg_truncated"),
        (
            "landscape pusher --gamma 3",
            "--gamma has no effect on zobg, fobg: omit it, or name one that it acts on: aobg",
        ),
        ("compare pusher --estimators zobg --published", "--published has no effect on zobg: omit it"),
        ("compare pusher --estimators fobg --baseline none", "--baseline has no effect on fobg: omit it"),
        ("compare pusher --estimators zobg --onset linear", "--onset has no effect: it changes first-order gradients"),
        ("compare pusher --estimators fobg_onset --onset linear", "--onset has no effect: it changes first-order "),
        ("compare double_pendulum --onset jump", "--onset has no effect: it changes first-order gradients through sim"),
        ("compare pusher --contact reference --backward smooth_onset", "--backward has no effect: it changes first-"),
        ("compare pusher --backward mujoco_default --backward-stiffness 3", "--backward-stiffness has no effect: no "),
        (
            "compare pusher --contact reference --estimators fobg_onset",
            "fobg_onset corrects gradients through sim",
        ),
        ("compare pusher --contact reference --solver cg", "--solver has no effect: nothing is simulated"),
        ("compare pusher --contact reference --cone pyramidal", "--cone has no effect: nothing that is simulated has"),
        (
            "compare pusher --contact reference --damping 3",
            "takes no damping; omit --damping, or add a family",
        ),
        (
            "compare double_pendulum --stiffness 3",
            "--stiffness has no effect: double_pendulum names no contact",
        ),
        (
            "optimise double_pendulum --reference --stiffness 3",
            "--stiffness has no effect: double_pendulum names no contact",
        ),
        ("landscape pusher --contact reference --no-reference", "--no-reference omits --contact reference: omit one"),
        ("landscape ball_wall --direction 3", "--direction must be random or a parameter's index, 0 to 0; got 3"),
        ("landscape ball_wall --theta 0.3 --span 0,1", "--theta has one entry, and the line is its range: give --span"),
        ("sweep pusher --iterations 3 --confidence 0.9 --output x", "--confidence is for gradients: omit it"),
        ("gradcheck pusher --mean --states 3", "--states is for derivatives of steps: omit it, or --mean"),
        ("gradcheck pusher --mean --max-norm 3", "--max-norm has no effect on zobg, fobg: omit it, or name one that "),
        ("gradcheck pusher --mean --estimators zobg --onset linear", "--onset has no effect on these estimators"),
        ("gradcheck pusher --mean --direction means --span 1,2", "--span is for one path, and --direction means choo"),
        ("gradcheck pusher --contact mujoco_default --stiffness 3", "contact mujoco_default takes no stiffness; omit"),
        ("rollout pusher --contact mjcf --stiffness 3", "contact mjcf takes no stiffness; omit --stiffness, or add a "),
        ("rollout pusher --seed 3", "--seed has an effect only with --noisy, as the initial state is fixed"),
        ("diagnose pusher --contact mujoco_default --damping 3", "contact mujoco_default takes no damping; omit --dam"),
        ("compare pusher --accept-versions", "--accept-versions needs a folder for the study: give --output"),
        ("compare pusher --theta=1e400", "--theta: must be at most 1.8e+308 in size, got '1e400'"),
        ("rollout pusher --theta 0,-1e999", "--theta: must be at most 1.8e+308 in size, got '-1e999'"),
        ("compare pusher --theta=inf", "theta must be finite, got inf"),
        ("compare pusher --stiffness 1,1e400", "--stiffness: must be at most 1.8e+308 in size, got '1e400'"),
        ("compare pusher --samples 1e400", "--samples: must be at most 1.8e+308 in size, got '1e400'"),
        ("claims --accept-versions", "--accept-versions needs the folder to resume: give --output"),
    ],
)
def test_one_line(
    arguments: str, says: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(options, "configure", lambda **_: None)
    assert cli.main(arguments.split()) == 2
    printed = capsys.readouterr()
    assert says in printed.err and printed.err.count("\n") == 1 and printed.out == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "chosen",
    [
        {"tasks": ("pusher", "double_pendulum"), "stiffness": (3.0,), "damping": 1.0},
        {"tasks": ("double_pendulum", "pusher"), "onset": "linear"},
        {"contact": ("reference", "penalty"), "backward": ("none", "mujoco"), "backward_stiffness": 3.0},
        {"contact": ("reference", "penalty"), "estimators": ("fobg_onset",), "damping": 1.0},
        {"estimators": ("zobg",), "points": 3, "onset": "linear"},  # landscapes have the mean of FoBG all the same
        {"estimators": (AlphaOrder(gamma=3.0), "ivw"), "weights": "cross_fitted"},
    ],
)
def test_an_option_that_some_cells_read(chosen: dict[str, Any]) -> None:
    assert plan_study(StudyConfig(**{"tasks": ("pusher",), "horizon": 3} | chosen)).cells


def test_a_misspelt_option_of_a_configuration() -> None:
    with pytest.raises(TypeError, match="^StudyConfig has no option 'estimator'; did you mean estimators?"):
        StudyConfig(tasks=("pusher",), estimator=("zobg",))  # type: ignore[call-arg]


def test_estimators_that_are_objects_have_options_of_their_own() -> None:
    with pytest.raises(ValueError, match="`gamma` has no effect on aobg: omit it, or name one that it acts on: aobg, "):
        plan_study(StudyConfig(tasks=("pusher",), horizon=3, estimators=(AlphaOrder(gamma=3.0),), gamma=2.0))


def test_the_command_line_names_options_as_flags() -> None:
    others = "'max_norm', out/max_norm.npy, my_window and max_norm: of a file"
    with pytest.raises(options.UsageError) as told, options.usage_errors():
        raise ValueError(f"omit `gamma` or max_norm; not gamma, `other`, {others}")
    assert str(told.value) == f"omit --gamma or --max-norm; not gamma, `other`, {others}"


def test_intervals_in_words() -> None:
    said = {
        text: str(Interval(text)) for text in ("(0, inf)", "(0, inf]", "[0, 1)", "[1, 1e6]", "(-inf, inf)", "(2, 3)")
    }
    assert list(said.values()) == [
        "positive and finite", "positive", "at least 0 and less than 1", "at least 1 and at most 1000000", "finite",
        "greater than 2 and less than 3",
    ]  # fmt: skip
    assert float("inf") in Interval("(0, inf]") and float("inf") not in Interval("(0, inf)")
    assert not any(float("nan") in Interval(text) for text in said)


def test_every_option_of_a_sweep_is_described() -> None:
    """Of all that a configuration has but names of tasks, and switches."""
    assert set(vars(StudyConfig(tasks=("pusher",)))) - set(OPTIONS) == {"tasks"}


@pytest.mark.parametrize(
    ("given", "own"),
    [
        ({}, {"kind": "gradients", "reference_samples": 600}),
        ({"reference_samples": 50}, {"kind": "gradients", "reference_samples": 50}),
        ({"iterations": 3}, {"kind": "descents", "optimizer": "sgd", "evaluation_samples": 200}),
        ({"points": 5}, {"kind": "landscapes"}),
    ],
)
def test_a_configuration_holds_what_was_given(given: dict[str, Any], own: dict[str, Any]) -> None:
    """A study is identified by its defaults as well, those of its kind."""
    config = StudyConfig(tasks=("pusher",), **given)
    fields = {name: value for name, value in vars(config).items() if name in ("kind", *(given | own))}
    assert fields == dict.fromkeys(own) | given
    assert config.resolved() == vars(config) | given | own
    assert all(getattr(config.settings, name) == value for name, value in own.items())


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


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ('{"task": "pusher", "theta": {"a": 1}}', "theta: Input should be a valid array"),
        ('{"task": "pusher", "theta": [1, "2"]}', "theta.1: Input should be a valid number"),
        ('{"task": 3, "theta": [1]}', "task: Input should be a valid string"),
        ('{"task": "pusher", "theta": [1], "horizon": "x"}', "horizon: Input should be a valid integer"),
        ('{"task": "pusher", "theta": [1], "network": [0]}', "network: must be at least 1"),
        ("[" * 100_000, "Invalid JSON: recursion limit exceeded"),
    ],
)
def test_a_policy_that_is_none(content: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "policy.json"
    path.write_text(content)
    with pytest.raises(ValueError, match=says) as error:
        read_theta(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_a_policy_is_as_it_was_written_or_has_no_digest(tmp_path: Path) -> None:
    path, policy = tmp_path / "policy.json", {"task": "pusher", "theta": [1.0, 2.0]}
    for digest in ({}, {"digest": digest_of_json(policy)}):
        path.write_text(json.dumps(policy | digest))
        assert read_theta(path)[0] == (1.0, 2.0)
    path.write_text(path.read_text().replace("2.0", "3.0"))
    with pytest.raises(ValueError, match="policy.json is damaged .its digest does not match.; if you changed"):
        read_theta(path)


@pytest.mark.parametrize("content", ["[0.0, false]", '["0.0", 1]', "[1e400]", "[NaN]", "[null]", "{}", "1"])
def test_a_list_of_what_are_no_numbers(content: str, tmp_path: Path) -> None:
    path = tmp_path / "theta.json"
    path.write_text(content)
    with pytest.raises(ValueError, match="theta.json: .*Input should be|theta.json: .*Field required"):
        read_theta(path)


def test_a_long_double_may_be_too_large(tmp_path: Path) -> None:
    np.save(tmp_path / "theta.npy", np.array([np.finfo(np.longdouble).max]))
    with pytest.raises(ValueError, match="theta.npy is not a .npy array of finite numbers"):
        read_theta(tmp_path / "theta.npy")


@pytest.mark.parametrize("shape", ["(1000000000000, 1000000)", "(-1,)", "(" * 90, "None"])
def test_an_array_of_an_impossible_shape(shape: str, tmp_path: Path) -> None:
    path = tmp_path / "theta.npy"
    np.save(path, np.zeros(3))
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    path.write_bytes(path.read_bytes()[:8] + len(header).to_bytes(2, "little") + header.encode() + bytes(24))
    with pytest.raises(ValueError, match="theta.npy is not a .npy array of finite numbers"):
        read_theta(path)


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
def test_a_study_that_is_none(place: tuple[str, ...], value: Any, says: str, tmp_path: Path) -> None:
    plan = plan_study(StudyConfig(tasks=("pusher",), horizon=4, stiffness=(10.0, 100.0), contact=("penalty",)))
    document = json.loads(json.dumps(open_store(plan, tmp_path).document))
    assert read_document(sealed(document)) == document
    part = document
    for key in place[:-1]:
        part = part[key]
    part[place[-1]] = value
    with pytest.raises(ValueError, match=says):
        read_document(sealed(document))


def test_limits_are_named() -> None:
    with pytest.raises(ValueError, match="50001 cells are planned, and the limit is 50000: give fewer"):
        check_count(MOST_CELLS + 1, "cells", MOST_CELLS, "give fewer")
    check_count(MOST_MODELS, "contact models", MOST_MODELS, "")


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
