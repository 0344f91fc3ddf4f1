"""Documents of studies whose cells hold whatever a test writes into them."""

import re
from typing import Any


def study_document(cells: int, **changes: Any) -> dict[str, Any]:
    """What a study.json holds, of as many cells along the contact models; `changes` go into its configuration."""
    config: dict[str, Any] = {"kind": "gradients", "tasks": ["test"], "estimators": ["zobg"], "seeds": 1}
    axes: dict[str, list[Any]] = {"task": ["test"], "timestep": [0.1], "cone": ["pyramidal"]}
    axes |= {"model": [f"model {index}" for index in range(cells)], "sigma": [0.1], "samples": [4]}
    places = [dict.fromkeys(axes, 0) | {"model": index} for index in range(cells)]
    return {
        "config": config | {"iterations": None} | changes,
        "contents": {},
        "versions": {},
        "warnings": [],
        "environment": {"versions": {}},
        "models": [{"contact": "model", "stiffness": float(index)} for index in range(cells)],
        "axes": axes,
        "resolved": [{"horizon": [1], "noise": "gaussian", "estimators": {}}],
        "cells": [{"label": str(index), "at": at} for index, at in enumerate(places)],
    }


def stages_of(told: str) -> list[str]:
    """The stages that a command tells on standard error where that is no terminal, without their times."""
    lines = told.splitlines()
    assert all(re.match(r" *\d+\.\d s  \[", line) for line in lines), told
    return [line.partition(" s  ")[2] for line in lines]
