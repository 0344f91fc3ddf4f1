"""Functions of small arrays as native code, called by XLA for a whole batch at once."""

import os
import sys
from collections import Counter
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, cached_property, partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir

from mjx_study.graph import cuda
from mjx_study.graph.build import build_identity, build_library, compiler, known_libraries, library_ready
from mjx_study.graph.c import NotWrittenError, source_of
from mjx_study.graph.function import Passes, ScalarFunction, capture
from mjx_study.graph.numpy_code import python_source

SWITCH: Final = "MJX_STUDY_NATIVE"
"""Environment variable: 0 does without native code, which NumPy stands in for; xla without either."""
_TYPED: Final = 4
"""Version of the interface in calls of native code: API_VERSION_TYPED_FFI of StableHLO."""
_LEFT: Final[Counter[str]] = Counter()
"""Numbers of functions left to XLA, by reason."""
POSTPONED: Final[ContextVar[bool]] = ContextVar("postponed", default=False)
"""Whether functions are `postponed`."""


def native_identity() -> str | None:
    """Digest of what native code depends on besides its source: processor, compiler and flags, or NumPy's version.

    None if there is to be none: with `SWITCH`, on accelerators other than NVIDIA's, and there without compilers that
    work.
    """
    if in_numpy():
        return build_identity(True)
    served = jax.default_backend() == "cpu" or cuda.target() is not None
    return build_identity() if os.environ.get(SWITCH, "") not in ("0", "xla") and served and _compiles() else None


def in_numpy() -> bool:
    """Whether NumPy stands in for native code: on CPUs, with `SWITCH`, and without a compiler that works."""
    switch = os.environ.get(SWITCH, "")
    return switch != "xla" and jax.default_backend() == "cpu" and (switch == "0" or not _compiles())


def computes_steps() -> str:
    """What computes functions that are native code where it can be built: "native", "NumPy" or "XLA"."""
    return "NumPy" if in_numpy() else "XLA" if native_identity() is None else "native"


def written(function: ScalarFunction, passes: Passes | None = None) -> str:
    """Source of a function, or of all passes of a loop whose body it is, for what computes here.

    Raises:
        NotWrittenError: an operation or a type is not covered.
    """
    return python_source(function, passes) if in_numpy() else source_of(function, jax.default_backend(), passes)


def native_summary() -> str:
    """Libraries that this process has loaded, and how many functions are left to XLA and why."""
    loaded = sum(map(library_ready, known_libraries())) if native_identity() else 0
    loaded -= computes_steps() == "native"  # that of `_compiles`
    return f"{loaded} libraries" + "".join(f", {count} through XLA: {why}" for why, count in _LEFT.items())


def count_left(reason: str) -> None:
    """Count a function that is left to XLA."""
    _LEFT[reason] += 1


@cache
def _compiles() -> bool:
    """Whether there is a compiler, and builds the smallest of functions; if it does not, a line says so."""
    if compiler() is None:
        return False
    function = capture(lambda x: x + 1, jax.ShapeDtypeStruct((), np.float32), most=9)
    built = library_ready(build_library(source_of(function, jax.default_backend())))
    if not built:
        print("mjx-study: steps run more slowly, on CPUs in NumPy", file=sys.stderr)
    return built


class NativeFunction:
    """A function as a library, and as a JAX program for derivatives and where there is no library.

    Args:
        write: writes the library's source; it may raise NotWrittenError.
        inputs: types of the function's inputs.
        outputs: types of its outputs.
        program: makes the program.

    Attributes:
        values: graph of the function's values, if it is a graph.
    """

    def __init__(
        self,
        write: Callable[[], str],
        inputs: Sequence[Any],
        outputs: Sequence[Any],
        program: Callable[[], Callable[..., list[jax.Array]]],
        values: ScalarFunction | None = None,
    ):
        self._write, self._program = write, program
        self.inputs, self.outputs, self.values = inputs, outputs, values
        self.platform = jax.default_backend()

    @cached_property
    def name(self) -> str | None:
        """Name of the library, which is being built; None, which is counted, if it cannot be written."""
        try:
            return build_library(self._write())
        except NotWrittenError as error:
            count_left(str(error))
            return None

    def begun(self) -> bool:
        """Begin to build the library; whether it can be written."""
        return self.name is not None

    def __call__(self, *inputs: jax.Array) -> list[jax.Array]:
        return _native.bind(*inputs, function=self, batch=())

    @cached_property
    def program(self) -> Callable[..., list[jax.Array]]:
        """The function in JAX operations."""
        return self._program()


@contextmanager
def postponed() -> Generator[None]:
    """Call functions in this context without building their libraries."""
    token = POSTPONED.set(True)
    try:
        yield
    finally:
        POSTPONED.reset(token)


def _plain(*inputs: Any, function: NativeFunction, batch: tuple[int, ...]) -> list[jax.Array]:
    """The function as JAX operations, of arrays with leading dimensions `batch` or without."""
    axes = tuple(0 if each.ndim > aval.ndim else None for each, aval in zip(inputs, function.inputs, strict=True))
    each = function.program
    for _ in batch:
        each = jax.vmap(each, axes)
    return each(*inputs)


def _batch(
    arguments: Sequence[Any], axes: Sequence[Any], *, function: NativeFunction, batch: tuple[int, ...]
) -> tuple[list[Any], list[int]]:
    size = next(each.shape[axis] for each, axis in zip(arguments, axes, strict=True) if axis is not None)
    batch = (size, *batch)

    def spread(array: Any, axis: Any, aval: Any) -> Any:
        if axis is not None:
            array = jnp.moveaxis(array, axis, 0)
            array = array.reshape(size, *(1,) * (len(batch) + aval.ndim - array.ndim), *array.shape[1:])
        elif array.ndim == aval.ndim:
            return array
        return jnp.broadcast_to(array, (*batch, *aval.shape))

    spreads = [spread(*each) for each in zip(arguments, axes, function.inputs, strict=True)]
    outputs = _native.bind(*spreads, function=function, batch=batch)
    return outputs, [0] * len(outputs)


def _types(*inputs: Any, function: NativeFunction, batch: tuple[int, ...]) -> list[ShapedArray]:
    return [ShapedArray((*batch, *aval.shape), aval.dtype) for aval in function.outputs]


def _evaluate(*inputs: Any, function: NativeFunction, batch: tuple[int, ...]) -> list[jax.Array]:
    return jax.jit(partial(_native.bind, function=function, batch=batch))(*inputs)


def _lower(platform: str, context: Any, *operands: Any, function: NativeFunction, batch: tuple[int, ...]) -> Any:
    name = function.name if function.platform == platform else ""
    if not name or not library_ready(name):
        if name is not None:
            count_left("not built")
        return _lower_plain(context, *operands, function=function, batch=batch)
    ins = [_layout(at.ndim, at.ndim - aval.ndim) for at, aval in zip(context.avals_in, function.inputs, strict=True)]
    outs = [_layout(each.ndim, len(batch)) for each in context.avals_out]
    lowering = jax.ffi.ffi_lowering(name, operand_layouts=ins, result_layouts=outs)
    results: Any = lowering(context, *operands)
    attributes = results[0].owner.attributes  # JAX says that the call is typed beside the operation, where XLA loses it
    del attributes["mhlo.backend_config"]
    attributes["api_version"], attributes["backend_config"] = mlir.i32_attr(_TYPED), mlir.ir.DictAttr.get()
    return results


def _layout(rank: int, batched: int) -> tuple[int, ...]:
    """Dimensions of an array from the fastest to the slowest: those of the batch first."""
    return *reversed(range(batched)), *reversed(range(batched, rank))


_lower_plain = mlir.lower_fun(_plain, multiple_results=True)
_native = Primitive("native")
_native.multiple_results = True
_native.def_impl(_evaluate)
_native.def_abstract_eval(_types)
batching.primitive_batchers[_native] = _batch
mlir.register_lowering(_native, partial(_lower, "cpu"), platform="cpu")
mlir.register_lowering(_native, partial(_lower, "gpu"), platform="cuda")
mlir.register_lowering(_native, _lower_plain)
