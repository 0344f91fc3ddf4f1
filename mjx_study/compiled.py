"""JAX-compiled functions whose traces outlive the process, since tracing a rollout's gradient takes seconds.

JAX caches what XLA compiles; the trace before it is cached here as StableHLO, keyed by a digest of everything it
depends on (`identity.trace_contents`). Traces that depend on code from outside this package are not cached.

A file holds the structure of the outputs as JSON in a line, and the serialised StableHLO; see `caches` for who may read
and write it.
"""

import dataclasses
import hashlib
import json
import os
import re
from collections.abc import Callable, Iterable, Sequence
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Final

import jax
import jax.export

from mjx_study.caches import read_cached, write_cached
from mjx_study.graph.build import known_libraries, libraries_in, library_ready
from mjx_study.graph.native import native_identity
from mjx_study.identity import trace_contents
from mjx_study.runtime import precision, traces_folder
from mjx_study.structure import describe, restore
from mjx_study.watchdog import awaited

UNTRACED: Final = re.compile("cache|^jax_log|num_cpu_devices|async_dispatch")
"""JAX settings that traces do not depend on."""
GRAPHS: Final = "FUSION,CUBLAS,CUBLASLT,CUDNN,CUSTOM_CALL,DYNAMIC_SLICE_FUSION,CONDITIONAL,WHILE"
"""Operations that XLA records in CUDA graphs: its default ones and whole loops, whose steps the host would launch."""


class Compiled:
    """A pure function compiled by JAX once per form of its arguments: shapes, types and pytree structure.

    Args:
        function: function of this package, from pytrees of arrays to pytrees of arrays.
        made_of: a name and everything that the function captures, such as a task, which together with the form of the
            arguments determines its trace. Without it the trace is not cached.

    Attributes:
        jitted: the plain `jax.jit` function, whose trace is not cached, for use within other programs.
    """

    def __init__(self, function: Callable[..., Any], *made_of: Any):
        self.jitted = jax.jit(function)
        self._function, self._made_of = function, made_of
        self._ready: dict[Path, Callable[..., Any]] = {}

    @cached_property
    def _whole(self) -> Callable[..., Any]:
        """The function as a program of its own."""
        return jax.jit(self._function, compiler_options=compiler_options())

    def __call__(self, *arguments: Any) -> Any:
        with awaited():
            return self.prepare(*arguments)(*arguments)

    @property
    def num_compilations(self) -> int:
        """Number of argument forms compiled in this process."""
        return sum(each._cache_size() for each in (self._whole, *self._ready.values()))

    def prepare(self, *arguments: Any, platform: str | None = None) -> Callable[..., Any]:
        """Trace the function in this thread, or load its cached trace.

        Args:
            arguments: arrays, or their shapes and types (`jax.ShapeDtypeStruct`).
            platform: platform of the devices; traces are cached for JAX's default one only.

        Returns:
            A function of arguments of this form, which threads may call in parallel.
        """
        leaves, form = jax.tree.flatten(arguments)
        types = [leaf if isinstance(leaf, jax.ShapeDtypeStruct) else type_of(leaf) for leaf in leaves]
        path = self._path(repr((form, types))) if platform in (None, jax.default_backend()) else None
        if path is None:
            jax.eval_shape(self._whole, *arguments)
            return self._whole
        if path not in self._ready:
            self._ready[path] = _read(path) or self._export(path, types, form)
        return self._ready[path]

    @cached_property
    def _contents(self) -> str | None:
        return trace_contents(self._made_of) if self._made_of else None

    def ahead(self, *types: Any) -> Callable[[], None]:
        """Trace the function in this thread, or load its cached trace, for compilation ahead of time.

        Args:
            types: shapes and types of the arguments.

        Returns:
            A function that compiles it in any thread for JAX's default device, so that the next call need not.
        """
        ready = self.prepare(*types)

        def compile_it() -> None:
            if isinstance(ready, jax.stages.Compiled):
                return
            executable = ready.lower(*types).compile()
            for path, each in self._ready.items():
                if each is ready:
                    self._ready[path] = executable

        return compile_it

    def _path(self, form: str) -> Path | None:
        """Path of the cached trace for a form of arguments; None if it is not cached."""
        folder = traces_folder()
        if folder is None or self._contents is None:
            return None
        settings = [(name, value) for name, value in jax.config.values.items() if not UNTRACED.search(name)]
        text = repr((self._contents, jax.default_backend(), native_identity(), precision(), settings, form))
        return folder / f"{hashlib.sha256(text.encode()).hexdigest()[:32]}.trace"

    def _export(self, path: Path, types: Sequence[jax.ShapeDtypeStruct], form: Any) -> Callable[..., Any]:
        """Trace the function and cache the trace; only trace it if JAX cannot export it."""
        outputs: list[Any] = []

        def of_leaves(*leaves: Any) -> list[Any]:
            found, structure = jax.tree.flatten(self._function(*form.unflatten(leaves)))
            outputs[:] = [structure]
            return found

        try:
            jitted = jax.jit(of_leaves)
            jitted.trace(*types)  # which names the libraries of native code that it calls
            program = jax.export.export(jitted, disabled_checks=_calling(known_libraries()))(*types)
            called = libraries_in(program.mlir_module_serialized)
            trace = dataclasses.replace(program, disabled_safety_checks=_calling(called)).serialize()
            described = json.dumps(describe(outputs[0])).encode()
        except ValueError:  # an operation that cannot be exported, or outputs of a class of others
            return self._whole
        kept = described + b"\n" + bytes(trace)
        write_cached(path, kept)
        return _load(kept)


def _calling(libraries: Iterable[str]) -> list[jax.export.DisabledSafetyCheck]:
    """Permission for an exported program to call libraries of native code."""
    return [jax.export.DisabledSafetyCheck.custom_call(name) for name in sorted(libraries)]


@cache
def compiler_options() -> dict[str, Any] | None:
    """XLA's options for programs of this process: `GRAPHS` on GPUs, unless XLA_FLAGS says what to record.

    None on other devices, and if this version of XLA does not know the options.
    """
    option = "xla_gpu_enable_command_buffer"
    if jax.default_backend() != "gpu" or option in os.environ.get("XLA_FLAGS", ""):
        return None
    try:
        jax.jit(lambda x: x + 1, compiler_options={option: GRAPHS}).lower(1.0).compile()
    except jax.errors.JaxRuntimeError:
        return None
    return {option: GRAPHS}


def type_of(leaf: Any) -> jax.ShapeDtypeStruct:
    """Shape and type of an array, as programs are compiled for."""
    kind = jax.typeof(leaf)
    return jax.ShapeDtypeStruct(kind.shape, kind.dtype, weak_type=kind.weak_type)


def _read(path: Path) -> Callable[..., Any] | None:
    """Load the function whose trace is in a file; None if the file is missing or unreadable, or a library of native
    code that it calls is."""
    kept = read_cached(path)
    try:
        return None if kept is None or not all(map(library_ready, libraries_in(kept))) else _load(kept)
    except Exception:  # JAX may raise anything; the trace is then made and written again
        return None


def _load(kept: bytes) -> Callable[..., Any]:
    described, _, trace = kept.partition(b"\n")
    exported, structure = jax.export.deserialize(bytearray(trace)), restore(json.loads(described))
    call = lambda *arguments: structure.unflatten(exported.call(*jax.tree.leaves(arguments)))  # noqa: E731
    return jax.jit(call, compiler_options=compiler_options())
