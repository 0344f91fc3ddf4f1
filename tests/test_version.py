"""Versions of packages, and of a copy of this one that is not installed: a command never fails for lack of it."""

import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

from mjx_study.identity import versions
from mjx_study.version import UNKNOWN, version_of

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


def test_a_package_has_the_version_that_is_installed() -> None:
    stated = f'version = "{version_of("mjx-study")}"'
    assert stated in (ROOT / "pyproject.toml").read_text().splitlines()
    assert versions()["mjx-study"] == version_of("mjx-study") != UNKNOWN
    assert version_of("numpy") == metadata.version("numpy")
    with pytest.raises(metadata.PackageNotFoundError):
        version_of("mjx-study-of-nobody")


def test_commands_run_where_nothing_is_installed(tmp_path: Path) -> None:
    for name in ("mjx_study", "estimators", "models"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    study = ["compare", "pusher", "--contact", "reference", "--stiffness", "10", "--horizon", "2", "--samples", "4"]
    whole = [*study, "--reference-samples", "4", "--output", str(tmp_path / "out")]
    for arguments, says in ((["--version"], f"mjx-study {UNKNOWN}\n"), (whole, "written to")):
        command = [sys.executable, "-P", "-c", WITHOUT, str(tmp_path), *arguments]
        done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
        assert done.returncode == 0 and says in done.stdout, done.stderr
