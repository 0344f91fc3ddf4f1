"""The version of a checkout, installed or not, and of what is neither: a command never fails for lack of it."""

import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

from mjx_study import version
from mjx_study.identity import versions
from mjx_study.version import UNKNOWN, summary, version_of

ROOT = Path(__file__).parents[1]
WITHOUT = """
import sys
from importlib import metadata

sys.path.insert(0, sys.argv.pop(1))
found = metadata.Distribution.from_name


def from_name(name):
    if name == "mjx-study":
        raise metadata.PackageNotFoundError(name)
    return found(name)


metadata.Distribution.from_name = from_name
from mjx_study.cli import main

sys.exit(main(sys.argv[1:]))
"""
"""Runs a command of the package in a folder, which is not installed."""


@pytest.fixture(autouse=True)
def fresh() -> None:
    version._checkout.cache_clear()


def test_a_checkout_has_the_version_that_it_states() -> None:
    stated = f'version = "{version_of("mjx-study")}"'
    assert stated in (ROOT / "pyproject.toml").read_text().splitlines()
    assert versions()["mjx-study"] == version_of("mjx-study") != UNKNOWN
    assert version_of("numpy") == metadata.version("numpy")
    with pytest.raises(metadata.PackageNotFoundError):
        version_of("mjx-study-of-nobody")


@pytest.mark.parametrize("content", ["", "[project", "[tool]", '[project]\nname = "another"\nversion = "9"', "\udcff"])
def test_another_projects_file_is_not_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: str) -> None:
    (tmp_path / "pyproject.toml").write_text(content, errors="surrogateescape")
    monkeypatch.setattr(version, "__file__", str(tmp_path / "mjx_study" / "version.py"))
    monkeypatch.setattr(metadata, "metadata", lambda name: {"Version": "7.0", "Summary": "an installed one"})
    assert version_of("mjx-study") == "7.0" and summary() == "an installed one"


@pytest.mark.parametrize("checkout", [True, False])
def test_commands_run_where_nothing_is_installed(tmp_path: Path, checkout: bool) -> None:
    """From a checkout, or from a copy of the packages alone."""
    for name in ("mjx_study", "estimators", "models"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    if checkout:
        shutil.copy(ROOT / "pyproject.toml", tmp_path)
    command = [sys.executable, "-P", "-c", WITHOUT, str(tmp_path)]
    study = ["compare", "pusher", "--contact", "reference", "--stiffness", "10", "--horizon", "2", "--samples", "4"]
    whole = [*study, "--reference-samples", "4", "--output", str(tmp_path / "out")]
    for arguments in (["--version"], ["--help"], *([] if checkout else [whole])):
        done = subprocess.run([*command, *arguments], capture_output=True, text=True, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        if arguments == ["--version"]:
            assert done.stdout == f"mjx-study {version_of('mjx-study') if checkout else UNKNOWN}\n"
