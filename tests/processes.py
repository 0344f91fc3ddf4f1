"""Scripts that tests run in processes of their own."""

import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


def run_script(code: str, *arguments: Any, **settings: Any) -> subprocess.CompletedProcess[str]:
    """Run Python code, which must succeed, in the repository's folder unless the settings name another."""
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, **({"capture_output": True, "text": True, "cwd": ROOT} | settings))
    assert done.returncode == 0, done.stderr
    return done
