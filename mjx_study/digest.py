"""Digests of values by content: numbers, models, objects, and functions with all that they read.

Numbers and arrays enter by value, to twelve digits; models by MuJoCo's arrays, without names and colours. Functions
enter by name, closure, defaults, what they read from their modules, and source files (`sources`). Objects enter by
class and state, and classes of the user by their methods.
"""

import dataclasses
import enum
import functools
import hashlib
import inspect
import re
import types
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_study.simulation.scene import Scene
from mjx_study.sources import Sources, by_version, functions_by_name, is_users, source_file

IRRELEVANT: Final = re.compile(r"_.*|.*name.*|.*path.*|.*rgba|(tex|mat|skin|light|cam|text)_.*|.*_matid")
"""Fields of MjModel that do not affect results."""
PARTS: Final = {
    "data": (mujoco.MjData, ("time", "qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat", "userdata")),
    "partial": (functools.partial, ("func", "args", "keywords")),
    "method": (types.MethodType, ("__self__", "__func__")),
    "property": (property, ("fget", "fset", "fdel")),
}
"""Attributes that objects of a type consist of; the others follow, or are measured."""
STATELESS: Final = frozenset(
    "logging threading _thread weakref _weakref io _io os posix socket contextvars queue asyncio concurrent "
    "multiprocessing subprocess tempfile".split()
)
"""Modules of the standard library whose objects are no data: they differ from process to process."""
HARMLESS: Final = frozenset("logging threading _thread weakref _weakref".split())
"""Those of them that no trace depends on."""
IMPLIED: Final = frozenset(
    "__abstractmethods__ __annotate__ __annotate_func__ __annotations__ __annotations_cache__ __classcell__ "
    "__dataclass_fields__ __dataclass_params__ __dict__ __doc__ __firstlineno__ __match_args__ __module__ __name__ "
    "__orig_bases__ __orig_class__ __parameters__ __qualname__ __slots__ __static_attributes__ __type_params__ "
    "__weakref__ _abc_impl _is_protocol".split()
)
"""Attributes that say nothing beyond names and source."""
LATER: Final = "later"
"""Key in the metadata of fields that were added to a dataclass, so that digests of the version before are kept."""
HELD_LATER: Final = {("mjx_study.tasks.sliding_box", "system"), ("mjx_study.tasks.tennis", "system")}
"""Variables that functions of a module have held since a later version, and that are left out, so that digests of the
version before are kept: they follow from the scene, which is digested by itself."""
FORMER: Final = {
    "mjx_study.reference.projectiles": "mjx_study.reference.launch",
    "estimators.batches": "estimators.types",
    "estimators.interpolation": "estimators.alpha",
    "estimators.samples": "estimators.rows",
    "estimators.zeroth_first": "estimators.orders",
}
"""Names of modules in earlier versions, which stay in digests: a move changes no result."""
CODE: Final = (type, types.FunctionType, types.BuiltinFunctionType, types.MethodType, functools.partial)
"""Kinds of values that are code rather than data."""


def digest_of(value: Any) -> str:
    return Digest(value).hexdigest()


class Digest:
    """A digest of values, and of all that functions among them depend on.

    Args:
        exact: digest values to the bit, with all that a trace may read; otherwise independently of the processor.

    Attributes:
        sources: source files of functions and classes from outside this package.
        globals: digests of the data that user-defined functions read from their modules, by "global NAME of MODULE".
        opaque: types of values whose content cannot be digested.
    """

    def __init__(self, *values: Any, exact: bool = False) -> None:
        self._exact = exact
        self._sha = hashlib.sha256()
        self._seen: dict[int, tuple[int, Any]] = {}
        self.sources = Sources()
        self.globals: dict[str, str] = {}
        self.opaque: list[str] = []
        for value in values:
            self.add(value)

    @property
    def parts(self) -> dict[str, str]:
        """Digests of sources and globals, by name."""
        return self.globals | {f"source of {name}": digest for name, digest in sorted(self.sources.digests.items())}

    def hexdigest(self) -> str:
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
        for label, (kind, names) in PARTS.items():
            if isinstance(value, kind):
                return self._all(label, (getattr(value, name) for name in names))
        if isinstance(value, Scene):
            self._scene(value)
        elif isinstance(value, mujoco.MjModel):
            self._model(value)
        elif isinstance(value, type):
            self._class(value)
        elif isinstance(value, types.ModuleType):
            self._note("module", value.__name__)
            self.sources.add(value.__name__)
        elif isinstance(value, types.CodeType):
            self._code(value)
        elif isinstance(value, types.FunctionType):
            self._function(value)
        elif type(value).__module__.partition(".")[0] in STATELESS:
            self._note("stateless", type(value).__qualname__)
            self._unseen(value)
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
        elif (kind.__reduce_ex__, kind.__reduce__) != (object.__reduce_ex__, object.__reduce__) or not (
            hasattr(value, "__dict__") or _slots(kind)
        ):
            self._all("reduced", self._reduced(value))
        if state := _state(value):
            self._all("attributes", sorted(state.items()))

    def _reduced(self, value: Any) -> list[Any]:
        """What pickle would keep of an object without attributes, such as a slice; its name, if it keeps nothing."""
        try:
            reduced = value.__reduce_ex__(2)
        except Exception:  # the user's class may raise anything
            self._unseen(value)
            return [getattr(value, "__name__", None)]
        parts = reduced if isinstance(reduced, tuple) else (reduced,)
        return [list(part) if isinstance(part, Iterator) else part for part in parts]

    def _unseen(self, value: Any) -> None:
        """Note a value whose content does not enter, unless traces cannot depend on it."""
        kind, top = type(value), type(value).__module__.partition(".")[0]
        if top not in HARMLESS and (top == "builtins" or not by_version(top) or top in STATELESS):
            self.opaque.append(f"a value of type {kind.__module__}.{kind.__qualname__}")

    def _class(self, kind: type) -> None:
        """Add a class: by name and source, and of the user's its methods and attributes, inherited ones included."""
        self._note("class", FORMER.get(kind.__module__, kind.__module__), kind.__qualname__)
        for each in kind.__mro__:
            self.sources.add(each.__module__)
            if is_users(each.__module__):
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
            rounded = np.rint(np.ldexp(mantissa, 40))
            carried = np.abs(rounded) == 2.0**40  # up to a power of two, whose mantissa is 0.5
            rounded, exponent = np.where(carried, rounded / 2, rounded), exponent + carried
            self._sha.update(rounded.astype(np.int64).tobytes())
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
                if not np.allclose(theirs.ravel(), np.ravel(ours), rtol=1e-6, atol=0, equal_nan=True):
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
        module = function.__module__ or ""  # none if made by exec in a namespace without a name
        if by_version(module):
            function = inspect.unwrap(function)
        home = function.__globals__.get("__name__", module)  # decorators copy __module__
        self._note("function", FORMER.get(module, module), function.__qualname__)
        self._all("holds", (function.__defaults__, function.__kwdefaults__, _closure(function), _state(function)))
        if by_version(home) or by_version(module):
            return
        self.sources.add(home)
        code, path = function.__code__, source_file(home)
        if code.co_qualname != function.__qualname__:  # which decorators copy
            self._note("code of", code.co_qualname)
        if path is None or code.co_filename != str(path) or functions_by_name(path.read_bytes())[code.co_qualname] != 1:
            self._code(code)  # from an interactive session, made at run time, or one of several of its name
        names = _names(code)
        for name in sorted(names & function.__globals__.keys()):
            value = function.__globals__[name]
            if is_users(home):
                self._global(home, name, value, names)
            elif isinstance(value, bool | int | float | str | tuple | np.ndarray | jax.Array | types.FunctionType):
                self._all(f"global {name}", (value,))

    def _global(self, module: str, name: str, value: Any, names: set[str]) -> None:
        """Add what a function reads from a module: data by a digest of its own; of another module the names it uses."""
        if isinstance(value, types.ModuleType):
            if is_users(value.__name__):
                for each in sorted(names & vars(value).keys()):
                    self._global(value.__name__, each, vars(value)[each], names - {each})
            return
        if isinstance(value, CODE) or hasattr(value, "__wrapped__"):
            self._all(f"global {name}", (value,))
            return
        label = f"global {name} of {module}"
        if label not in self.globals:
            self.globals[label] = ""  # while it is made, since it may contain functions that read it
            digest = Digest(exact=self._exact)
            digest.sources, digest.globals, digest.opaque = self.sources, self.globals, self.opaque
            digest.add(value)
            self.globals[label] = digest.hexdigest()
        self._note(label, self.globals[label])

    def _code(self, code: types.CodeType) -> None:
        self._note("code", code.co_code.hex())
        self._all("names", (*code.co_names, *code.co_consts))


def _closure(function: types.FunctionType) -> dict[str, Any]:
    """Variables captured by a function, by name, except those `HELD_LATER`."""
    held = {}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        with suppress(ValueError):  # a cell that is still empty
            if (function.__module__, name) not in HELD_LATER:
                held[name] = cell.cell_contents
    return held


def _slots(kind: type) -> set[str]:
    """Names of a class's slots, inherited ones included."""
    slots = [vars(each).get("__slots__", ()) for each in kind.__mro__]
    return {name for each in slots for name in ((each,) if isinstance(each, str) else each)} - IMPLIED


def _state(value: Any) -> dict[str, Any]:
    """Attributes of an object, in its dictionary or in slots, except cached ones; of our dataclasses, the fields,
    except those that came `LATER` and have their defaults."""
    kind = type(value)
    if dataclasses.is_dataclass(value) and by_version(kind.__module__):
        found = {field: getattr(value, field.name) for field in dataclasses.fields(value)}
        return {
            field.name: each for field, each in found.items() if not (LATER in field.metadata and each == field.default)
        }
    held = {name: getattr(value, name) for name in _slots(kind) if hasattr(value, name)}
    own = {name: each for name, each in getattr(value, "__dict__", {}).items() if name not in IMPLIED}
    if (wrapped := getattr(value, "__wrapped__", None)) is not None:
        if by_version(kind.__module__):  # jit and the like note where the function is
            own = {name: each for name, each in own.items() if not name.startswith("_")}
        held["__wrapped__"] = wrapped
    held |= own
    return {name: held[name] for name in held if not isinstance(getattr(kind, name, None), functools.cached_property)}


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


def _names(code: types.CodeType) -> set[str]:
    """Global names used by a function, including those of nested functions."""
    inner = (each for each in code.co_consts if isinstance(each, types.CodeType))
    return set(code.co_names).union(*(_names(each) for each in inner))
