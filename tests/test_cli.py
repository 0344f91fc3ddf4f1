"""The command line as a user meets it: figures that are true, one line for what is wrong, nothing written then."""

import contextlib
import io
import json
import os
from pathlib import Path
from typing import Any, NoReturn

import pytest

from mjx_study import cli
from mjx_study.options.configuration import OPTIONS, as_arguments
from mjx_study.results.rows import rows_of
from mjx_study.storage.folder import load_study
from mjx_study.tasks import TASKS
from tests.documents import stages_of
from tests.test_options import refused

pytestmark = pytest.mark.usefixtures("shared_programs")

SMALL = ["--horizon", "4", "--samples", "8", "--reference-samples", "8", "--chunk-size", "4"]


@pytest.fixture(scope="module")
def small_run(shared_programs: None, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """One small comparison with an output folder, and what it printed."""
    folder = tmp_path_factory.mktemp("out") / "results"
    command = ["compare", "pusher", *SMALL, "--output", str(folder), "--details"]
    command += ["--stiffness", "10,1000", "--contact", "penalty,mujoco_default", "--estimators", "zobg,fobg,aobg,ivw"]
    out, told = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(told):
        assert cli.main(command) == 0
    first, *others = stages_of(told.getvalue())
    assert first == "[0/3] pusher, penalty, K = 10 N/m, h = 0.005 s, N = 8 (compiling first)"
    assert others == ["[1/3] pusher, penalty, K = 1000 N/m, h = 0.005 s, N = 8", others[1], "[3/3] done"]
    return folder, out.getvalue()


def test_compare_has_a_row_for_every_cell(small_run: tuple[Path, str]) -> None:
    rows = rows_of(load_study(small_run[0]))
    cells = [(row.contact, row.stiffness, row.estimator) for row in rows]
    names = ["zobg", "fobg", "aobg", "ivw"]
    swept = [("penalty", stiffness, name) for stiffness in (10.0, 1000.0) for name in names]
    assert cells == swept + [("mujoco_default", pytest.approx(125.0), name) for name in names]
    for row in rows:
        assert row.variance_lower <= row.variance <= row.variance_upper
        assert row.seconds_per_sample > 0 and row.residual < 1e-6 and row.nonfinite == 0
        assert (row.alpha is None) == (row.estimator in ("zobg", "fobg"))


def test_a_result_holds_what_decided_it(small_run: tuple[Path, str]) -> None:
    data = load_study(small_run[0])
    config, (resolved,) = (json.loads(data.attrs[name]) for name in ("config", "resolved"))
    assert config["horizon"] == 4 and resolved["horizon"] == [4] and resolved["estimators"]["aobg"]["gamma"] == 1e8
    assert data["sigma"].item() == 0.1 and data["cone"].item() == "pyramidal"
    environment = json.loads(data.attrs["environment"])
    assert environment["versions"]["mujoco"].startswith("3.17") and environment["precision"] == "float64"
    assert data["gradient"].sizes["param"] == 4 and data["reference"].notnull().all()


def test_figures_are_written_whole(small_run: tuple[Path, str]) -> None:
    folder, printed = small_run
    kept = ["cells", "comparison.pdf", "comparison.png", "results.nc", "study.json", "study.lock"]
    assert sorted(path.name for path in folder.iterdir()) == kept
    assert (folder / "comparison.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "comparison.pdf").read_bytes().rstrip().endswith(b"%%EOF")
    numbers = "results.nc (every number), study.json (the configuration), cells/ (checkpoints)"
    assert printed.endswith(f"written to {folder}: comparison.png, comparison.pdf, {numbers}\n")


def test_warnings_about_the_contact_reach_the_reader(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["compare", "pusher", *SMALL, "--stiffness", "1e4", "--contact", "penalty", "--estimators", "zobg"]
    assert cli.main(arguments) == 0
    assert "warning: penalty, K = 10000 N/m: h^2 k" in capsys.readouterr().out


def test_tasks(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["tasks"]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in TASKS)
    assert cli.main(["tasks", "--json"]) == 0
    tasks = {task["name"]: task for task in json.loads(capsys.readouterr().out)["tasks"]}
    assert list(tasks) == list(TASKS)
    assert tasks["pusher"]["params"] == 200 and tasks["pusher"]["effective_mass"] == pytest.approx(0.05)
    assert tasks["double_pendulum"]["effective_mass"] is None


@pytest.mark.parametrize(
    "command", ["compare", "optimise", "sweep", "landscape", "rollout", "gradcheck", "diagnose", "bench"]
)
def test_every_command_about_a_task_overrides_the_options_of_its_mjcf(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    seen: dict[str, Any] = {}

    def builder(**arguments: Any) -> NoReturn:
        seen.update(arguments)
        raise ValueError("seen")

    monkeypatch.setitem(TASKS, "pusher", builder)
    given = {"integrator": "euler", "solver": "cg", "solver_iterations": 7, "solver_ls_iterations": 9}
    given |= {"horizon": 4, "timestep": 0.001}
    flags = [text for name, value in given.items() for text in (OPTIONS[name].flag, str(value))]
    flags += ["--disable-flag", "warmstart,gravity", *(["--dry-run"] if command == "sweep" else [])]
    assert "seen" in refused([command, "pusher", *flags], capsys)
    seen.pop("timestep", None)  # studies ask for the task's defaults first
    assert seen == as_arguments(given | {"timestep": None, "disable_flag": ("warmstart", "gravity")})


def test_the_log_level_of_xla_is_the_users_where_it_is_set(monkeypatch: pytest.MonkeyPatch) -> None:
    for given, found in ((None, "3"), ("0", "0")):
        monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", given or "")
        if given is None:
            monkeypatch.delenv("TF_CPP_MIN_LOG_LEVEL")
        assert cli.main(["estimators"]) == 0 and os.environ["TF_CPP_MIN_LOG_LEVEL"] == found
