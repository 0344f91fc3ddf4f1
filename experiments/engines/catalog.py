"""The engines, the pinned packages of their environments, and how each is differentiated."""

import dataclasses
import sys
from pathlib import Path
from typing import Final

from experiments import ROOT

HOME: Final = ROOT / "build" / "engines"  # environments, one folder each; in none of them is this project installed


@dataclasses.dataclass(frozen=True)
class Environment:
    """Packages of one environment.

    Attributes:
        packages: requirements of pip; empty for this project's own environment.
        python: versions of Python that the packages' wheels exist for, the first that is found is taken.
        large: what makes it larger than 2 GB, so that it is installed only by name.
    """

    packages: tuple[str, ...] = ()
    python: tuple[str, ...] = ("3.11", "3.12")
    large: str = ""


@dataclasses.dataclass(frozen=True)
class Engine:
    """A row of the matrix.

    Attributes:
        label: engine, version and variant, as readers know them.
        environment: name in `ENVIRONMENTS`.
        adapter: module in `adapters`, and variant.
        how: way of differentiation, as the engine's documentation has it.
        single: whether it computes in float32.
        slow: whether its cells have fewer rollouts, judge's `FEW`.
        left: why cells of it were not measured.
    """

    label: str
    environment: str
    adapter: str
    variant: str
    how: str
    single: bool = False
    slow: bool = False
    left: str = "not run"


CUDA: Final = "torch's wheels for Linux bring CUDA"
SLOW: Final = "not run, at 0.1 to 0.3 s per gradient"
ENVIRONMENTS: Final = {
    "own": Environment(),
    "brax": Environment(("brax==0.14.2", "mujoco-mjx==3.17.0", "mujoco==4.0.0", "jax==0.10.2")),
    "old_mjx": Environment(
        ("mujoco-mjx==3.1.6", "mujoco==3.1.6", "jax==0.4.30", "jaxlib==0.4.30", "numpy<2", "scipy<1.13")
    ),
    "newton_1_0": Environment(("newton==1.0.0", "warp-lang==1.12.0")),
    "newton": Environment(("newton==1.8.0", "warp-lang==1.19.0")),
    "jaxsim": Environment(("jaxsim==0.9.0", "jax==0.10.2", "jaxlib==0.10.2")),
    "nimble": Environment(("nimblephysics==0.10.52.1", "torch==2.14.1", "numpy<2"), ("3.10",), large=CUDA),
    "drake": Environment(("drake==1.58.0",), ("3.12",)),
    "mujoco_torch": Environment(
        ("mujoco-torch==0.2.0", "mujoco==3.5.0", "torch==2.14.1", "tensordict==0.15.3", "numpy<2"),
        ("3.12", "3.11"),
        large=CUDA,
    ),
}
ENGINES: Final = {
    "mjx": Engine("MJX 3.17.0", "own", "mujoco_family", "forward", "forward mode, default solver"),
    "mjx_reverse": Engine("MJX 3.17.0, iterations=1", "own", "mujoco_family", "reverse", "reverse mode"),
    "mjx_study": Engine("mjx_study.step", "own", "mujoco_family", "plain", "reverse mode"),
    "mjx_study_onset": Engine('mjx_study.step, onset="linear"', "own", "mujoco_family", "onset", "reverse mode"),
    **{
        f"mujodico_{law}": Engine(f"mujodico 3.17.0, {law}", "own", "mujoco_family", law, "forward mode")
        for law in ("hunt_crossley", "kelvin_voigt", "log_barrier", "conic")
    },
    **{
        f"brax_{name}": Engine(f"brax 0.14.2, {name}", "brax", "brax_pipelines", name, "reverse mode")
        for name in ("spring", "positional")
    },
    **{
        f"brax_{name}": Engine(f"brax 0.14.2, {label}", "brax", "brax_pipelines", name, f"{mode}, 1e-6 rad/s of spin")
        for name, label, mode in (
            ("generalized", "generalized", "either mode"),
            ("generalized_short", "generalized, short solver steps", "forward mode"),
            ("generalized_exact", "generalized, exact forces", "forward mode"),
        )
    },
    "newton_semi_implicit": Engine(
        "Newton 1.8.0, semi_implicit", "newton", "newton_warp", "semi_implicit", "Warp's tape", single=True
    ),
    "newton_1_0": Engine("Newton 1.0.0, semi_implicit", "newton_1_0", "newton_warp", "old", "Warp's tape", single=True),
    "jaxsim": Engine("JaxSim 0.9.0, soft", "jaxsim", "jaxsim_soft", "SemiImplicitEuler", "reverse mode"),
    "drake_sap": Engine("Drake 1.58.0, sap", "drake", "drake_plant", "sap", "AutoDiffXd"),
    "nimble": Engine("Nimble 0.10.52", "nimble", "nimble_physics", "lcp", "torch's tape"),
    **{
        f"mujoco_torch_{name}": Engine(
            f"mujoco-torch 0.2.0, {name}", "mujoco_torch", "mujoco_torch_tape", name, how, slow=True, left=SLOW
        )
        for name, how in (("plain", "torch's tape"), ("soft", "torch's tape, differentiable_mode"))
    },
    "old_mjx": Engine("MJX 3.1.6", "old_mjx", "mujoco_family", "forward", "forward mode"),
}


def interpreter(engine: Engine) -> Path:
    """Return where the Python of an engine's environment is, if it is installed."""
    return Path(sys.executable) if engine.environment == "own" else HOME / engine.environment / "bin" / "python"
