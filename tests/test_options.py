"""Options: every refusal once, spelled as the user wrote the option; text, files and Python are read alike."""

import dataclasses
import functools
import json
import re
import shlex
import string
from pathlib import Path
from typing import Any

import pytest

from estimators import AlphaOrder
from mjx_study import cli, tasks
from mjx_study.cli.sweep import sweep_fields
from mjx_study.experiment.plan import plan_study
from mjx_study.options.configuration import OPTIONS, StudyConfig
from mjx_study.options.files import read_toml
from mjx_study.options.option import OptionError, flag_of
from mjx_study.tasks import TASKS

_built = functools.cache(tasks.make_task)


@pytest.fixture(autouse=True)
def configured(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """In an empty folder, with tasks built once."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tasks, "make_task", _built)


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The one line with which a command refuses its arguments, before it prints or writes anything."""
    before = set(Path().iterdir())
    capsys.readouterr()
    assert cli.main(arguments) == 2
    printed = capsys.readouterr()
    assert printed.err.count("\n") == 1 and printed.out == "" and set(Path().iterdir()) == before
    return printed.err.removeprefix("mjx-study: ").strip()


@pytest.mark.parametrize(
    ("name", "text", "value", "reason"),
    [
        ("samples", "-5", -5, "must be at least 3 and at most 10000000, got -5"),
        ("samples", "many", "many", "must be a whole number, got 'many'"),
        ("seed", "1e26", 10**26, "must be at least 0 and at most 4294967295, got "),
        ("horizon", "true", True, "must be a whole number, got "),
        ("sigma", "nan", None, "must be positive and finite, got nan"),
        ("stiffness", "10,-5", -5.0, "must be positive and finite, got -5"),
        ("stiffness", "1:1e9:1000000000", None, "takes at most 10000 values, got the range '1:1e9:1000000000'"),
        ("stiffness", "ten", "ten", "must be a number, got 'ten'"),
        *(
            ("stiffness", text, None, f"takes numbers and ranges FROM:TO:COUNT or FROM:TO:COUNT:log, COUNT at least 2; "
             f"got '{text}'")
            for text in ("10:1000", "1:10:1", "0:10:3:log", "1:2:3:lin", "1:nan:3", "1:inf:3:log", "-1:1:3:log",
                         "1e-300:1e300:3:log")
        ),
        ("gamma", "0", 0.0, "must be positive, got 0"),
        ("radius", "huge", "huge", "does not accept 'huge'; choose from max_deviation, or give a number"),
        ("cone", "square", "square", "does not accept 'square'; choose from pyramidal, elliptic"),
        ("estimators", "zobg,fobgg", "fobgg", "does not accept 'fobgg'; did you mean fobg?"),
        ("estimators", "hop", "hop", "does not accept 'hop'; choose from zobg, "),
        ("solref", "1;2;3", None, "must be two columns separated by ;, such as -1000,-10000;-5, got 3"),
        ("solref", "1:2:200;1:2:200", None, "takes at most 10000 contact models, got 40000"),
    ],
)  # fmt: skip
def test_a_value_is_refused_as_flag_key_and_argument(
    name: str, text: str, value: Any, reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """In text, and as a value of a file and of Python where these can hold it."""
    option = OPTIONS[name]
    command = "compare" if name == "theta" else "sweep"
    assert refused([command, "pusher", f"{option.flag}={text}"], capsys).startswith(f"{option.flag} {reason}")
    held = text if value is None else [value] if option.many else value
    Path("study.toml").write_text(f"{name} = {json.dumps(held)}")
    if value is not None or option.many:
        with pytest.raises(ValueError, match=f"^study.toml: {name} {re.escape(reason)}"):
            read_toml(Path("study.toml"))
    if value is not None:
        with pytest.raises(OptionError, match=f"^`{name}` {re.escape(reason)}"):
            option.check(held)


SETS: list[tuple[dict[str, Any], str]] = [
    ({"tasks": ()}, "{tasks} must have at least one value"),
    ({"tasks": ("pusher", "ball_wall"), "theta": (1.0,)}, "{theta} is for a single task"),
    ({"stiffness": ()}, "{stiffness} must have at least one value"),
    ({"contact": ()}, "{contact} needs at least one contact family, or {solref} or {solimp}"),
    ({"estimators": ("zobg", "zobg")}, "{estimators} has zobg twice"),
    ({"contact": ("mjcf",), "damping": 1.0}, "{damping} has no effect on contact mjcf: omit it"),
    ({"contact": ("mjcf",), "stiffness": (1.0,)}, "{stiffness} has no effect on contact mjcf: omit it"),
    ({"contact": (), "solref": ((-1.0, -5.0),), "stiffness": (1.0,)}, "{stiffness} has no effect on solref or solimp"),
    ({"solref": ((1.0,), (2.0,))}, "solref takes 2 numbers and solimp 5, got 1 and 5"),
    ({"backward_margin": 1.0}, "{backward_margin} needs a contact family in {backward}"),
    ({"backward": ("penalty",), "onset": "linear"}, "{onset} corrects exact derivatives: omit it or {backward}"),
    ({"backward": ("penalty",), "estimators": ("fobg_onset",)}, "{backward} replaces the derivatives that fobg_onset"),
    ({"backward": ("penalty",), "contact": ("mjcf",)}, "{backward} has no effect on contact mjcf: choose another"),
    ({"backward": ("mujoco_default",), "backward_stiffness": 3.0}, "{backward_stiffness} has no effect: no surrogate"),
    ({"contact": ("reference",), "backward": ("smooth_onset",)}, "{backward} has no effect: it changes first-order"),
    ({"iterations": 3, "points": 3}, "{iterations} is for descents and {points} for landscapes: omit one of them"),
    ({"kind": "landscapes"}, "{points} must be given for landscapes"),
    ({"kind": "gradients", "points": 3}, "{points} is for landscapes, and {kind} is gradients: omit one of them"),
    ({"span": (0.0, 1.0)}, "{span} is for landscapes: give {points} as well"),
    ({"decay": 1.0}, "{decay} is for descents: give {iterations} as well"),
    ({"iterations": 3, "confidence": 0.9}, "{confidence} is for gradients: omit it"),
    ({"points": 3, "span": (1.0, 0.0)}, "{span} must be two numbers, the lower one first; got 1.0, 0.0"),
    ({"points": 3, "direction": "200"}, "{direction} must be random or a parameter's index, 0 to 199; got 200"),
    ({"tasks": ("ball_wall",), "points": 3, "theta": (0.3,)}, "{theta} has one entry, and the line is its range"),
    ({"theta": (1.0, 2.0)}, "{theta} has 2 numbers; pusher needs 200, all of them finite"),
    ({"estimators": ("fobg_clipped",)}, "{max_norm} must be given: 'fobg_clipped' needs it"),
    ({"max_norm": 3.0}, "{max_norm} has no effect on zobg, fobg, aobg: omit it, or choose"),
    ({"estimators": ("zobg",), "published": True}, "{published} has no effect on zobg: omit it"),
    ({"estimators": ("zobg",), "onset": "linear"}, "{onset} has no effect: it changes first-order"),
    ({"estimators": ("fobg_onset",), "onset": "linear"}, "{onset} has no effect: it changes first-order"),
    ({"tasks": ("double_pendulum",), "onset": "shift"}, "{onset} has no effect: it changes first-order"),
    ({"tasks": ("double_pendulum",), "stiffness": (3.0,)}, "{stiffness} has no effect: double_pendulum names"),
    ({"contact": ("reference",), "onset": "linear"}, "{onset} has no counterpart in the analytic references: omit it"),
    ({"estimators": ("total_propagation",), "onset": "shift"}, "{onset} has no effect on the derivatives of single"),
    ({"contact": ("reference",), "estimators": ("fobg_onset",)}, "fobg_onset corrects gradients through contact"),
    ({"tasks": ("double_pendulum",), "estimators": ("fobg_onset",)}, "fobg_onset corrects gradients through contact"),
    ({"onset": "shift", "estimators": ("fobg", "fobg_onset")}, "{onset} makes fobg and fobg_onset the same"),
    ({"contact": ("reference",), "solver": "cg"}, "{solver} has no effect: nothing is simulated"),
    ({"contact": ("reference",), "cone": ("pyramidal",)}, "{cone} has no effect: nothing that is simulated"),
    ({"published": True, "gamma": 1.0, "radius": 2.0}, "{published} sets them as well: omit {gamma}, {radius}"),
    ({"tasks": ("double_pendulum",), "published": True}, "{published} has no effect on double_pendulum"),
    ({"estimators": ("ivw_h",), "block_size": 4}, "{block_size} splits batches, and ivw_h must have whole"),
    ({"iterations": 3, "network": (4,), "contact": ("reference",)}, "{network} needs MJX: the analytic"),
    ({"iterations": 3, "network": (2,), "horizon": 2, "theta": (1.0, 2.0)}, "{theta} has 2 numbers; pusher needs 13,"),
    ({"iterations": 3, "optimizer": "adm"}, "optax has no optimiser 'adm' that takes a learning rate"),
    ({"iterations": 3, "sigma_schedule": "print(1)"}, "'print(1)' cannot be read (optax has no schedule 'print')"),
    ({"iterations": 3, "sigma_schedule": "linear_schedule(1)"}, "'linear_schedule(1)' cannot be read "),
    ({"iterations": 3, "sigma_schedule": "linear_schedule(1, 0, 2)"}, "factors must be positive in all 3"),
    ({"iterations": 3, "sigma_schedule": "constant_schedule(1)", "estimators": ("delta",)}, "{sigma_schedule}"),
    ({"iterations": 3, "stiffness_schedule": "constant_schedule(1)", "contact": ("mjcf",)}, "{stiffness_schedule}"),
    ({"noise": "laplace", "estimators": ("delta",)}, "'delta' holds for Gaussian noise only"),
    ({"stiffness": "1:1e9:10000"}, "30000 contact models are planned, and the limit is 5000"),
    ({"sigma": "1:10:3000"}, "54000 cells are planned, and the limit is 50000: give fewer"),
    ({"timestep": "1e-3:1e-2:600"}, "600 programs are planned, and the limit is 500"),
    ({"timestep": (1e-9,)}, "{horizon} must be at least 1 and at most 1000000, got "),
    ({"horizon": 1_000_000, "samples": (1000,)}, "the batches of a cell would take about "),
]  # fmt: skip


@pytest.mark.parametrize(("fields", "message"), SETS, ids=str)
def test_options_that_do_not_go_together(fields: dict[str, Any], message: str) -> None:
    """With a spelling of every option that the message names, as arguments and as flags."""
    read = {name: OPTIONS[name].parse(value) if ":" in str(value) else value for name, value in fields.items()}
    with pytest.raises(ValueError) as error:
        plan_study(StudyConfig(**{"tasks": ("pusher",), **read}))
    named = [name for _, name, *_ in string.Formatter().parse(message) if name]
    assert str(error.value).startswith(message.format(**{name: f"`{name}`" for name in named}))
    if named:
        assert isinstance(error.value, OptionError)
        flags = {name: "TASK" if name == "tasks" else f"--{name.replace('_', '-')}" for name in named}
        assert error.value.spelled(flag_of).startswith(message.format(**flags))


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ("", "the following arguments are required: COMMAND. See mjx-study --help"),
        ("--versoin", "unknown option --versoin; did you mean --version? See mjx-study --help"),
        ("compre pusher", "unknown command 'compre'; did you mean compare? See mjx-study --help"),
        ("compare", "the following arguments are required: TASK|FILE.xml. See mjx-study compare --help"),
        ("compare pushr", "unknown task 'pushr'; did you mean pusher? See mjx-study compare --help"),
        ("compare sys:exit", "sys:exit is neither a Task nor a function that returns one"),
        ("compare pusher more", "unexpected argument more. See mjx-study compare --help"),
        ("compare pusher --stifness 10", "unknown option --stifness; did you mean --stiffness? See mjx-study compare"),
        ("compare pusher --backward-s=1", "unknown option --backward-s; did you mean --backward-stiffness?"),
        ("compare pusher --iterations 3", "unknown option --iterations; did you mean --solver-iterations?"),
        ("compare pusher --samples=--", "--samples needs a value, got --"),
        ("compare pusher --precision float16", "argument --precision: unknown precision 'float16'; did"),
        ("compare pusher --devices 1000000", "--devices must be at least 1 and at most 256, got 1000000"),
        ("compare pusher --model tennis_racket", "no model named 'tennis_racket'; did you mean tennis?"),
        ("compare pusher --accept-versions", "--accept-versions needs a folder for the study: give --output"),
        ("compare pusher --theta nowhere.npy", "cannot read nowhere.npy: No such file or directory"),
        ("sweep pusher", "no folder for the study: give --output, or --dry-run. See mjx-study sweep --help"),
        ("sweep --output out", "no task: name one, or give --config"),
        ("sweep pusher --config nowhere.toml --output out", "cannot read nowhere.toml: No such file or directory"),
        ("sweep pusher --cluster local:0 --output out", "argument --cluster: must be local:N, slurm:N or an address"),
        ("optimise pusher --reference --contact penalty", "--contact penalty is what --reference replaces: omit one"),
        ("optimise pusher --seeds 100000", "GiB of memory, and the limit is 16 GiB"),
        ("optimise pusher --network 100000,100000", "parameters of a network are planned, and the limit is 10000000"),
        ("landscape pusher --contact reference --no-reference", "--contact reference is what --no-reference omits"),
        ("gradcheck pusher --contact", "argument --contact: expected one argument"),
        ("gradcheck pusher --contact reference", "--contact does not accept 'reference'; choose from penalty"),
        ("gradcheck pusher --contact ,", "no contact model to check"),
        ("gradcheck pusher --stiffness ,", "no contact model to check"),
        ("gradcheck pusher --contact mujoco_default --stiffness 3", "--stiffness has no effect on contact mujoco_def"),
        ("gradcheck pusher --pair a,b", "--pair is for files: a task has a pair of geoms already"),
        ("gradcheck pusher --window 9", "--window is for --mean"),
        ("gradcheck pusher --mean --states 3", "--states is for derivatives of steps: omit it, or --mean"),
        ("gradcheck pusher --mean --max-norm 3", "--max-norm has no effect on zobg, fobg: omit it, or choose an esti"),
        ("gradcheck pusher --mean --estimators zobg --onset linear", "--onset has no effect on these estimators"),
        ("gradcheck pusher --mean --direction means --span 1,2", "--span is for one path, and --direction means choo"),
        ("gradcheck pusher --mean --span 1,0", "--span must be two numbers, the lower one first; got 1.0, 0.0"),
        ("gradcheck pusher --mean --direction 999", "--direction must be random or a parameter's index, 0 to 199; got"),
        ("gradcheck pusher --mean --samples 1", "--samples must be at least 2 and at most 10000000, got 1"),
        ("diagnose pusher --samples 1", "--samples must be at least 2 and at most 10000000, got 1"),
        ("gradcheck tennis --mean --estimators delta", "'delta' needs noise that is added to theta itself"),
        ("gradcheck tennis --mean --onset shift --estimators total_propagation", "--onset has no effect"),
        ("gradcheck model.xml --mean", "no MJCF file at model.xml"),
        ("rollout pusher --renderer povray", "unknown renderer 'povray'; choose from auto"),
        ("rollout pusher --format avi", "unknown format 'avi'; choose from gif, mp4"),
        ("rollout pusher --view zx", "argument --view: unknown view 'zx'; choose from auto, xz"),
        ("rollout pusher --theta 1,2", "--theta has 2 numbers; pusher needs 200, all of them finite"),
        ("rollout pusher --seed 3", "--seed has an effect only with --noisy, as the initial state is fixed"),
        ("rollout pusher --sigma 0.2", "--sigma has an effect only with --noisy"),
        ("rollout rod.xml --contact penalty --noisy", "--contact is for a task: rod.xml moves as its MJCF says"),
        ("rollout rod.xml --damping 0", "--damping is for a task: rod.xml moves as its MJCF says"),
        ("claims --accept-versions", "--accept-versions needs the folder to resume: give --output"),
        ("claims --only nothing", "unknown claim 'nothing'; choose from "),
        ("plot nowhere --format ,", "--format must have at least one value"),
        ("plot nowhere --format gif", "--format does not accept 'gif'; choose from png, pdf, svg"),
    ],
)
def test_a_command_line_is_refused(arguments: str, says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert says in refused(shlex.split(arguments), capsys)


@pytest.mark.parametrize(
    ("arguments", "value"),
    [
        ("landscape pusher --span -2,2", (-2.0, 2.0)),
        ("compare pusher --theta -.5,2", "-.5,2"),
        ("sweep pusher --solref -1e5:-1e3:3:log;-10", ((-1e5, -10.0), (-1e4, -10.0), (-1e3, -10.0))),
    ],
)
def test_a_list_may_begin_with_a_minus(arguments: str, value: Any) -> None:
    command, *rest = arguments.split()
    parsed = cli.parser(command).parse_args([command, *rest])
    assert getattr(parsed, rest[1].removeprefix("--")) == value


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("colour = 1", "there is no option 'colour'"),
        ("stifness = 10", "there is no option 'stifness'; did you mean stiffness?"),
        ('task = "pusher"', "there is no option 'task'; did you mean tasks?"),
        ("contact = [3.5]", "contact must be text, got 3.5"),
        ("solref = 3", "solref must be a list, got 3"),
        ("published = 1", "published must be true or false, got 1"),
        ("radius = true", "radius must be a number, got True"),
        ("a = ", "not TOML: Invalid value (at end of document)"),
    ],
)
def test_a_toml_file_is_refused(content: str, says: str) -> None:
    Path("study.toml").write_text(content)
    with pytest.raises(ValueError, match=re.escape(f"study.toml: {says}")):
        read_toml(Path("study.toml"))


def test_options_of_a_file_are_spelled_as_its_keys(capsys: pytest.CaptureFixture[str]) -> None:
    Path("study.toml").write_text('tasks = ["pusher"]\ndecay = 1\n')
    line = refused(["sweep", "--config", "study.toml", "--output", "out"], capsys)
    assert line == "decay in study.toml is for descents: give --iterations as well"


def test_a_file_and_flags_are_one_configuration() -> None:
    Path("study.toml").write_text(
        'tasks = ["pusher"]\nsigma = "10:1000:3:log"\nsamples = [4, 8]\nseeds = 2\nhorizon = 9\ndirection = 3\n'
        'solref = [[-100, -5]]\npublished = true\nsolimp = "0.9,0.95,0.001,0.5,2"\n'
    )
    parsed = cli.parser().parse_args(["sweep", "--config", "study.toml", "--seeds", "3", "--points", "5"])
    assert StudyConfig(**sweep_fields(parsed)) == StudyConfig(
        tasks=("pusher",), sigma=(10.0, 100.0, 1000.0), samples=(4, 8), seeds=3, horizon=9, direction="3", points=5,
        solref=((-100.0, -5.0),), solimp=((0.9, 0.95, 0.001, 0.5, 2.0),), contact=(), published=True,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("stiffness", "10", (10.0,)),
        ("stiffness", "10:1000:3:log", (10.0, 100.0, 1000.0)),
        ("stiffness", "10:100:2:log, 1000", (10.0, 100.0, 1000.0)),
        ("theta", "0:1:5", (0.0, 0.25, 0.5, 0.75, 1.0)),
        ("theta", "-1e4:-1e2:3:log", (-1e4, -1e3, -1e2)),
        ("samples", "1e3", (1000,)),
        ("samples", "3:9:3", (3, 6, 9)),
        ("solref", "-100,-1000;-5", ((-100.0, -5.0), (-1000.0, -5.0))),
        ("solimp", "0.9,0.95,0.001,0.5,2", ((0.9, 0.95, 0.001, 0.5, 2.0),)),
        ("integrator", "RK4", "rk4"),
        ("radius", "3", 3.0),
        ("gamma", "inf", float("inf")),
    ],
)
def test_text_is_read(name: str, text: str, value: Any) -> None:
    assert OPTIONS[name].parse(text) == value
    assert OPTIONS[name].read(text if OPTIONS[name].many else value) == value


def test_every_field_is_declared_and_documented() -> None:
    assert set(vars(StudyConfig(tasks=("pusher",)))) == set(OPTIONS)
    assert "stiffness: contact stiffness [N/m] (default: the task's)" in str(StudyConfig.__doc__)


def test_tasks_are_names_or_tasks() -> None:
    with pytest.raises(OptionError, match="`estimators` must be a list, got 'zobg'"):
        StudyConfig(tasks=("pusher",), estimators="zobg")  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="`tasks` takes names and Tasks, got PosixPath"):
        plan_study(StudyConfig(tasks=(Path("pusher"),)))
    task = TASKS["pusher"](horizon=3)
    with pytest.raises(OptionError, match="`horizon` is for tasks given by name: build this one with it instead"):
        plan_study(StudyConfig(tasks=(task,), horizon=4))


def test_estimators_that_are_objects_have_options_of_their_own() -> None:
    with pytest.raises(OptionError, match="`gamma` has no effect on aobg: omit it, or choose an estimator that"):
        plan_study(StudyConfig(tasks=("pusher",), horizon=3, estimators=(AlphaOrder(gamma=3.0),), gamma=2.0))


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


@pytest.mark.parametrize(
    ("given", "own"),
    [
        ({}, {"kind": "gradients", "reference_samples": 600}),
        ({"reference_samples": 50}, {"kind": "gradients", "reference_samples": 50}),
        ({"iterations": 3}, {"kind": "descents", "evaluation_samples": 200}),
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


def test_a_single_run_has_the_main_family_at_the_middle_stiffness() -> None:
    """What the configuration leaves open; what it gives stands, and a stiffness only for a family that takes one."""
    defaults = TASKS["pusher"]().defaults
    cells = {
        "none": ({}, ("mujoco",), (defaults.middle_stiffness,)),
        "stiffness": ({"stiffness": (3.0,)}, ("mujoco",), (3.0,)),
        "contact": ({"contact": ("penalty",)}, ("penalty",), (defaults.middle_stiffness,)),
        "unswept": ({"contact": ("mujoco_default",)}, ("mujoco_default",), None),
    }
    for fields, contact, stiffness in cells.values():
        config = StudyConfig(tasks=("pusher",), **fields)
        plan = plan_study(config, single=True)
        assert plan.config == dataclasses.replace(config, contact=contact, stiffness=stiffness) and len(plan.cells) == 1
