"""How commands end: by a signal with one line and its exit code, on a full disk with their numbers and one line."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjx_study import cli, disk
from mjx_study.cli import output, studies
from mjx_study.execution.run import run_study
from mjx_study.experiment.study import StudyCell, StudyPlan
from mjx_study.results.variables import GRADIENTS
from tests.documents import content, stages_of, stub_cells
from tests.processes import ROOT, run_script

SIGNALS = """
import os, signal, sys, time
from mjx_study.cli import output

signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job's children ignore it
signal.signal(signal.SIGHUP, signal.SIG_DFL)
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
    child = os.fork()
    if child == 0:
        with output.computing("the same command resumes"):
            os.kill(os.getpid(), number)
            time.sleep(5)
        os._exit(1)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
signal.signal(signal.SIGHUP, signal.SIG_IGN)  # nohup
with output.computing():
    os.kill(os.getpid(), signal.SIGHUP)
print("goes on")
"""


def test_a_signal_ends_a_command_with_one_line_and_its_code() -> None:
    done = run_script(SIGNALS)
    assert done.stdout.split("\n")[:4] == ["130", "143", "129", "goes on"]
    words = ("interrupted", "terminated", "hung up")
    said = [line for line in done.stderr.splitlines() if line.startswith("mjx-study: ")]
    assert said == [f"mjx-study: {word}; the same command resumes" for word in words]


UNREAD = """
import os, signal, sys, time
from mjx_study.cli import output

signal.signal(signal.SIGHUP, signal.SIG_DFL)
if sys.argv[2] == "full":
    os.set_blocking(2, False)
    try:
        while True:
            os.write(2, bytes(4096))
    except BlockingIOError:
        os.set_blocking(2, True)
with output.computing():
    print("begun", flush=True)
    for _ in range(50):
        time.sleep(0.1)
"""


@pytest.mark.parametrize(
    ("state", "number"),
    [("gone", signal.SIGTERM), ("full", signal.SIGTERM), ("closed", signal.SIGTERM), ("gone", signal.SIGHUP)],
)
def test_a_signal_ends_a_command_that_cannot_say_so(state: str, number: signal.Signals) -> None:
    """The reader of standard error has gone, does not read, or there never was one."""
    read, write = os.pipe()
    command = [sys.executable, "-c", UNREAD, "-", state]
    command = ["sh", "-c", 'exec "$@" 2>&-', "-", *command] if state == "closed" else command
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=write) as running:
        os.close(write)
        assert running.stdout is not None and running.stdout.readline() == b"begun\n"
        if state == "gone":
            os.close(read)
        running.send_signal(number)
        assert running.wait(timeout=4) == 128 + number
    if state != "gone":
        os.close(read)


def test_a_command_with_a_folder_can_be_resumed_to_its_end(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also by what is computed once the study is written; without a folder nothing is."""
    told: list[str] = []

    def computing(interrupted: str = output.INTERRUPTED) -> Any:
        told.append(interrupted)
        return output.computing(interrupted)

    monkeypatch.setattr(studies, "computing", computing)
    study = "compare pusher --contact reference --stiffness 10 --horizon 2 --samples 4 --reference-samples 8".split()
    for folder, expected in (([], output.INTERRUPTED), (["--output", str(tmp_path)], output.RESUMABLE)):
        assert cli.main([*study, *folder]) == 0, capsys.readouterr().err
        assert told == [expected] * 2
        told.clear()


FILM = """
import numpy as np
from mjx_study.cli import output
from mjx_study.render import figures

with output.computing():
    figures._mp4(np.zeros((2, 4, 4, 3), np.uint8), np.array([500, 500]))
"""
FFMPEG = """#!/bin/sh
trap 'touch "$0.ended"; exit 1' TERM
kill -TERM $PPID
for i in $(seq 50); do sleep 0.1; done
"""


def test_a_signal_ends_children_and_removes_their_folder(tmp_path: Path) -> None:
    """Of ffmpeg, amid a film."""
    (tmp_path / "kept").mkdir()
    (ffmpeg := tmp_path / "ffmpeg").write_text(FFMPEG)
    ffmpeg.chmod(0o755)
    settings = os.environ | {"TMPDIR": str(tmp_path / "kept"), "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    done = subprocess.run([sys.executable, "-c", FILM], env=settings, cwd=ROOT, stderr=subprocess.DEVNULL)
    assert done.returncode == 128 + signal.SIGTERM and not list((tmp_path / "kept").iterdir())
    for _ in range(40):
        if (tmp_path / "ffmpeg.ended").exists():
            break
        time.sleep(0.1)
    assert (tmp_path / "ffmpeg.ended").exists()


def test_names_of_folders_need_not_be_utf_8(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every file of a study can be read again, and holds the command that wrote it."""
    folder = os.fsdecode(os.fsencode(tmp_path) + b"/out\xff")
    study = "compare pusher --contact reference --stiffness 10 --horizon 2 --samples 4 --reference-samples 8 --output"
    for command in (study.split(), ["plot"], ["report"]):
        assert cli.main([*command, folder]) == 0, capsys.readouterr().err
    page = (Path(folder) / "report.html").read_text()
    assert r"--output &#39;" in page and r"out\udcff" in page


@pytest.fixture
def full(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Fills the disk: no file can be begun any more."""

    def begin(path: Path) -> Any:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    return lambda: monkeypatch.setattr(disk, "_begin", begin)


def ended(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Standard output of a command that could not write."""
    capsys.readouterr()
    assert cli.main(list(arguments)) == 1
    out, told = capsys.readouterr()
    *stages, error = told.splitlines()
    stages_of("\n".join(stages))
    assert error.startswith("mjx-study: cannot write"), told
    assert "No space left on device" in error
    return out


def test_a_full_disk_costs_no_number(
    tmp_path: Path, full: Callable[[], None], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is full once the folder is begun."""

    def run(*arguments: Any, **options: Any) -> Any:
        full()
        return run_study(*arguments, **options)

    monkeypatch.setattr(studies, "run_study", run)
    small = "--contact reference --stiffness 10 --horizon 4 --samples 8 --reference-samples 8 --json --output"
    assert json.loads(ended(capsys, "compare", "pusher", *small.split(), str(tmp_path)))["rows"]
    assert not list((tmp_path / "cells").iterdir())


def test_a_full_disk_is_told_before_anything_is_computed(
    tmp_path: Path, full: Callable[[], None], capsys: pytest.CaptureFixture[str]
) -> None:
    full()
    assert cli.main(["compare", "pusher", "--horizon", "4", "--output", str(tmp_path)]) == 2
    out, error = capsys.readouterr()
    assert out == "" and error.count("\n") == 1 and "No space left on device" in error


def test_a_full_disk_costs_a_study_nothing_that_was_there(
    tmp_path: Path, full: Callable[[], None], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def compute(plan: StudyPlan, cell: StudyCell) -> dict[str, np.ndarray]:
        if cell.samples == 8:
            full()
        sizes = {"seed": plan.config.seeds, "estimator": len(plan.config.estimators)}
        held = {name: each for name, each in GRADIENTS.items() if "param" not in each.dims}
        return {
            name: np.full([sizes[dim] for dim in each.dims], 9.0 if each.digits else 0.0) for name, each in held.items()
        }

    stub_cells(monkeypatch, compute)
    folder = tmp_path / "out"
    arguments = ["sweep", "pusher", "--stiffness", "10", "--contact", "penalty", "--samples", "4,8", "--horizon", "2"]
    out = ended(capsys, *arguments, "--output", str(folder))
    assert "computed 1 cells" in out and "1 cells are not computed yet" in out and "results.nc" not in out
    before = content(folder)
    assert len(before) == 3  # study.json, its lock, and a cell
    assert json.loads(ended(capsys, *arguments, "--output", str(folder), "--json"))["cells"]
    assert ended(capsys, "plot", str(folder)) == "warning: 1 cells are not computed yet; the same command resumes\n"
    assert "written" not in ended(capsys, "report", str(folder))
    assert before == content(folder)
