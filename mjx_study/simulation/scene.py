"""A scene: an MJCF compiled by MuJoCo and put on the device for MJX."""

import copy
import dataclasses
import math
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, Final

import jax
import mujoco
import numpy as np

from estimators.choices import suggestion
from mjx_study.choices import CONES, INTEGRATORS, SOLVERS, unknown
from mjx_study.graph.native import native_identity
from mjx_study.limits import MOST_GIB
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.contact_pair import frictionless_pair, geom_label
from mjx_study.simulation.limitations import FLAGS, ignored, lacking
from mjx_study.simulation.linear_algebra import MOST_UNROLLED
from mjx_study.simulation.mjcf_compile import compile_file
from mjx_study.simulation.mjcf_files import RefusedFileError

_ENUMERATED: Final = {
    "cone": {name: mujoco.mjtCone.__members__[f"mjCONE_{name.upper()}"] for name in CONES},
    "solver": {name: mujoco.mjtSolver.__members__[f"mjSOL_{name.upper()}"] for name in SOLVERS},
    "integrator": {name: mujoco.mjtIntegrator.__members__[f"mjINT_{name.upper()}"] for name in INTEGRATORS},
}
Number = float | int | np.integer | np.floating
SceneOption = str | Number | Sequence[str]
ADJOINTS: Final = ("auto", "graph", "tape")
"""Ways to differentiate steps (see `Scene.adjoint`)."""
_POSITIVE: Final = ("timestep", "iterations", "ls_iterations", "tolerance")


class SceneError(ValueError):
    """An MJCF that cannot be found or compiled, or that MJX cannot run."""


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """A compiled model on the host and on the device, with an empty `mjx.Data` as template for steps.

    Options that are static in MJX (cone, solver, integrator, iteration budgets) are fixed; contact parameters are array
    leaves of `model` and can be swept without recompiling (see `mjx_study.simulation.contact`).

    Attributes:
        name: name in messages.
        host: compiled model on the host.
        model: the same model for MJX.
        template: empty `mjx.Data`.
        adjoint: how steps are differentiated; the derivatives agree to rounding.

            - "graph": as graphs of scalar operations (`mjx_study.graph`); a step that is none, or too large a one, by
              its matrix, in forward mode, or with RK4 by the tape.
            - "tape": automatic differentiation of MJX's own operations around the implicit solve; reverse mode computes
              each step again (fault 13 in `docs/gradient-faults.md`).
            - "auto": graphs in native code, and up to `MOST_UNROLLED` degrees of freedom; else the tape.

            Derivatives with respect to the model use the tape, but for contact laws other than MuJoCo's.

    Raises:
        SceneError: unknown adjoint.
    """

    name: str
    host: mujoco.MjModel = dataclasses.field(repr=False)
    model: mjx.Model = dataclasses.field(repr=False)
    template: mjx.Data = dataclasses.field(repr=False)
    adjoint: str = "auto"

    def __post_init__(self) -> None:
        if self.adjoint not in ADJOINTS:
            raise SceneError(unknown("adjoint", self.adjoint, ADJOINTS))

    @property
    def uses_graph(self) -> bool:
        """Whether steps are differentiated as graphs rather than by the tape."""
        return self.forms_matrix or (self.adjoint == "auto" and native_identity() is not None)

    @property
    def forms_matrix(self) -> bool:
        """Whether steps that are no graph are differentiated by their matrix rather than by the tape."""
        small = self.host.nv <= MOST_UNROLLED
        return self.adjoint == "graph" or (self.adjoint == "auto" and small)

    @property
    def timestep(self) -> float:
        """Timestep h [s]."""
        return float(self.host.opt.timestep)

    @property
    def has_constraints(self) -> bool:
        """Whether MJX allocates any constraint rows (contact, limit, equality or friction loss)."""
        return num_constraint_rows(self.template) > 0

    def geom(self, name: str) -> int:
        """Index of a geom by name. Raises SceneError, listing the choices, for an unknown name."""
        return self._index(mujoco.mjtObj.mjOBJ_GEOM, "geom", name, self.host.ngeom)

    def joint(self, name: str) -> int:
        """Index of a joint by name. Raises SceneError, listing the choices, for an unknown name."""
        return self._index(mujoco.mjtObj.mjOBJ_JOINT, "joint", name, self.host.njnt)

    def body(self, name: str) -> int:
        """Index of a body by name. Raises SceneError, listing the choices, for an unknown name."""
        return self._index(mujoco.mjtObj.mjOBJ_BODY, "body", name, self.host.nbody)

    def site(self, name: str) -> int:
        """Index of a site by name. Raises SceneError, listing the choices, for an unknown name."""
        return self._index(mujoco.mjtObj.mjOBJ_SITE, "site", name, self.host.nsite)

    def sensor(self, name: str) -> slice:
        """Place of a sensor's output in sensordata, by name. Raises SceneError, listing the choices, for an unknown
        name."""
        index = self._index(mujoco.mjtObj.mjOBJ_SENSOR, "sensor", name, self.host.nsensor)
        first = int(self.host.sensor_adr[index])
        return slice(first, first + int(self.host.sensor_dim[index]))

    def _index(self, kind: mujoco.mjtObj, noun: str, name: str, count: int) -> int:
        index = mujoco.mj_name2id(self.host, kind, name)
        if index < 0:
            names = [str(mujoco.mj_id2name(self.host, kind, i)) for i in range(count)]
            more = suggestion(name, names) or f"; it has {', '.join(names) or 'none'}"
            raise SceneError(f"{self.name} has no {noun} {name!r}{more}")
        return index


def num_constraint_rows(data: mjx.Data) -> int:
    """Number of constraint rows that MJX allocates, active or not; static."""
    rows: Any = data._impl
    return rows.efc_J.shape[0]


def models_folder() -> Path:
    """Folder of the shipped MJCF files (next to the package in a checkout)."""
    package = Path(str(resources.files("mjx_study")))
    packaged = package / "models"
    return packaged if packaged.is_dir() else package.parent / "models"


def model_names() -> list[str]:
    return sorted(path.stem for path in models_folder().glob("*.xml"))


def load_scene(source: str | Path, *, adjoint: SceneOption = "auto", **options: SceneOption) -> Scene:
    """Compile an MJCF and put it on the device; see `load_model` for the arguments and `Scene` for `adjoint`.

    Raises:
        SceneError: as for `load_model` and `Scene`, or MJX cannot run the model; the message says why.
    """
    return put_scene(load_model(source, **options), Path(source).stem, adjoint=adjoint)


def load_model(source: str | Path, **options: SceneOption) -> mujoco.MjModel:
    """Compile an MJCF.

    Args:
        source: name of a shipped model (`"pusher"`) or path of an MJCF file.
        **options: overrides of the file's options: `cone` (pyramidal, elliptic), `solver` (newton, cg), `integrator`
            (euler, implicitfast, rk4), `timestep` [s], `iterations`, `ls_iterations`, `tolerance`; and `disable_flags`,
            MJCF flags to disable, as a sequence or comma-separated.

    Raises:
        SceneError: the file is missing or invalid, or an option is unknown or out of range.
    """
    path = _find(source)
    try:
        own = path.parent == models_folder()
        host = mujoco.MjModel.from_xml_path(str(path)) if own else compile_file(path)
    except RefusedFileError as error:
        raise SceneError(str(error)) from error
    except (ValueError, RuntimeError, OSError, mujoco.FatalError) as error:
        raise SceneError(f"{path} is not a valid MJCF: {' '.join(str(error).split())}") from error
    if field := not_finite_field(host):
        raise SceneError(
            f"{path}: {field} of the compiled model is not finite; a size, mass or position is too large, or a file "
            "that it refers to holds numbers that are not finite"
        )
    _set_options(host, options)
    if not 0 < host.opt.timestep < math.inf:
        raise SceneError(f"{path}: the timestep must be positive and finite, got {host.opt.timestep:g}")
    return host


def not_finite_field(host: mujoco.MjModel) -> str | None:
    """Name and row of the first entry of a compiled model that is not finite; None if there is none."""
    for name in dir(host):
        values = None if name.startswith("_") else getattr(host, name)
        if isinstance(values, np.ndarray) and values.dtype.kind == "f" and not np.isfinite(values).all():
            return f"{name}[{np.argwhere(~np.isfinite(values))[0][0]}]"
    return None


def put_scene(host: mujoco.MjModel, name: str, *, adjoint: SceneOption = "auto", **options: SceneOption) -> Scene:
    """Put a compiled model on the device, or a copy with `options` (see `load_model`). `adjoint`: see `Scene`.

    Raises:
        SceneError: MJX cannot run the model or would ignore part of it, or an option is unknown or out of range.
    """
    if options or not FLAGS["energy"].disabled(host.opt):
        host = copy.copy(host)
        _set_options(host, options)
        FLAGS["energy"].disable(host.opt)  # MJX rejects it, and it does not affect the motion
    check_model(host, name)
    check_rows(host, name)
    try:
        model = mjx.put_model(host)
        template = mjx.make_data(host)
    except (NotImplementedError, ValueError, AssertionError, MemoryError) as error:
        reason = str(error) or type(error).__name__
        raise SceneError(f"MJX cannot run {name}: {reason}") from error
    # `make_data` on a shared host gives weakly typed leaves; fix their types so that loops can carry them.
    template = jax.tree.map(lambda leaf: leaf if isinstance(leaf, np.ndarray) else jax.numpy.asarray(leaf), template)
    scene = Scene(name, host, model, template, str(adjoint))
    if host.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 and scene.has_constraints:
        raise SceneError(
            f"{name} combines RK4 with contacts, limits, equalities or friction loss: RK4's stages would solve the "
            "constraints four times per step without an order to gain; set integrator to euler or implicitfast "
            "in its <option>, which alone counts for init, or give --integrator euler"
        )
    return scene


def check_rows(host: mujoco.MjModel, name: str) -> None:
    """Reject a model for whose constraint rows MJX would need more than `MOST_GIB`: it reserves at least one contact
    of four rows, each of nv numbers, for every pair of geoms that may touch.

    Raises:
        SceneError: there are too many; the message says how many.
    """
    masks = np.stack([host.geom_contype, host.geom_conaffinity], axis=1)
    kinds, counts = np.unique(masks, axis=0, return_counts=True)
    touching = (kinds[:, None, 0] & kinds[None, :, 1]) | (kinds[:, None, 1] & kinds[None, :, 0]) != 0
    pairs = int((counts[:, None] * counts * touching).sum() - (counts * touching.diagonal()).sum()) // 2
    needed = (4 * pairs + host.nv) * host.nv * np.dtype(float).itemsize / 2**30
    if needed > MOST_GIB:
        raise SceneError(
            f"MJX would allocate {needed:.3g} GiB for {name}, with {pairs} pairs of geoms and {host.nv} degrees of "
            f"freedom; the limit is {MOST_GIB:g} GiB: exclude pairs by contype and conaffinity, or use a smaller model"
        )


def _find(source: str | Path) -> Path:
    path, shipped = Path(source), models_folder() / f"{source}.xml"
    if shipped.is_file():
        return shipped
    if path.is_dir():
        raise SceneError(f"{path} is a folder, not an MJCF file")
    if path.suffix.lower() == ".xml":
        if not path.is_file():
            raise SceneError(f"no MJCF file at {path}")
        if not str(path).encode(errors="ignore").decode() == str(path):  # it names tasks in studies and figures
            raise SceneError(f"the path of an MJCF must be UTF-8, got {str(path)!r}: rename it")
        return path
    more = f"; there are {', '.join(model_names())}, or give a path to an .xml"
    raise SceneError(f"no model named {source!r}{suggestion(str(source), model_names()) or more}")


def require(scene: Scene, *, joints: tuple[str, ...], geoms: tuple[str, ...], driven: tuple[str, ...] = ()) -> None:
    """Reject a model that a task cannot use, since a name is missing, or a size or the order differs.

    Args:
        joints: names of all its joints, with one coordinate each, in state order.
        geoms: names of required geoms.
        driven: joint driven by each actuator, in control order.
    """
    host = scene.host
    indices = [scene.joint(name) for name in joints]
    for name in geoms:
        scene.geom(name)
    sizes, found = (len(joints), len(joints), len(driven)), (host.nq, host.nv, host.nu)
    if found != sizes:
        raise SceneError(f"{scene.name} has nq, nv, nu = {found}; the task needs {sizes}")
    if indices != sorted(indices):
        own = ", ".join(joints[indices.index(index)] for index in sorted(indices))
        raise SceneError(f"the joints of {scene.name} must come in the order {', '.join(joints)}; they come as {own}")
    targets = [mujoco.mj_id2name(host, mujoco.mjtObj.mjOBJ_JOINT, joint) for joint in host.actuator_trnid[:, 0]]
    if targets != list(driven):
        raise SceneError(
            f"the actuators of {scene.name} must drive {', '.join(driven)} in this order; they drive "
            f"{', '.join(map(str, targets))}"
        )


def _set_options(host: mujoco.MjModel, options: Mapping[str, SceneOption]) -> None:
    for name, value in options.items():
        if name in _ENUMERATED:
            choices = _ENUMERATED[name]
            if value not in choices:
                raise SceneError(unknown(name, value, choices))
            setattr(host.opt, name, choices[str(value)])
        elif name in _POSITIVE:
            number_type = type(getattr(host.opt, name))
            if not isinstance(value, Number) or not (0 < value < math.inf and number_type(value) == value):
                whole = "whole " if number_type is int else ""
                raise SceneError(f"{name} must be a positive {whole}number, got {value!r}")
            setattr(host.opt, name, number_type(value))
        elif name == "disable_flags":
            _disable_flags(host, value)
        else:
            raise SceneError(unknown("option", name, [*_ENUMERATED, *_POSITIVE, "disable_flags"]))


def _disable_flags(host: mujoco.MjModel, names: SceneOption) -> None:
    if isinstance(names, Number):
        raise SceneError(f"disable_flags must be names of flags, got {names!r}")
    for name in names.split(",") if isinstance(names, str) else names:
        if name not in FLAGS:
            raise SceneError(unknown("flag", name, FLAGS))
        FLAGS[name].disable(host.opt)


def check_model(host: mujoco.MjModel, name: str = "the model") -> None:
    """Reject a model with features that MJX lacks or would silently ignore.

    Raises:
        SceneError: there are such features; the message names them and a remedy.
    """
    for option, choices in _ENUMERATED.items():
        value = int(getattr(host.opt, option))
        if value not in {int(choice) for choice in choices.values()}:
            raise SceneError(
                f"MJX lacks the {option} that {name} asks for; set one of {', '.join(choices)} in its <option>, "
                f"or give --{option}"
            )
    if flags := lacking(host):
        raise SceneError(
            f"MJX lacks {', '.join(flags)}, which {name} enables; disable them in its <option><flag>, or give "
            f"--disable-flag {','.join(flags)}"
        )
    pyramidal = host.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    if pyramidal and (pair := frictionless_pair(host)):
        both = " and ".join(geom_label(host, geom) for geom in (pair.first, pair.second))
        raise SceneError(
            f"{name}: the contact of {both} has no friction, which makes a pyramidal cone 1 / mu^2 = 1e10 times "
            'stiffer and costs derivatives ten digits; give both geoms condim="1", or --cone elliptic'
        )
    if features := ignored(host):
        raise SceneError(f"MJX would leave out part of {name}: {'; '.join(features)}")
