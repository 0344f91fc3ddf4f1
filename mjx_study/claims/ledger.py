"""Verdicts from measurements, and measuring and storing a ledger of claims.

A verdict is determined by an interval. Each claim fixes beforehand the values of a statistic for which it holds, and
optionally those for which its opposite does. A measured interval within the first means holds; within the second,
reversed; outside the first, fails; across its border, undecided. All intervals of a ledger hold simultaneously: each
has level 1 - ALPHA / m, with m the number of verdicts of the whole ledger (Bonferroni), whichever are measured.
"""

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import jax.numpy as jnp
from scipy.stats import t as student

from estimators import coverage_interval
from mjx_study.claims.claim import Claim, Criterion, Range
from mjx_study.claims.laboratory import EFFORTS, Laboratory, Statistic
from mjx_study.disk import prepare_folder, write_whole
from mjx_study.identity import git_revision
from mjx_study.progress import Progress, silent
from mjx_study.runtime import environment
from mjx_study.simulation.law import installed
from mjx_study.table import as_plain

ALPHA: Final = 0.05  # probability that any interval of a ledger misses its value


def interval_of(statistic: Statistic, level: float) -> Range:
    """Interval of a statistic: Student's t plus the bound on deterministic error, or Wilson's for a share."""
    if statistic.trials:
        covered = jnp.arange(statistic.trials) < round(statistic.estimate * statistic.trials)
        return coverage_interval(covered, level)[1:]
    half = statistic.slack
    if statistic.error != 0:  # NaN, too: then it is unknown
        half += statistic.error * float(student.ppf(0.5 + level / 2, statistic.freedom))
    if not math.isfinite(statistic.estimate + half):
        return -math.inf, math.inf
    return statistic.estimate - half, statistic.estimate + half


def deciding_size(statistic: Statistic, criterion: Criterion, level: float) -> int | None:
    """Samples at which an undecided interval about the same estimate would decide; None if none would.

    Sampling errors fall with the square root of samples, quadrature errors with the points, which may straddle a jump.
    """
    low, high = interval_of(statistic, level)
    borders = [border for part in (criterion.holds, criterion.reversed or ()) for border in part if low < border < high]
    if not borders or not statistic.samples or not math.isfinite(high):
        return None
    border = min(borders, key=lambda border: abs(statistic.estimate - border))
    distance = abs(statistic.estimate - border)
    if statistic.error == 0 and not statistic.trials:
        return math.ceil(statistic.samples * statistic.slack / distance) if distance > 0 else None
    half = (statistic.estimate - low if border < statistic.estimate else high - statistic.estimate) - statistic.slack
    distance -= statistic.slack
    return math.ceil(statistic.samples * (half / distance) ** 2) if distance > 0 else None


def measure_ledger(
    claims: Sequence[Claim],
    effort: str,
    folder: Path | None = None,
    progress: Progress = silent,
    *,
    verdicts: int,
    command: str | None = None,
    accept_versions: bool = False,
) -> dict[str, Any]:
    """Measure claims, or reuse stored measurements made by the same code at the same effort; the ledger as plain data.

    Claims on contact laws other than MuJoCo's are left out, and their verdicts counted, without the extra `laws`.

    Args:
        effort: key in `EFFORTS`.
        folder: for measurements, one file per claim, and the studies behind them; None to store nothing.
        verdicts: number of verdicts in the whole ledger, which sets the level of the intervals.
        command: command line to record.
        accept_versions: reuse measurements and resume studies made by other code or versions.
    """
    chosen = EFFORTS[effort]
    if folder is not None:
        prepare_folder(folder / "parts")
    left_out = [claim for claim in claims if claim.of_laws and not installed()]
    claims = [claim for claim in claims if claim not in left_out]
    lab = Laboratory(chosen, None if folder is None else folder / "studies", accept_versions)
    total, done, found = sum(len(claim.cases) for claim in claims), 0, []
    for claim in claims:
        path = None if folder is None else folder / "parts" / f"{claim.id}.json"
        kept = json.loads(path.read_text()) if path is not None and path.exists() else {}
        ours = {"key": claim.key(chosen), "made_by": claim.made_by()}
        decisive = ("key",) if accept_versions else tuple(ours)
        if any(kept.get(name) != ours[name] for name in decisive):
            kept = {**ours, "revision": git_revision(), "cases": []}
        for system, family in claim.cases[len(kept["cases"]) :]:
            progress(done + len(kept["cases"]), total, f"{claim.id}: {system}, {family}")
            statistic = claim.measure(lab, system, family, **claim.options)
            kept["cases"].append({"system": system, "family": family, **dataclasses.asdict(statistic)})
            if path is not None:
                write_whole(path, lambda file, kept=kept: file.write(json.dumps(kept, indent=1).encode()))
        done += len(claim.cases)
        found.append(_with_evidence(claim, kept, 1 - ALPHA / verdicts))
    progress(total, total, "done")
    return {
        "effort": dataclasses.asdict(chosen),
        "alpha": ALPHA,
        "verdicts": verdicts,
        "level": 1 - ALPHA / verdicts,
        "command": command,
        "environment": environment(),
        "revisions": sorted({entry["revision"] or "unknown" for entry in found}),
        "not_checked": sum(len(claim.cases) for claim in left_out),
        "claims": found,
    }


def _with_evidence(claim: Claim, kept: dict[str, Any], level: float) -> dict[str, Any]:
    """Return a claim with its evidence as plain data; nonfinite numbers become None."""
    evidence = []
    for case in kept["cases"]:
        statistic = Statistic(**{field.name: case[field.name] for field in dataclasses.fields(Statistic)})
        interval = interval_of(statistic, level)
        verdict = claim.criterion.verdict(interval)
        size = deciding_size(statistic, claim.criterion, level) if verdict == "undecided" else None
        numbers = {"estimate": statistic.estimate, "lower": interval[0], "upper": interval[1]}
        found = {"verdict": verdict, "samples": statistic.samples, "of": statistic.of, "deciding": size}
        evidence.append(as_plain({"system": case["system"], "family": case["family"], **numbers, **found}))
    return {
        "id": claim.id,
        "place": claim.place,
        "statement": claim.statement,
        "quantity": claim.criterion.quantity,
        "criterion": claim.criterion.lines(),
        "show": claim.show,
        "revision": kept["revision"],
        "evidence": evidence,
    }
