"""Every command that the README, the pages and the help show does what it says, at a small size."""

import json
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from mjx_study import cli
from mjx_study.cli.gradcheck import UNEXERCISED
from mjx_study.tasks import TASKS, make_task

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
SMALL = {
    "compare": "--samples 4 --reference-samples 4 --horizon 4",
    "optimise": "--iterations 2 --samples 4 --evaluation-samples 4 --seeds 2 --horizon 4",
    "sweep": "--samples 4 --seeds 2 --horizon 4",
    "landscape": "--points 2 --samples 4 --horizon 4",
    "rollout": "--horizon 4 --frames 1",
    "gradcheck": "--horizon 4 --states 1",
    "bench": "--samples 4 --horizon 4",
    "diagnose": "--samples 4 --horizon 4",
    "claims": "--only lemma-closed-form",
}
OF_KIND = {"--iterations": "--iterations 2 --evaluation-samples 4", "--points": "--points 2"}
# What a page takes for granted, or another one makes.
MJCF = """<mujoco><worldbody><geom type="plane" size="1 1 0.1"/>
<body pos="0 0 0.09"><freejoint/><geom size="0.1"/></body></worldbody></mujoco>"""
ORDER: tuple[str, ...] = tuple(
    "init optimise rollout compare landscape gradcheck diagnose bench claims sweep plot report".split()
)


def from_page(page: Path, language: str = "sh") -> list[list[str]]:
    """Commands in a page's fenced blocks, those that a prompt or the arrow of `diagnose` goes before included."""
    text = "".join(re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE))
    commands = re.findall(r"^ *(?:[$>] )?mjx-study (.*)$", text, re.MULTILINE)
    return [shlex.split(command, comments=True) for command in commands]


def from_help() -> list[list[str]]:
    """Examples of every command, those that others read from first; what an example does is said after two spaces."""
    text = "\n".join(str(part) for part in epilogs())
    lines = [re.split(r" {2,}| > ", line.strip())[0] for line in text.splitlines() if line.startswith("  mjx-study ")]
    commands = (shlex.split(line)[1:] for line in lines)  # those that write a folder, where others read, come last
    return sorted(commands, key=lambda command: (ORDER.index(command[0]), "--output" in command))


def epilogs() -> list[str | None]:
    root = cli.parser()
    (commands,) = (action.choices for action in root._subparsers._group_actions)  # type: ignore[union-attr]
    return [root.epilog, *(command.epilog for command in commands.values())]  # type: ignore[union-attr]


def small(command: list[str]) -> list[str]:
    """The command on as little as shows that it works; later flags win."""
    name, *rest = ["pusher" if part == "TASK" else part for part in command]
    more = "--horizon 4".split() if "--mean" in rest else SMALL.get(name, "").split()
    if name == "sweep":
        more += next((own for flag, own in OF_KIND.items() if flag in rest), "--reference-samples 4").split()
    return [name, *rest, *more]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the files that the pages speak of."""
    extending = (ROOT / "docs" / "extending.md").read_text()
    adding = (ROOT / "docs" / "estimators.md").read_text()
    files = (
        ("hopper.xml", "xml", extending),
        ("my_tasks.py", "python", extending),
        ("my_estimators.py", "python", adding),
    )
    for name, language, page in files:
        (tmp_path / name).write_text(re.findall(rf"```{language}\n(.*?)```", page, re.DOTALL)[0])
    for name in ("my_model.xml", "humanoid.xml", "robot.xml"):
        (tmp_path / name).write_text(MJCF)
    np.save(tmp_path / "learnt.npy", np.zeros(21))
    (tmp_path / "study.toml").write_text('tasks = ["pusher"]\nstiffness = "10:1000:2:log"\n')
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def ran() -> set[tuple[str, ...]]:
    """Commands without a folder that have run: pages repeat each other's."""
    return set()


@pytest.mark.slow
@pytest.mark.usefixtures("shared_programs")
@pytest.mark.parametrize("source", [*filter(from_page, PAGES), None], ids=lambda page: page.name if page else "help")
def test_every_command_runs(
    source: Path | None, here: Path, ran: set[tuple[str, ...]], capsys: pytest.CaptureFixture[str]
) -> None:
    commands = from_help() if source is None else from_page(source)
    assert commands
    for command in commands:
        folder = command[command.index("--output") + 1] if "--output" in command else None
        if folder is None and tuple(command) in ran:
            continue
        ran.add(tuple(command))
        if folder is not None and command[0] in ("compare", "landscape", "optimise", "sweep"):
            shutil.rmtree(here / folder, ignore_errors=True)  # another study may be there, and would be kept
        if "--theta" in command and not (theta := Path(command[command.index("--theta") + 1])).exists():
            theta.parent.mkdir(exist_ok=True)  # as a descent writes it
            theta.write_text(json.dumps(make_task(command[1], horizon=4).theta.tolist()))
        code = cli.main(small(command))
        printed = capsys.readouterr()
        if "mp4" in command and shutil.which("ffmpeg") is None:
            assert code == 2 and "mp4 needs ffmpeg" in printed.err
            continue
        codes = (0, UNEXERCISED) if command[0] == "gradcheck" else (0,)  # one state exercises little
        assert code in codes, (command, printed.err, printed.out[-2000:])
        assert folder is None or any((here / folder).iterdir()), command


def test_every_command_parses() -> None:
    parser = cli.parser()
    pages = [command for page in PAGES for command in from_page(page, r"\w*")]
    for commands in (from_help(), pages):
        assert {command[0] for command in commands} >= {"compare", "optimise", "sweep", "landscape", "rollout"}
        for command in commands:
            parsed = parser.parse_args(["pusher" if part == "TASK" else part for part in command])
            assert parsed.command in cli.COMMANDS
            task = getattr(parsed, "task", "pusher")
            assert task in TASKS or task.endswith(".xml") or ":" in task, command
    assert {"compare", "gradcheck"} <= {command[0] for page in PAGES for command in from_page(page, "text")}
