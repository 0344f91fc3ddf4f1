"""Identity of what results depend on, by content: the compiled model, the task's parts, and the software.

Code of this package and of the libraries below it enters by version, everything else as in `digest`.
"""

import dataclasses
import functools
import hashlib
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from estimators import Estimator, find_estimator
from estimators.user_inputs import INSTALLED
from mjx_study.digest import Digest
from mjx_study.runtime import precision
from mjx_study.simulation.scene import models_folder
from mjx_study.sources import imports, source_file
from mjx_study.tasks.task import Task
from mjx_study.version import version_of

VERSIONED: Final = ("mjx-study", "mujoco", "mujoco-mjx", "jax", "jaxlib", "numpy", "optax")
"""Packages whose version may affect results."""
SOURCES: Final = (".py", ".c", ".cu")
"""Suffixes of files with code."""
NOT_COMPUTING: Final = frozenset(
    "authoring cli plots render gradcheck diagnose claims bench.py report.py _public.py __main__.py".split()
)
"""Parts of mjx_study that no study imports while it computes, and so do not affect results; all others count."""
DIGEST: Final = re.compile("[0-9a-f]{12,64}")  # digests, which messages do not show
ACCEPT: Final = "choose another folder, or accept the mixture by --accept-versions"
"""Advice at the end of messages about other versions."""


def versions() -> dict[str, str]:
    """Versions of the packages that compute, and a digest of this package's computing code."""
    return {name: version_of(name) for name in VERSIONED} | {"code of mjx-study": computing_code()}


def git_revision(root: Path | None = None) -> str | None:
    """Commit of a checkout, by default this package's; None outside one, before its first commit, or without git."""
    folder = (Path(__file__).resolve().parents[1] if root is None else root) / ".git"
    try:
        found = subprocess.run(["git", f"--git-dir={folder}", "rev-parse", "--verify", "HEAD"], capture_output=True)
    except OSError:
        return None
    return found.stdout.decode().strip() if found.returncode == 0 else None


def contents(tasks: Mapping[str, Iterable[Task]]) -> dict[str, str]:
    """Return the precision, and digests of everything that tasks consist of, all variants (timesteps, cones) of each
    together: "model of NAME", "task NAME", and of a user's task "source of FILE" for every source file and "global
    NAME of MODULE" for the data that its functions read."""
    found, parts = {"precision": precision()}, {}
    for name, forms in tasks.items():
        models, rest = Digest(), Digest()
        for task in forms:
            models.add(task.scene)
            for field in dataclasses.fields(task):
                if field.name not in ("scene", "description"):  # the latter does not affect results
                    rest.add((field.name, getattr(task, field.name)))
        found |= {f"model of {name}": models.hexdigest(), f"task {name}": rest.hexdigest()}
        parts |= rest.parts
    return found | dict(sorted(parts.items()))


def trace_contents(made_of: Any) -> Digest:
    """Digest everything a trace depends on except its arguments and JAX's settings.

    Installed packages enter by the names of their folders of metadata, which hold the versions.
    """
    digest = Digest((made_of, [version_of(name) for name in VERSIONED], computing_code()), exact=True)
    if digest.sources.foreign:
        digest.add((sorted(digest.parts.items()), installed_packages()))
    return digest


@functools.cache
def installed_packages() -> tuple[str, ...]:
    """Names and versions of all installed packages."""
    folders = [Path(entry) for entry in sys.path if set(INSTALLED) & set(Path(entry).parts)]
    return tuple(sorted(each.name for folder in folders for each in folder.glob("*.dist-info")))


def estimator_contents(chosen: Mapping[str, str | Estimator]) -> dict[str, str]:
    """Digests of those estimators, by name, that are given as objects or user-defined, and of their source files."""
    found: dict[str, str] = {}
    for name, each in chosen.items():
        digest = Digest(find_estimator(each))
        if digest.sources.digests or isinstance(each, Estimator):
            found[f"estimator {name}"] = digest.hexdigest()
            found |= digest.parts
    return found


def differences(theirs: Mapping[str, Any], ours: Mapping[str, Any]) -> str | None:
    """Describe the first three entries that differ in a message; None if none does.

    Digests that only one of the two has come last, since another entry gives the reason.
    """
    different = [name for name in dict(theirs) | dict(ours) if theirs.get(name) != ours.get(name)]
    digests = {name for name in different for each in (theirs, ours) if DIGEST.fullmatch(str(each.get(name)))}
    different.sort(key=lambda name: name in digests and (name not in theirs or name not in ours))
    described = []
    for name in different[:3]:
        there, here = ("none" if each.get(name) is None else each[name] for each in (theirs, ours))
        described.append(f"{name} differs" if name in digests else f"{name} {there} there and {here} here")
    described += [f"{len(different) - 3} more"] if len(different) > 3 else []
    return ", ".join(described) or None


@functools.cache
def computing_code(package: Path = Path(__file__).parent) -> str:
    """Digest of the source of `estimators` and of mjx_study, except `NOT_COMPUTING`."""
    files = [*package.rglob("*"), *(package.parent / "estimators").rglob("*")]
    sha = hashlib.sha256()
    for path in sorted(path for path in files if path.suffix in SOURCES):
        if path.relative_to(package.parent).parts[:2] not in {(package.name, part) for part in NOT_COMPUTING}:
            sha.update(str(path.relative_to(package.parent)).encode() + b"\0" + path.read_bytes())
    return sha.hexdigest()[:12]


@functools.cache
def code_of(module: str) -> str:
    """Digest the code behind a measurement: an imported module, what it imports from its package, and what computes."""
    package, found, waiting = module.rpartition(".")[0], {}, [module]
    while waiting:
        name = waiting.pop()
        path = source_file(name) if name.startswith(f"{package}.") else None
        if path is not None and name not in found:
            found[name] = path.read_bytes()
            waiting += imports(found[name], package)
    models = sorted(models_folder().rglob("*.xml"))
    text = repr((sorted(found.items()), [path.read_bytes() for path in models], computing_code()))
    return hashlib.sha256(text.encode()).hexdigest()[:16]
