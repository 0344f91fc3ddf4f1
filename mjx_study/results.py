"""Results on disk: one folder, written file by file, each either complete or absent."""

import dataclasses
import json
import math
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np

from mjx_study.comparison import CompareResult
from mjx_study.findings import findings


def prepare_folder(folder: str | Path) -> Path:
    """Make sure that results can be written to a folder, before anything is computed.

    Raises:
        ValueError: it cannot be created or written to, or is a file.
    """
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise ValueError(f"cannot write to the output folder {path}: {error.strerror or error}") from error
    return path


def as_json(result: CompareResult) -> dict[str, Any]:
    """A comparison as plain data; numbers that are not finite become null, an infinite gamma "inf"."""
    document = {
        "config": dataclasses.asdict(result.config),
        "environment": result.environment,
        "findings": findings(result),
        "warnings": list(result.warnings),
        "rows": [dataclasses.asdict(row) | {"bias_verdict": row.bias_verdict} for row in result.rows],
    }
    return as_plain(document)


def as_plain(document: dict[str, Any]) -> dict[str, Any]:
    """A document that JSON can hold: numbers that are not finite become null, an infinite gamma "inf"."""
    config = document.get("config")
    if config is not None and config.get("gamma") == math.inf:
        document = document | {"config": config | {"gamma": "inf"}}
    return _finite(document)


def save(result: CompareResult, folder: Path) -> list[Path]:
    """Write `results.json` and `gradients.npz` (mean and reference gradient of each row); returns their paths."""
    text = json.dumps(as_json(result), indent=1, allow_nan=False) + "\n"
    arrays = {"gradient": result.gradients, "reference": result.references}
    return [
        write_whole(folder / "results.json", lambda file: file.write(text.encode())),
        write_whole(folder / "gradients.npz", lambda file: np.savez_compressed(file, **arrays)),  # type: ignore[arg-type]
    ]


def write_whole(path: Path, write: Callable[[IO[bytes]], Any]) -> Path:
    """Write a file beside its place and move it there, so that it is never half there, after a loss of power either."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise
    return path


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
