"""What needs no simulation imports nothing that computes, what is described is there, and nothing need be installed."""

import importlib
import json
import pkgutil
import resource
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from types import ModuleType

import mujoco
import pytest

import estimators
import mjx_study
from estimators import BASELINES, NOISES
from estimators import choices as names
from mjx_study import choices
from mjx_study.cli import COMMANDS
from mjx_study.identity import versions
from mjx_study.plots.style import STYLES
from mjx_study.tasks import TASKS
from mjx_study.version import UNKNOWN, version_of
from tests.processes import ROOT, run_script

NAMING_FLAGS = ["gradcheck --help", "rollout --help"]
"""Commands whose help lists the names of MuJoCo's flags."""
LIGHT = [
    "--version",
    "--help",
    "tasks",
    "estimators",
    *(f"{name} --help" for name in COMMANDS if f"{name} --help" not in NAMING_FLAGS),
    "compare puhser",
    "sweep pusher",
    "optimise pusher --samples 0",
    "landscape pusher --contact spring",
]
HEAVY = {"jax", "jaxlib", "matplotlib", "mujoco", "numpy", "pydantic", "rich", "scipy", "xarray"}
WATCH = """
import sys
from mjx_study.cli import main
for arguments in sys.argv[1:]:
    try:
        main(arguments.split())
    except SystemExit:
        pass
    print("after", arguments, "|", *sorted({name.partition(".")[0] for name in sys.modules}))
"""


@pytest.mark.parametrize(("commands", "allowed"), [(LIGHT, set()), (NAMING_FLAGS, {"mujoco", "numpy"})])
def test_help_lists_and_refusals_import_nothing_that_computes(commands: list[str], allowed: set[str]) -> None:
    printed = run_script(WATCH, *commands).stdout
    loaded = [line.split("|") for line in printed.splitlines() if line.startswith("after ")]
    assert len(loaded) == len(commands)
    for after, modules in loaded:
        assert HEAVY & set(modules.split()) <= allowed, after


def test_the_version_takes_little_longer_than_python_itself() -> None:
    """In processor time, the least of three: all that computes takes 20 times as long as NumPy alone."""

    def seconds(*arguments: str) -> float:
        def once() -> float:
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            subprocess.run([sys.executable, *arguments], capture_output=True, cwd=ROOT, check=True)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

        return min(once() for _ in range(3))

    assert seconds("-m", "mjx_study", "--version") < 2 * seconds("-c", "import numpy")


@pytest.mark.parametrize("package", [estimators, mjx_study])
def test_what_a_package_offers_is_there(package: ModuleType) -> None:
    assert len(package.__all__) > 30 and set(package.__all__) <= set(dir(package))
    assert all(getattr(package, name) is not None for name in package.__all__)
    modules = {module.name for module in pkgutil.iter_modules(package.__path__)}
    assert not modules & set(package.__all__), "a module once imported would hide what has its name"
    with pytest.raises(AttributeError, match=f"module '{package.__name__}' has no attribute 'nothing'"):
        package.nothing  # noqa: B018


def test_descriptions_are_of_what_there_is() -> None:
    """Names with one description each, in modules that import nothing; what they describe is elsewhere."""
    assert tuple(names.BASELINES) == tuple(BASELINES) and tuple(names.DENSITIES) == tuple(NOISES)
    assert list(choices.TASK_DESCRIPTIONS) == list(TASKS)
    assert choices.FIGURE_STYLES == tuple(STYLES)
    assert (choices.MIN_IMPEDANCE, choices.MAX_IMPEDANCE) == (mujoco.mjMINIMP, mujoco.mjMAXIMP)


def test_the_estimators_are_also_a_part_of_the_package() -> None:
    assert importlib.import_module("mjx_study.estimators") is mjx_study.estimators is estimators


def test_a_file_that_hides_the_estimators_is_told_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "estimators.py").write_text("raise SystemExit('not to be run')")
    command = [sys.executable, "-c", "import mjx_study"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    told = f"ImportError: {tmp_path / 'estimators.py'} hides the package `estimators` of mjx-study: rename it, or work"
    assert done.returncode == 1 and told in done.stderr.splitlines()[-1]


def test_a_package_has_the_version_that_is_installed() -> None:
    stated = f'version = "{version_of("mjx-study")}"'
    assert stated in (ROOT / "pyproject.toml").read_text().splitlines()
    assert versions()["mjx-study"] == version_of("mjx-study") != UNKNOWN
    assert version_of("numpy") == metadata.version("numpy")
    with pytest.raises(metadata.PackageNotFoundError):
        version_of("mjx-study-of-nobody")


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


def test_commands_run_where_nothing_is_installed(tmp_path: Path) -> None:
    for name in ("mjx_study", "estimators", "models"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    study = "compare pusher --contact reference --stiffness 10 --horizon 2 --samples 4 --reference-samples 4"
    study += " --estimators zobg"
    command = [sys.executable, "-P", "-c", WITHOUT, str(tmp_path), *study.split(), "--output", "out"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    versions = json.loads((tmp_path / "out" / "study.json").read_text())["environment"]["versions"]
    assert versions["mjx-study"] == UNKNOWN


ALLOCATES = """
import resource
from mjx_study.runtime import configure

configure(cpu_devices=1)
faults = []
for _ in range(3):
    block = bytearray(b"x") * (100 << 20)
    del block
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
print(faults[2] - faults[1])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="a setting of glibc's")
def test_memory_that_is_freed_and_needed_again_is_not_cleared_again() -> None:
    assert int(run_script(ALLOCATES).stdout) < 1000, "of 25,600 pages"
