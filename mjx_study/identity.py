"""Content-based identity of what results depend on: the compiled model, the task's parts, and the software.

Numbers and arrays enter a digest by value, to twelve digits; models by MuJoCo's arrays, without names and colours.
Functions enter by name, closure, defaults, what they read from their modules, and the source file of their module,
along with the neighbouring files that it imports, at the top or within functions. Objects enter by class and state, and
classes of the user by their methods. Code of this package and of the libraries below it enters by version.
"""

import ast
import dataclasses
import enum
import functools
import hashlib
import inspect
import re
import subprocess
import sys
import types
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from estimators import Estimator, find_estimator
from mjx_study.runtime import precision
from mjx_study.simulation.scene import Scene, models_folder
from mjx_study.tasks.task import Task
from mjx_study.version import version_of

VERSIONED: Final = ("mjx-study", "mujoco", "mujoco-mjx", "jax", "jaxlib", "numpy", "optax")
"""Packages whose version may affect results."""
BY_VERSION: Final = {"mjx_study", "estimators", "mujoco", "jax", "jaxlib", "numpy", "scipy", "optax", "builtins"}
"""Modules whose code is identified by version."""
IRRELEVANT: Final = re.compile(r"_.*|.*name.*|.*path.*|.*rgba|(tex|mat|skin|light|cam|text)_.*|.*_matid")
"""Fields of MjModel that do not affect results."""
ABOVE: Final = ("cli", "plots", "render", "gradcheck", "claims", "report.py", "bench.py", "diagnose")
"""Parts of mjx_study that use studies, and so do not affect their results."""
STATE: Final = ("time", "qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat", "userdata")
"""Fields of MjData that count; the others follow, or are measured."""
STATELESS: Final = frozenset(
    "logging threading _thread weakref _weakref io _io os posix socket contextvars queue asyncio concurrent "
    "multiprocessing subprocess tempfile".split()
)
"""Modules of the standard library whose objects are no data: they differ from process to process."""
IMPLIED: Final = frozenset(
    "__abstractmethods__ __annotate__ __annotate_func__ __annotations__ __annotations_cache__ __classcell__ "
    "__dataclass_fields__ __dataclass_params__ __dict__ __doc__ __firstlineno__ __match_args__ __module__ __name__ "
    "__orig_bases__ __orig_class__ __parameters__ __qualname__ __slots__ __static_attributes__ __type_params__ "
    "__weakref__ _abc_impl _is_protocol".split()
)
"""Attributes that say nothing beyond names and source."""
CODE: Final = (type, types.FunctionType, types.BuiltinFunctionType, types.MethodType, functools.partial)
"""Kinds of values that are code rather than data."""
DIGEST: Final = re.compile("[0-9a-f]{12,64}")
"""Digests, which messages do not show."""
ACCEPT: Final = "choose another folder, or accept the mixture by --accept-versions"
"""Advice at the end of messages about other versions."""


def versions() -> dict[str, str]:
    """Versions of the packages that compute, and a digest of this package's code."""
    return {name: version_of(name) for name in VERSIONED} | {"code of mjx-study": _own_code()}


def git_revision(root: Path | None = None) -> str | None:
    """Commit of a checkout, by default this package's; None outside one, before its first commit, or without git."""
    folder = (Path(__file__).resolve().parents[1] if root is None else root) / ".git"
    try:
        found = subprocess.run(["git", f"--git-dir={folder}", "rev-parse", "--verify", "HEAD"], capture_output=True)
    except OSError:
        return None
    return found.stdout.decode().strip() if found.returncode == 0 else None


def contents(tasks: Mapping[str, Iterable[Task]]) -> dict[str, str]:
    """Return the precision, and digests of everything that tasks consist of, all variants (timesteps, cones) of each
    together: "model of NAME", "task NAME", and of a user's task "source of FILE" for every source file and "global
    NAME of MODULE" for the data that its functions read."""
    found, parts = {"precision": precision()}, {}
    for name, forms in tasks.items():
        models, rest = _Digest(), _Digest()
        for task in forms:
            models.add(task.scene)
            for field in dataclasses.fields(task):
                if field.name not in ("scene", "description"):  # the latter does not affect results
                    rest.add((field.name, getattr(task, field.name)))
        found |= {f"model of {name}": models.hexdigest(), f"task {name}": rest.hexdigest()}
        parts |= rest.parts
    return found | dict(sorted(parts.items()))


def digest_of(value: Any) -> str:
    """Digest of a value, by content."""
    digest = _Digest()
    digest.add(value)
    return digest.hexdigest()


def trace_contents(made_of: Any) -> str | None:
    """Digest everything a trace depends on except its arguments and JAX's settings: exact values and models, and code.

    None if code from outside this package is involved, whose imports are not all followed.
    """
    digest = _Digest(exact=True)
    digest.add((made_of, [version_of(name) for name in VERSIONED], _own_code(ABOVE)))
    return None if digest.foreign else digest.hexdigest()


def estimator_contents(chosen: Mapping[str, str | Estimator]) -> dict[str, str]:
    """Digests of those estimators, by name, that are given as objects or user-defined, and of their source files."""
    found: dict[str, str] = {}
    for name, each in chosen.items():
        digest = _Digest()
        digest.add(find_estimator(each))
        if digest.sources or isinstance(each, Estimator):
            found[f"estimator {name}"] = digest.hexdigest()
            found |= digest.parts
    return found


def differences(theirs: Mapping[str, Any], ours: Mapping[str, Any]) -> str | None:
    """Describe the first three entries that differ in a message; None if none does.

    Digests that only one of the two has come last, since another entry gives the reason.
    """
    different = [name for name in dict(theirs) | dict(ours) if theirs.get(name) != ours.get(name)]
    digests = {name for name in different for each in (theirs, ours) if DIGEST.fullmatch(str(each.get(name)))}
    different.sort(key=lambda name: name in digests and (name not in theirs or name not in ours))
    told = []
    for name in different[:3]:
        there, here = ("none" if each.get(name) is None else each[name] for each in (theirs, ours))
        told.append(f"{name} differs" if name in digests else f"{name} {there} there and {here} here")
    told += [f"{len(different) - 3} more"] if len(different) > 3 else []
    return ", ".join(told) or None


@functools.cache
def _own_code(without: tuple[str, ...] = ()) -> str:
    """Digest of this package's source, except some parts of mjx_study."""
    package = Path(__file__).parent
    files = sorted([*package.rglob("*.py"), *(package.parent / "estimators").rglob("*.py")])
    left_out = [package / part for part in without]
    sha = hashlib.sha256()
    for path in files:
        if not any(path.is_relative_to(part) for part in left_out):
            sha.update(str(path.relative_to(package.parent)).encode() + b"\0" + path.read_bytes())
    return sha.hexdigest()[:12]


@functools.cache
def code_of(module: str) -> str:
    """Digest the code behind a ledger measurement: an imported module, its imports from its own package, and the code
    below."""
    package, found, waiting = module.rpartition(".")[0], {}, [module]
    while waiting:
        name = waiting.pop()
        path = _file(name)
        if path is None or name in found or not name.startswith(package):
            continue
        found[name] = path.read_bytes()
        imports = [node for node in ast.walk(ast.parse(found[name])) if isinstance(node, ast.ImportFrom)]
        waiting += [f"{node.module}.{alias.name}" for node in imports for alias in node.names]
        waiting += [str(node.module) for node in imports]
    models = sorted(models_folder().rglob("*.xml"))
    text = repr((sorted(found.items()), [path.read_bytes() for path in models], _own_code(ABOVE)))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class _Digest:
    """A digest of values, including the source files of functions among them.

    Args:
        exact: digest values to the bit, with all that a trace may read; otherwise independently of the processor.

    Attributes:
        sources: digests of the source files of functions and classes from outside this package.
        globals: digests of the data that user-defined functions read from their modules, by "global NAME of MODULE".
        foreign: whether there is any code from outside this package, including that of an interactive session.
    """

    def __init__(self, *, exact: bool = False) -> None:
        self._exact, self.foreign = exact, False
        self._sha = hashlib.sha256()
        self._seen: dict[int, tuple[int, Any]] = {}
        self.sources: dict[str, str] = {}
        self.globals: dict[str, str] = {}

    @property
    def parts(self) -> dict[str, str]:
        """Digests of sources and globals, by name."""
        return self.globals | {f"source of {name}": digest for name, digest in sorted(self.sources.items())}

    def hexdigest(self) -> str:
        """Return the digest as sixteen hexadecimal digits."""
        return self._sha.hexdigest()[:16]

    def add(self, value: Any) -> None:
        """Add a value and everything it contains."""
        if value is None or isinstance(value, bool | int | str | bytes | complex | enum.Enum):
            self._note(type(value).__name__, repr(value))
        elif isinstance(value, float | np.ndarray | np.generic | jax.Array):
            self._array(value)
        elif type(value) in (tuple, frozenset):  # constants, which a process may share or not
            self._object(value)
        elif id(value) in self._seen:
            self._note("again", str(self._seen[id(value)][0]))
        else:
            self._seen[id(value)] = len(self._seen), value  # kept alive, so that its id is not reused
            self._compound(value)

    def _compound(self, value: Any) -> None:
        if isinstance(value, Scene):
            self._scene(value)
        elif isinstance(value, mujoco.MjModel):
            self._model(value)
        elif isinstance(value, mujoco.MjData):
            self._all("data", (getattr(value, name) for name in STATE))
        elif isinstance(value, type):
            self._class(value)
        elif isinstance(value, types.ModuleType):
            self._note("module", value.__name__)
            self._source(value.__name__)
        elif isinstance(value, types.CodeType):
            self._code(value)
        elif isinstance(value, functools.partial):
            self._all("partial", (value.func, value.args, value.keywords))
        elif isinstance(value, types.MethodType):
            self._all("method", (value.__self__, value.__func__))
        elif isinstance(value, types.FunctionType):
            self._function(value)
        elif isinstance(value, property):
            self._all("property", (value.fget, value.fset, value.fdel))
        elif type(value).__module__.partition(".")[0] in STATELESS:
            self._note("stateless", type(value).__qualname__)
        else:
            self._object(value)

    def _object(self, value: Any) -> None:
        """Add an object: its class, its items if it is a container, its attributes, and what else it is made of."""
        kind = type(value)
        if kind not in (dict, list, tuple, set, frozenset):
            self.add(kind)
        if isinstance(value, Mapping):
            self._all("mapping", sorted(value.items(), key=lambda item: _order(item[0])))
        elif isinstance(value, set | frozenset):
            self._all("set", sorted(value, key=_order))
        elif isinstance(value, tuple | list):
            self._all("sequence", value)
        elif kind.__reduce_ex__ is not object.__reduce_ex__ or kind.__reduce__ is not object.__reduce__:
            self._all("reduced", _reduced(value))
        elif not (hasattr(value, "__dict__") or _slots(kind)):
            self._all("reduced", _reduced(value))
        if state := _state(value):
            self._all("attributes", sorted(state.items()))

    def _class(self, kind: type) -> None:
        """Add a class: by name and source, and of the user's its methods and attributes, inherited ones included."""
        self._note("class", kind.__module__, kind.__qualname__)
        for each in kind.__mro__:
            self._source(each.__module__)
            if _users(each.__module__):
                self._all("members", sorted(_members(each).items()))

    def _note(self, *texts: str) -> None:
        self._sha.update("\0".join((*texts, "\n")).encode("utf-8", "surrogatepass"))

    def _all(self, kind: str, values: Iterable[Any]) -> None:
        values = list(values)
        self._note(kind, str(len(values)))
        for value in values:
            self.add(value)

    def _array(self, value: Any) -> None:
        """Add an array by value, to 40 bits of mantissa, since the last bits depend on the processor."""
        if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
            value = jax.random.key_data(value)
        array = np.asarray(value)
        self._note("array", array.dtype.str if self._exact else array.dtype.kind, str(array.shape))
        if array.dtype.kind == "f" and not self._exact:
            finite = np.isfinite(array)
            mantissa, exponent = np.frexp(np.where(finite, array, 0).astype(float))
            kind = np.where(finite, 0, np.where(np.isnan(array), 1, np.where(array > 0, 2, 3)))
            self._sha.update(np.rint(np.ldexp(mantissa, 40)).astype(np.int64).tobytes())
            array = np.stack([exponent.astype(np.int32), kind.astype(np.int32)])
        if array.dtype.kind == "O":
            self._all("objects", array.ravel().tolist())
        else:
            self._sha.update(array.tobytes())

    def _scene(self, scene: Scene) -> None:
        """Add MuJoCo's model, and the arrays that were changed in MJX's."""
        if self._exact:
            saved = np.empty(mujoco.mj_sizeModel(scene.host), np.uint8)
            mujoco.mj_saveModel(scene.host, None, saved)
            return self._all("scene", (scene.adjoint, saved, scene.model, scene.template))
        self._model(scene.host)
        on_device: Any = scene.model
        for field in dataclasses.fields(on_device):
            theirs, ours = getattr(scene.host, field.name, None), getattr(on_device, field.name, None)
            if isinstance(theirs, np.ndarray) and isinstance(ours, np.ndarray | jax.Array) and theirs.size == ours.size:
                if not np.allclose(theirs.ravel(), np.ravel(ours), rtol=1e-6, equal_nan=True):
                    self._all(f"mjx.{field.name}", (ours,))

    def _model(self, model: mujoco.MjModel) -> None:
        """Add arrays, options and statistics except zeros, so that new fields of a later MuJoCo do not matter."""
        for part, struct in (("", model), ("opt.", model.opt), ("stat.", model.stat)):
            for name in sorted(set(dir(struct))):
                value = None if IRRELEVANT.fullmatch(name) else getattr(struct, name)
                counts = isinstance(value, np.ndarray) or (part and isinstance(value, int | float))
                if counts and np.any(value):
                    self._all(part + name, (np.asarray(value),))

    def _function(self, function: types.FunctionType) -> None:
        if _by_version(function.__module__):
            function = inspect.unwrap(function)
        home = function.__globals__.get("__name__", function.__module__)  # decorators copy __module__
        self._note("function", function.__module__, function.__qualname__)
        self._all("holds", (function.__defaults__, function.__kwdefaults__, _closure(function), _state(function)))
        if _by_version(home) or _by_version(function.__module__):
            return
        self._source(home)
        code, path = function.__code__, _file(home)
        if path is None or code.co_filename != str(path):  # from an interactive session, or made at run time
            self._code(code)
        names = _names(code)
        for name in sorted(names & function.__globals__.keys()):
            value = function.__globals__[name]
            if _users(home):
                self._global(home, name, value, names)
            elif isinstance(value, bool | int | float | str | tuple | np.ndarray | jax.Array | types.FunctionType):
                self._all(f"global {name}", (value,))

    def _global(self, module: str, name: str, value: Any, names: set[str]) -> None:
        """Add what a function reads from a module: data by a digest of its own, which has a name in messages; of
        another module those of the names that the function uses."""
        if isinstance(value, types.ModuleType):
            if _users(value.__name__):
                for each in sorted(names & vars(value).keys()):
                    self._global(value.__name__, each, vars(value)[each], names - {each})
            return
        if isinstance(value, CODE) or hasattr(value, "__wrapped__"):
            self._all(f"global {name}", (value,))
            return
        told = f"global {name} of {module}"
        if told not in self.globals:
            self.globals[told] = ""  # while it is made, since it may contain functions that read it
            digest = _Digest(exact=self._exact)
            digest.sources, digest.globals = self.sources, self.globals
            digest.add(value)
            self.globals[told] = digest.hexdigest()
            self.foreign |= digest.foreign
        self._note(told, self.globals[told])

    def _code(self, code: types.CodeType) -> None:
        self._note("code", code.co_code.hex())
        self._all("names", (*code.co_names, *code.co_consts))

    def _source(self, module: str) -> None:
        """Add the source file of a module, and of neighbouring modules that it imports."""
        path = _file(module)
        self.foreign |= not _by_version(module)
        if _by_version(module) or path is None:
            return
        levels = module.count(".") + (path.name == "__init__.py")
        root = path.parents[min(levels, len(path.parents) - 1)]
        if self._read(path, root):
            for value in list(vars(sys.modules[module]).values()):
                other = value.__name__ if isinstance(value, types.ModuleType) else getattr(value, "__module__", None)
                if isinstance(other, str) and _beside(other, module, root):
                    self._source(other)
            if _users(module):
                self._imported(path, root, module if path.name == "__init__.py" else module.rpartition(".")[0])

    def _read(self, path: Path, root: Path) -> bool:
        """Add a source file; whether it is a new one."""
        name = str(path.relative_to(root))
        if new := name not in self.sources:
            self.sources[name] = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
        return new

    def _imported(self, path: Path, root: Path, package: str) -> None:
        """Add the files that import statements of a file name, wherever they stand, whether or not they are loaded."""
        for name in sorted(_imports(path.read_bytes(), package)):
            place = root.joinpath(*name.split("."))
            for found in (place.with_suffix(".py"), place / "__init__.py"):
                if _by_version(name) or not found.is_file():
                    continue
                if _file(name) == found:
                    self._source(name)
                elif self._read(found, root):
                    self._imported(found, root, name if found.name == "__init__.py" else name.rpartition(".")[0])


def _by_version(module: str) -> bool:
    top = module.partition(".")[0]
    return top in BY_VERSION or top in sys.stdlib_module_names - {"__main__"}


def _users(module: str) -> bool:
    """Whether a module is the user's: neither identified by version nor installed."""
    path = _file(module)
    return not _by_version(module) and (path is None or not {"site-packages", "dist-packages"} & set(path.parts))


def _file(module: str) -> Path | None:
    """Path of a module's source; None in an interactive session or for compiled modules."""
    file = getattr(sys.modules.get(module), "__file__", None)
    return Path(file) if file is not None and Path(file).is_file() else None


def _beside(other: str, module: str, root: Path) -> bool:
    """Whether a module is in the same package as another, or in the same folder tree."""
    path = _file(other)
    if path is None or other.partition(".")[0] == module.partition(".")[0]:
        return path is not None
    return path.is_relative_to(root) and _users(other)


def _closure(function: types.FunctionType) -> dict[str, Any]:
    """Variables captured by a function, by name."""
    held = {}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        with suppress(ValueError):  # a cell that is still empty
            held[name] = cell.cell_contents
    return held


def _slots(kind: type) -> set[str]:
    """Names of a class's slots, inherited ones included."""
    slots = [vars(each).get("__slots__", ()) for each in kind.__mro__]
    return {name for each in slots for name in ((each,) if isinstance(each, str) else each)} - IMPLIED


def _state(value: Any) -> dict[str, Any]:
    """Attributes of an object, in its dictionary or in slots, except cached ones; of our dataclasses, the fields."""
    kind = type(value)
    if dataclasses.is_dataclass(value) and _by_version(kind.__module__):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    held = {name: getattr(value, name) for name in _slots(kind) if hasattr(value, name)}
    own = {name: each for name, each in getattr(value, "__dict__", {}).items() if name not in IMPLIED}
    if (wrapped := getattr(value, "__wrapped__", None)) is not None:
        if _by_version(kind.__module__):  # jit and the like note where the function is
            own = {name: each for name, each in own.items() if not name.startswith("_")}
        held["__wrapped__"] = wrapped
    held |= own
    return {name: held[name] for name in held if not isinstance(getattr(kind, name, None), functools.cached_property)}


def _reduced(value: Any) -> list[Any]:
    """What pickle would keep of an object without attributes, such as a slice; its name, if it keeps nothing."""
    try:
        reduced = value.__reduce_ex__(2)
    except Exception:  # the user's class may raise anything
        return [getattr(value, "__name__", None)]
    parts = reduced if isinstance(reduced, tuple) else (reduced,)
    return [list(part) if isinstance(part, Iterator) else part for part in parts]


def _members(kind: type) -> dict[str, Any]:
    """Methods and attributes of a class, without those that Python or `dataclass` made."""
    kept = {}
    for name, value in vars(kind).items():
        made = isinstance(value, types.FunctionType) and value.__code__.co_filename == "<string>"
        slot = isinstance(value, types.MemberDescriptorType | types.GetSetDescriptorType)
        if not (made or slot or name in IMPLIED):
            kept[name] = value.func if isinstance(value, functools.cached_property) else value
    return kept


def _order(key: Any) -> str:
    """Sort key of a key or an element, the same in every process."""
    return repr(key) if isinstance(key, str | bytes | int | float | None) else digest_of(key)


@functools.cache
def _imports(source: bytes, package: str) -> set[str]:
    """Names that the import statements of a source file may mean, in full."""
    try:
        nodes = list(ast.walk(ast.parse(source)))
    except (SyntaxError, ValueError):
        return set()
    found = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    for node in nodes:
        if isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            stem = ".".join([*above, *([node.module] if node.module else [])])
            found |= {stem} | {f"{stem}.{alias.name}".lstrip(".") for alias in node.names}
    parents = {".".join(name.split(".")[:count]) for name in found for count in range(1, name.count(".") + 1)}
    return (found | parents) - {""}


def _names(code: types.CodeType) -> set[str]:
    """Global names used by a function, including those of nested functions."""
    inner = (each for each in code.co_consts if isinstance(each, types.CodeType))
    return set(code.co_names).union(*(_names(each) for each in inner))
