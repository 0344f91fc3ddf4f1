"""The git revision of the checkout that the package runs from."""

import subprocess
from pathlib import Path


def git_revision(root: Path | None = None) -> str | None:
    """Commit of a checkout, by default this package's; None outside one, before its first commit, or without git."""
    folder = (Path(__file__).resolve().parents[2] if root is None else root) / ".git"
    try:
        found = subprocess.run(["git", f"--git-dir={folder}", "rev-parse", "--verify", "HEAD"], capture_output=True)
    except OSError:
        return None
    return found.stdout.decode().strip() if found.returncode == 0 else None
