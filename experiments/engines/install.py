"""Make the environments of the engines, of pinned packages, in build/engines: those named, or all below 2 GB.

python -m experiments.engines.install [ENVIRONMENT ...]
"""

import shutil
import subprocess
import sys
from pathlib import Path

from experiments.engines.catalog import ENVIRONMENTS, HOME


def find_python(version: str) -> str | None:
    """Return a Python of a minor version that runs: of the path, or of pyenv, whose shims may be of none."""
    kept = sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python"))
    for path in (shutil.which(f"python{version}"), *map(str, reversed(kept))):
        if path and subprocess.run([path, "-c", ""], capture_output=True, check=False).returncode == 0:
            return path
    return None


def install(name: str) -> bool:
    """Make one environment, and return whether that succeeded; one that exists is brought to its pins."""
    environment, folder = ENVIRONMENTS[name], HOME / name
    python = next((path for version in environment.python if (path := find_python(version))), None)
    if python is None:
        print(f"{name}: needs Python {' or '.join(environment.python)}")
        return False
    if not (folder / "bin" / "pip").exists():
        subprocess.run([python, "-m", "venv", folder], check=True)
    pip = [folder / "bin" / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    done = subprocess.run([*pip, *environment.packages], check=False).returncode == 0
    print(f"{name}: {'installed' if done else 'FAILED'}", flush=True)
    return done


def usual() -> list[str]:
    """Return the environments that need packages and are not large, and say which are."""
    for name, each in ENVIRONMENTS.items():
        if each.large:
            print(f"{name}: left out, more than 2 GB ({each.large}): python -m experiments.engines.install {name}")
    return [name for name, each in ENVIRONMENTS.items() if each.packages and not each.large]


def main() -> None:
    """Run the command line."""
    sys.exit(not all([install(name) for name in sys.argv[1:] or usual()]))


if __name__ == "__main__":
    main()
