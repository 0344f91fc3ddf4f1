"""What the README shows works as it stands there."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from mjx_study import cli
from mjx_study.contact import FAMILIES

README = (Path(__file__).parents[1] / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_the_python_example_runs(tmp_path: Path) -> None:
    (code,) = blocks("python")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, timeout=600)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 9 and all("not finite 0" in line for line in lines), done.stdout
    assert list(tmp_path.iterdir()) == []


def test_every_command_parses() -> None:
    commands = [line.split("#")[0].split() for line in "".join(blocks("sh")).splitlines()]
    ours = [command[1:] for command in commands if command[:1] == ["mjx-study"]]
    assert len(ours) >= 6
    for arguments in ours:
        assert callable(cli._parser().parse_args(arguments).run)


def test_every_target_exists() -> None:
    makefile = (Path(__file__).parents[1] / "Makefile").read_text()
    targets = re.findall(r"^make (\w+)", "".join(blocks("sh")), re.MULTILINE)
    assert targets == ["demo", "test"]
    for target in targets:
        assert re.search(rf"^{target}:", makefile, re.MULTILINE)


@pytest.mark.parametrize("name", list(FAMILIES))
def test_every_family_is_explained(name: str) -> None:
    assert f"| `{name}` |" in README
