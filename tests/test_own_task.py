"""A task of the user's own: the page that explains it works as it stands there, and each mistake gets one line."""

import json
import math
import re
import sys
from collections.abc import Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_study import cli
from mjx_study.choices import TASK_GROUP
from mjx_study.cli.gradcheck import UNEXERCISED
from mjx_study.experiment.plan import plan_study
from mjx_study.gradcheck import plan_gradcheck
from mjx_study.options.configuration import StudyConfig
from mjx_study.tasks import make_task, task_with_options
from mjx_study.tasks.task import Task

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "extending.md").read_text()
MJCF, PYTHON, LIFTED, OTHERS, *_ = (
    *re.findall(r"```xml\n(.*?)```", PAGE, re.DOTALL),
    *re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL),
)
TINY = """
import jax.numpy as jnp
from mjx_study import InitialStatePolicy, OpenLoop, State, Task, initial_state, load_scene

def hop(horizon=3, **options):
    scene, policy = load_scene("pusher", **options), OpenLoop(horizon, 1)
    return Task(name="hop", scene=scene, horizon=horizon, policy=policy, theta=jnp.zeros(horizon), sigma=1.0,
                start=initial_state(scene), contact_pair=("pusher", "slider"), final_cost=lambda state: state.qpos[1])
"""


@pytest.fixture(autouse=True)
def nothing_stays_imported() -> Iterator[None]:
    forget()
    path = list(sys.path)
    yield
    assert sys.path == path
    forget()


def forget() -> None:
    """Forget modules of these names, those of other tests, too."""
    for name in list(sys.modules):
        if name.split(".")[0] in ("my_tasks", "mine", "broken", "inner"):
            del sys.modules[name]


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Writes the module `mine` into the current directory, which Python has no reason to look into."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry not in ("", str(tmp_path))])

    def write(source: str, name: str = "mine") -> None:
        (tmp_path / f"{name}.py").write_text(source)

    return write


@pytest.fixture
def register(monkeypatch: pytest.MonkeyPatch):
    """Has installed packages register tasks, given as (name, place)."""

    def register(*points: tuple[str, str]) -> None:
        registered = metadata.EntryPoints([metadata.EntryPoint(*point, TASK_GROUP) for point in points])
        monkeypatch.setattr(metadata, "entry_points", lambda **wanted: registered.select(**wanted))

    return register


def refused(name: str, **options: Any) -> str:
    with pytest.raises(ValueError) as error:
        make_task(name, **options)
    message = str(error.value)
    assert "\n" not in message
    return message


# Every command, with a small task; test_documented_commands runs those of the page


@pytest.fixture(scope="module")
def task(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Its file is in the current directory."""
    path = tmp_path_factory.mktemp("small")
    (path / "mine.py").write_text("from tests.carts import cart\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(path)
        yield "mine:cart"


@pytest.fixture
def document(capsys: pytest.CaptureFixture[str]):
    def document(command: str, codes: Sequence[int] = (0,)) -> dict[str, Any]:
        """What a command prints as JSON."""
        assert cli.main([*command.split(), "--json"]) in codes
        return json.loads(capsys.readouterr().out)

    return document


COMMANDS: dict[str, tuple[str, tuple[str, ...]]] = {
    "compare TASK --samples 4 --reference-samples 4": ("rows", ("variance", "relative_error")),
    "landscape TASK --points 3 --direction 0 --span=-1,1 --samples 4": ("curves", ("cost", "smoothed", "slope")),
    "gradcheck TASK --states 1": ("steps", ("differences",)),
    "gradcheck TASK --mean --contact mjcf": ("checks", ("difference", "gap")),
    "diagnose TASK --samples 23": ("estimators", ("variance",)),
}
"""Commands, and what each reports: numbers of a list."""


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_about_it_reports_numbers(command: str, task: str, document) -> None:
    several, names = COMMANDS[command]
    found = document(command.replace("TASK", task), codes=(0, UNEXERCISED))
    assert task in (found.get("subject"), *found.get("config", {}).get("tasks", ())) or "gradcheck" in command
    numbers = [np.array(each[name], float) for each in found[several] for name in names]
    assert numbers and all(np.all(np.isfinite(each)) for each in numbers)


def test_a_policy_that_was_found_is_replayed_and_its_study_drawn(task: str, document) -> None:
    small = "--iterations 2 --samples 4 --seeds 1 --learning-rate 0.1 --estimators fobg --output descent"
    (run,) = document(f"optimise {task} {small}")["runs"]
    found = document(f"rollout {task} --theta descent/policy-fobg.json --renderer drawing")
    assert found["theta"] == run["theta"][0] and found["task"] == "cart" and math.isfinite(found["cost"])
    assert {Path(name).parent for name in found["written"]} == {Path("results/mine-cart-rollout")}
    assert document("plot descent --output drawn")["written"] == ["drawn/descent.png", "drawn/descent.pdf"]
    document("report descent")
    assert f"<h1>{task}: " in Path("descent/report.html").read_text()


@pytest.mark.parametrize("name", ["hopper", "feedback", "thrown"])
def test_every_command_plans_with_it(name: str, write, tmp_path: Path) -> None:
    (tmp_path / "hopper.xml").write_text(MJCF)
    write(PYTHON + OTHERS, "my_tasks")
    task = f"my_tasks:{name}"
    built = make_task(task, horizon=5, cone="pyramidal")
    assert built.horizon == 5 and built.name == "hopper" and built.scene.host.opt.cone == 0
    assert len(plan_study(StudyConfig(tasks=(task,))).cells) == 12
    assert plan_study(StudyConfig(tasks=(task,), kind="descents")).groups[0].recipe == built.defaults.recipe
    line: dict[str, Any] = {"points": 3, "direction": "0", "span": (-1.0, 1.0)}
    assert len(plan_study(StudyConfig(tasks=(task,), **line)).cells) == 12
    assert plan_gradcheck(built, None, None, seed=0, states=1).is_task
    assert built.policy.additive == (name != "feedback")


# Names


def test_a_task_is_found_in_the_current_directory(write) -> None:
    write(TINY + "\nmade = hop(horizon=4)\n")
    assert make_task("mine:hop").horizon == 3
    assert make_task("mine:hop", horizon=7).horizon == 7
    assert make_task("mine:made").horizon == 4


def test_names_of_this_package_come_first(write, register) -> None:
    write("raise RuntimeError('imported')", "ball_wall")
    register(("pusher", "broken:pusher"))
    assert make_task("ball_wall:dome", horizon=3).name == "ball_wall:dome"
    assert make_task("pusher", horizon=3).name == "pusher"


def test_packages_register_tasks(write, register) -> None:
    write(TINY)
    register(("hop", "mine:hop"), ("other", "broken:hop"), ("hop:high", "mine:hop"))
    assert make_task("hop", horizon=5).horizon == 5
    assert make_task("hop:high").horizon == 3
    assert refused("hip").startswith("unknown task 'hip'; did you mean hop?")
    assert "double_pendulum:published, hop, hop:high, other, module:name of your own, or an MJCF" in refused("xyz")
    assert refused("other") == "there is no module 'broken' here or installed"


def test_packages_at_odds(register) -> None:
    register(("hop", "b:hop"), ("hop", "a:hop"))
    assert refused("hop") == "task 'hop' is registered more than once; choose from a:hop, b:hop"


def test_the_current_directory_is_on_the_path_during_the_import_only(write, tmp_path: Path) -> None:
    write(TINY + "\nimport sys\nseen = list(sys.path)\n")
    make_task("mine:hop")
    assert sys.modules["mine"].seen[0] == str(tmp_path)
    assert str(tmp_path) not in sys.path


# Mistakes


def test_no_such_module(write) -> None:
    told = "module:name of your own, or an MJCF (there is no module 'mine' here or installed)"
    assert refused("mine:hop").endswith(told)
    assert refused("ball_wall:dom").startswith("unknown task 'ball_wall:dom'; did you mean ball_wall:dome? (")
    write(TINY)
    assert refused("mine") == "mine is a module: choose a task in it, as mine:hop"
    assert refused("mine.py") == "mine.py is a module: choose a task in it, as mine:hop"
    for name in ("mine.py:hop", "folder/mine:hop", ":hop", ".mine:hop"):
        assert refused(name).endswith("is not a module name: write it as in an import, without a folder or .py)")


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("x = 1\ny = z", "importing mine raised NameError: name 'z' is not defined (mine.py, line 2)"),
        ("def hop(:", "importing mine raised SyntaxError: invalid syntax (mine.py, line 1)"),
        ("import nowhere", "importing mine raised ModuleNotFoundError: No module named 'nowhere' (mine.py, line 1)"),
        ("raise SystemExit", "importing mine raised SystemExit (mine.py, line 1)"),
        ("raise ValueError('two\\nlines')", "importing mine raised ValueError: two lines (mine.py, line 1)"),
        ("", "mine has no 'hop'; it has no task"),
        ("from math import pi\ndef hip(): ...", "mine has no 'hop'; it has hip"),
        ("hop = 3", "mine:hop is neither a Task nor a function that returns one, but of type int"),
        ("def hop(**_): ...", "mine:hop returned an object of type NoneType instead of a Task"),
        ("def hop(horizon):\n  return 1 / 0", "mine:hop raised ZeroDivisionError: division by zero (mine.py, line 2)"),
        ("def hop(kind, horizon): ...", "mine:hop does not take the options given (missing a required argument: 'k"),
        ("def hop(): ...", "mine:hop does not take the options given (got an unexpected keyword argument 'horizon')"),
        ("import mjx_study as m\ndef hop(horizon): m.load_scene('a.xml')", "mine:hop raised SceneError: no MJCF file "),
        (f"{TINY}\nhop = hop()", "mine:hop is a ready-made Task, which horizon cannot change"),
    ],
)
def test_what_is_no_task(source: str, says: str, write) -> None:
    write(source)
    assert refused("mine:hop", horizon=3).startswith(says)


def test_a_timestep_brings_a_horizon(write) -> None:
    write(f"{TINY}\ndef short(timestep=0.005): return hop(timestep=timestep)")
    with pytest.raises(ValueError, match="keyword argument 'horizon'.*: a timestep comes with the horizon that keeps"):
        task_with_options("mine:short", {"timestep": 0.0025})


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("policy=OpenLoop(1, 3)", "the policy's feedforward has shape (1, 3); 3 steps and 1 controls need (3, 1)"),
        ("theta=jnp.zeros(3, jnp.float32)", "theta is float32, and the simulation float64"),
        ("final_cost=lambda state: state.qpos", "the final_cost has shape (2,), and a cost is a scalar"),
        ("running_cost=lambda state, control: control", "the running_cost has shape (1,), and a cost is a scalar"),
        ("policy=type('Mute', (OpenLoop,), {'feedforward': print})(3, 1)", "the policy's feedforward returns a NoneTy"),
        ("final_cost=lambda state: state.position[0]", "the final_cost raised AttributeError: a state has qpos, qvel"),
        ("policy=InitialStatePolicy(3, 0, 3, lambda start, theta: 1 / 0)", "place raised ZeroDivisionError: division"),
        ("start=State(*map(jnp.zeros, (1, 2, 0, 2)))", "qpos of the start has shape (1,); the scene needs (2,)"),
        ("sigma=0.0", "ValueError: sigma must be positive"),
    ],
)
def test_parts_that_do_not_fit(change: str, says: str, write) -> None:
    """Broadcasting and clamped indices would let most of these pass, and give numbers."""
    write(TINY + f"\ndef bad():\n    return hop().replace({change})\n")
    assert says in refused("mine:bad")


# What a task may leave out


def test_defaults(write) -> None:
    write(TINY)
    task = make_task("mine:hop")
    assert task.defaults.gamma == float("inf") and task.description == "" and task.defaults.recipe is None
    cost = task.costs()[0](task.draw_start(jax.random.key(0)), jnp.zeros(1))
    assert cost == 0 and cost.dtype == jnp.float64
    with pytest.raises(ValueError, match="a task needs a running_cost, a final_cost, or both"):
        Task(
            **{name: getattr(task, name) for name in "name scene horizon policy theta sigma start contact_pair".split()}
        )


def test_registered_tasks_are_listed(register, capsys: pytest.CaptureFixture[str]) -> None:
    register(("hop", "a:hop"))
    assert cli.main(["tasks"]) == 0
    assert "hop                       registered by an installed package" in capsys.readouterr().out.splitlines()
