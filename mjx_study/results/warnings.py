"""Warnings about a study: missing and failed cells, other versions, lost samples, and numbers that do not hold."""

import json
from typing import Final

import numpy as np
import xarray as xr

from estimators import ENOUGH_EFFECTIVE
from mjx_study.results.rows import label_in, model_name

MOST_NAMED: Final = 3  # maximum number of contact models that a warning names
EXPLODED: Final = 1e30
"""Size of a gradient, variance or cost that no stable step reaches."""
SIZES: Final = ("gradient_norm", "variance", "cost", "final_cost")


def lost_samples(dataset: xr.Dataset) -> list[str]:
    """Warnings about samples left out, by contact model and estimator, and about contact models whose step explodes."""
    counts, messages = dataset.get("nonfinite"), []
    if counts is not None and (by_model := _per_model(counts, "sum")).max() > 0:
        estimators = counts.sum([name for name in counts.dims if name not in ("model", "estimator")])
        labels = [label_in(dataset, name) for name in dataset["estimator"].values.tolist()]
        told = []
        for index in np.argsort(-by_model, kind="stable")[: min(MOST_NAMED, np.count_nonzero(by_model))].tolist():
            each = estimators.isel(model=index).values.astype(int).tolist()
            shares = ", ".join(f"{label} {count}" for label, count in zip(labels, each, strict=True) if count)
            told.append(f"{model_name(dataset.isel(model=index))} ({shares})")
        more = np.count_nonzero(by_model) - len(told)
        told += [f"{more} more contact models"] if more else []
        messages.append(
            f"{total(counts)} samples overflowed or became NaN and were left out, so that the rest are not random: "
            f"{'; '.join(told)}"
        )
    largest = np.max([_per_model(dataset[name], "max") for name in SIZES if name in dataset], axis=0, initial=0.0)
    for index in np.flatnonzero(largest > EXPLODED)[:MOST_NAMED].tolist():
        name = model_name(dataset.isel(model=index))
        messages.append(
            f"{name}: the motion explodes (numbers up to {largest[index]:.0e}), as where the step in "
            "contact is unstable; use a smaller --timestep, or softer contact"
        )
    return messages


def total(counts: xr.DataArray) -> int:
    """Total count; where estimators share rollouts, the largest over estimators."""
    shared = "estimator" in counts.dims and not {"seed", "point"} & set(counts.dims)
    return int(counts.max("estimator").sum() if shared else counts.sum())


def _per_model(values: xr.DataArray, how: str) -> np.ndarray:
    """Sum or maximum of finite values for each contact model."""
    finite = values.where(np.isfinite(values))
    return getattr(finite, how)([name for name in values.dims if name != "model"]).fillna(0).values


def warnings_of(dataset: xr.Dataset) -> tuple[str, ...]:
    """Return the warnings of a study's plan and those about its numbers."""
    found = json.loads(dataset.attrs.get("warnings", "[]"))
    if dataset.attrs["missing_cells"]:
        found.append(f"{dataset.attrs['missing_cells']} cells are not computed yet; the same command resumes")
    failed = json.loads(dataset.attrs.get("failed_cells", "{}"))
    found += [f"{label}: failed, {reason}; the same command tries again" for label, reason in failed.items()]
    if dataset.attrs.get("mixed_versions"):
        found.append(f"cells were computed with different versions: {dataset.attrs['mixed_versions']}")
    if told := dataset.attrs.get("other_versions"):
        found.append(f"these numbers were computed with other versions ({told}); use another folder to recompute them")
    counted = {
        "unconverged": "rollouts in which the contact solver did not converge",
        "onsets_missed": "events of contact have no term and are left to plain first order: they chatter, or their "
        "rollouts have too many",
        "onsets_replaced": "contact points of corners or edges appear or vanish in penetration and have no term: "
        "means with the onset term may be off",
        "onsets_bounded": "onsets and ends of contact are grazing, and their terms are bounded",
    }
    counts = {name: total(dataset[name]) for name in counted if name in dataset}
    found += lost_samples(dataset)
    among = f" ({total(dataset['onsets'])} onsets in all)" if "onsets" in dataset else ""
    of_onsets = ("onsets_missed", "onsets_replaced")
    found += [f"{count} {counted[name]}{among * (name in of_onsets)}" for name, count in counts.items() if count]
    if "effective_samples" in dataset and (few := int((dataset["effective_samples"] < ENOUGH_EFFECTIVE).sum())):
        found.append(
            f"fewer than {ENOUGH_EFFECTIVE:g} effective samples in batches: {few}; do not trust their errors, "
            "p-values and variances (marked ? in the table of compare, effective_samples in the data)"
        )
    if "stopped_at" in dataset and (stopped := int(dataset["stopped_at"].notnull().sum())):
        found.append(f"{stopped} descents stopped before their last iteration")
    return tuple(found)
