"""Tables of docs/which-contact.md, from data/laws.jsonl and data/laws_checks.jsonl alone."""

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy import stats

from experiments import DATA, read_lines
from mjx_study.choices import TASK_DESCRIPTIONS
from mjx_study.simulation.law import LAWS as OTHERS
from mjx_study.table import markdown_table

CELLS, CHECKS = DATA / "laws.jsonl", DATA / "laws_checks.jsonl"
LAWS: Final = {
    "MuJoCo's default": ("mujoco_default", "none"),
    "with the onset term": ("mujoco_default", "linear"),
    **{name: (name, "none") for name in ("smooth_onset", "penalty", *OTHERS)},
}
"""Contact family and onset term by the name of a row."""
MEANS: Final = ("throw", "ball_wall", "skid", "corners", "box", "pusher", "tennis", "landing")
BODIES: Final = ("roll", "stack", "stacked_corners", "quadruped standing", "quadruped landing")
KAPPAS: Final = ("throw, kappa 0.1", "throw", "throw, kappa 10")
TOSSES: Final = tuple(
    (f"toss {step} ms", row)
    for row in ("MuJoCo's default", "with the onset term", *OTHERS)
    for step in (("5", "2", "0.5") if row not in OTHERS else ("5", "2"))
)
"""Scene and row of the lines of the table `toss`."""
RIGID: Final = "rigid"  # in place of a law: the C engine's limit of stiff contact and short steps
ZEROTH: Final = "MuJoCo's default, zeroth order"
LONGER: Final = {
    "the same, 5 x the iterations": (*LAWS["MuJoCo's default"], "zobg", 5),
    "kelvin_voigt, 5 x the iterations": (*LAWS["kelvin_voigt"], "fobg", 5),
}
"""Contact family, onset term and estimator of descents with more iterations."""
CORNER: Final[dict[str, dict[str, float]]] = {
    "the task": {},
    **{f"friction {each:g}": {"friction": each} for each in (2.0, 1.0, 0.5)},
    **{f"steps of {1e3 * each:g} ms": {"timestep": each} for each in (1e-3, 5e-4)},
    **{f"kappa x {each:g}": {"scale": each} for each in (0.1, 10.0)},
}
"""Changes of `ball_wall` and of Kelvin-Voigt on it."""
AFLOAT: Final[dict[str, tuple[str, float | None]]] = {
    **{f"log_barrier, {each:g} J": ("log_barrier", each) for each in (1e-3, 1e-4, 1e-5)},
    "conic": ("conic", None),
}
"""Laws on `sliding_box`, by kappa."""
PYRAMIDAL: Final = {
    *itertools.product(("sliding_box", "ball_wall", "ball_wall:dome", "gripper", "landing"), ("log_barrier", "conic"))
}
"""Tasks and laws that need pyramidal cones."""
CHECKED: Final = tuple(name for name in TASK_DESCRIPTIONS if not name.endswith(":published"))


def measured(*others: Path) -> dict[tuple[str, str], dict[str, Any]]:
    """The numbers of both files, and of others, by scene and row."""
    every = itertools.chain.from_iterable(map(read_lines, (CELLS, CHECKS, *others)))
    return {(each.pop("scene"), each.pop("row")): each for each in every}


def tables() -> dict[str, str]:
    """The tables of the page; a dash where nothing was measured."""
    found = measured()

    def cell(scene: str, row: str, say: Callable[[dict[str, Any]], str]) -> str:
        numbers = found.get((scene, row), {})
        return "refused" if "refused" in numbers else say(numbers) if numbers else "-"

    def bias(of: dict[str, Any]) -> str:
        error = 100 * (of["first_error"] + of["slope_error"]) / abs(of["slope"])
        shown = f"{100 * (of['first'] / of['slope'] - 1):.1f}".replace("-0.0", "0.0")
        return f"{shown} %" if error < 0.05 else f"{shown} ± {float(f'{error:.1g}'):g} %"

    def deviation(of: dict[str, Any]) -> str:
        return f"{of['first_sd'] / of['zeroth_sd']:.2g}"

    def share(row: str) -> str:
        return cell("throw", row, lambda of: f"{1e3 * of['seconds']:.2g}")

    def interval(costs: list[float], scale: float) -> str:
        half = stats.t.ppf(0.975, len(costs) - 1) * np.std(costs, ddof=1) / len(costs) ** 0.5
        return f"{scale * np.mean(costs):.4g} ± {scale * half:.1g}"

    means = [[row, *(cell(scene, row, bias) for scene in MEANS), share(row)] for row in LAWS]
    more = [[row, *(cell(scene, row, bias) for scene in BODIES)] for row in LAWS]
    spreads = [[row, *(cell(scene, row, deviation) for scene in MEANS)] for row in LAWS]
    says: dict[str, Callable[[dict[str, Any]], str]] = {
        "depth at rest [mm]": lambda of: f"{1e3 * of['penetration']:.2g}",
        "creep [mm/s]": lambda of: "slides" if of["creep_gain"] > 0.1 else f"{1e3 * of['creep']:.2g}",
        "restitution": lambda of: f"{abs(of['restitution']):.2f}",
        "way [mm]": lambda of: "slides" if of["rest"] > 0.1 else f"{1e3 * of['way']:.1f}",
        "stable below [ms]": lambda of: "> 80" if of["first_bad_step"] > 1 else f"{1e3 * of['first_bad_step']:.0f}",
    }
    stands: dict[str, Callable[[dict[str, Any]], str]] = {
        "rolls at [m/s]": lambda of: f"{of['rolling']:.3f}",
        "slows in 0.5 s by": lambda of: f"{of['rolling_loss']:.2g}",
        "lower sinks [mm]": lambda of: f"{1e3 * of['lower']:.2g}",
        "upper [mm]": lambda of: f"{1e3 * of['upper']:.2g}",
        "stands at [mm]": lambda of: f"{1e3 * of['stands_at']:.1f}",
        "drifts [mm/s]": lambda of: f"{1e3 * of['drift']:.2g}",
        "lands down to [mm]": lambda of: f"{1e3 * of['lowest']:.1f}",
        "and goes [mm]": lambda of: f"{1e3 * of['way']:.0f}",
    }
    tossed: dict[str, Callable[[dict[str, Any]], str]] = {
        "slope": lambda of: f"{of['slope']:.4f}",
        "E[FoBG]": lambda of: f"{of['first']:.4f}",
        "deviation": lambda of: f"{of['first_sd']:.2g}",
    }
    tosses = [[row, scene.split()[1], *(cell(scene, row, say) for say in tossed.values())] for scene, row in TOSSES]
    usual = found["throw", "MuJoCo's default"]["seconds"]
    first: dict[tuple[str, str], Callable[[dict[str, Any]], str]] = {
        ("throw", "a ball lands"): bias,
        ("box", "a box"): bias,
        ("quadruped landing", "a quadruped"): bias,
        ("throw", "deviation"): deviation,
        ("throw", "time"): lambda of: f"{of['seconds'] / usual:.1f}",
    }
    summary = [[row, *(cell(scene, row, say) for (scene, _), say in first.items())] for row in LAWS]
    plain = [row for row, (_, onset) in LAWS.items() if onset == "none"]
    fidelity = [[row, *(cell("faithful", row, say) for say in says.values())] for row in plain]
    motion = [[row, *(cell("faithful bodies", row, say) for say in stands.values())] for row in (*plain, RIGID)]
    descents = [
        [row]
        + [
            cell(f"train {name}", row, lambda of, key=key, scale=scale: interval(of[key], scale))
            for name, scale in (("pusher", 1.0), ("ball_wall", 1e3))
            for key in ("own", "engine")
        ]
        + [cell("train pusher", row, lambda of: f"{of['seconds']:.0f}")]
        for row in (*LAWS, ZEROTH, *LONGER)
    ]
    kappas = [
        [row, *(cell(scene, row, lambda of: f"{of['first_sd'] / of['zeroth_sd']:.3g}") for scene in KAPPAS)]
        for row in OTHERS
    ]

    def verdict(of: dict[str, Any]) -> str:
        errors = (of[name] for name in ("of_cost", "of_step", "of_parameters") if of[name] is not None)
        kinds = {kind: f", {kind}s" for kind in ("kink", "jump") if kind in of["verdicts"]}
        return "wrong" if of["failing"] else f"right{''.join(kinds.values())} ({max(errors):.0e})"

    def off(of: dict[str, Any]) -> str:
        said = {"biased": "biased, ", "none seen": ""}.get(of["verdict"], "? ")
        error, uncertainty = (f"{float(f'{100 * of[name]:.2g}'):g}" for name in ("error", "uncertainty"))
        return f"{said}{error} ({uncertainty}) %"

    def of_tasks(kind: str, say: Callable[[dict[str, Any]], str]) -> list[list[str]]:
        def of_task(name: str, law: str) -> str:
            marked = lambda of: f"{say(of)} *"  # noqa: E731
            turned = (name, law) in PYRAMIDAL
            return cell(f"{kind} {name}{' pyramidal' * turned}", law, marked if turned else say)

        return [[f"`{name}`", *(of_task(name, law) for law in OTHERS)] for name in CHECKED]

    # One row for each reason: by the laws that give it and the tasks of which they do
    lacking: dict[str, tuple[dict[str, None], dict[str, None]]] = {}
    for (scene, law), numbers in found.items():
        kind, _, name = scene.removesuffix(" pyramidal").partition(" ")
        if "refused" in numbers and kind in ("gradcheck", "compare"):
            reason = numbers["refused"].removeprefix(f"{law} does not support ").removeprefix(f"{name} ")
            laws, tasks = lacking.setdefault(reason, ({}, {}))
            laws[law], tasks[f"`{name}`"] = None, None
    refusals = [[", ".join(tasks), ", ".join(laws), reason] for reason, (laws, tasks) in lacking.items()]
    shares: dict[str, Callable[[dict[str, Any]], str]] = {
        "share of the slope": lambda of: f"{100 * of['share']:.1f} %",
        "of it in 1e-6 rad": lambda of: f"{100 * of['narrow']:.2g} %",
    }
    corners = [[row, *(cell("corner", row, say) for say in shares.values())] for row in CORNER]
    lifted: dict[str, Callable[[dict[str, Any]], str]] = {
        "floats at [mm]": lambda of: f"{1e3 * of['height']:.2g}",
        "ends above the box": lambda of: f"{100 * of['aboard']:.0f} %",
        "norm of E[FoBG]": lambda of: f"{of['norm']:.0f}",
        "variance over zeroth order's": lambda of: f"{of['variances']:.1g}",
        "distance from the reference": off,
    }
    afloat = [[row, *(cell("afloat", row, say) for say in lifted.values())] for row in AFLOAT]
    ways = "pusher: own", "in C", "ball_wall: own [1e-3]", "in C [1e-3]", "pusher [s]"
    rows = {
        "summary": (("law", *(name for _, name in first)), summary),
        "means": (("law", *MEANS, "ms per gradient"), means),
        "motion": (("law", *stands), motion),
        "toss": (("law", "step [ms]", *tossed), tosses),
        "bodies": (("law", *BODIES), more),
        "deviations": (("law", *MEANS), spreads),
        "fidelity": (("law", *says), fidelity),
        "descents": (("law", *ways), descents),
        "smoothing": (("law", "kappa / 10", "kappa", "10 kappa"), kappas),
    }
    rows |= {
        "gradcheck": (("task", *OTHERS), of_tasks("gradcheck", verdict)),
        "compare": (("task", *OTHERS), of_tasks("compare", off)),
        "refusals": (("tasks", "laws", "what is lacking"), refusals),
        "afloat": (("law", *lifted), afloat),
        "corner": (("`ball_wall`", *shares), corners),
    }
    return {name: markdown_table(lines, header) for name, (header, lines) in rows.items()}
