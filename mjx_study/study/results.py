"""Results as plain data, and on disk."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from mjx_study.disk import write_whole
from mjx_study.study.comparison import CompareResult
from mjx_study.study.findings import findings


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


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
