"""JAX-compiled functions whose traces outlive the process, since tracing a rollout's gradient takes seconds.

JAX caches what XLA compiles; the trace before it is cached here as StableHLO, keyed by a digest of everything it
depends on (`identity.trace_contents`). User-defined code may read more while it is traced: its files and environment
variables are kept with the trace, which is made again once one of them differs.

A file holds the structure of the outputs and these inputs, pickled, and the serialised StableHLO. Only this user can
read and write it, like the compiled programs and libraries beside it (`caches`).
"""

import dataclasses
import hashlib
import io
import os
import pickle
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext
from functools import cache, cached_property
from pathlib import Path
from threading import Lock
from typing import Any, Final

import jax
import jax.export

from estimators.user_inputs import inputs_now, observing, sources_and_inputs
from mjx_study.caches import read_cached, write_cached
from mjx_study.digest import Digest
from mjx_study.graph.build import known_libraries, libraries_in, library_ready
from mjx_study.graph.native import native_identity
from mjx_study.identity import trace_contents
from mjx_study.runtime import available_cores, precision, traces_folder
from mjx_study.simulation.scene import Scene
from mjx_study.tasks.task import Task
from mjx_study.watchdog import awaited

UNTRACED: Final = re.compile("cache|^jax_log|num_cpu_devices|async_dispatch")
"""JAX settings that traces do not depend on."""
GRAPHS: Final = "FUSION,CUBLAS,CUBLASLT,CUDNN,CUSTOM_CALL,DYNAMIC_SLICE_FUSION,CONDITIONAL,WHILE"
"""Operations that XLA records in CUDA graphs: its default ones and whole loops, whose steps the host would launch."""
OPTIONS: Final[dict[str, tuple[str, str]]] = {
    "gpu": ("xla_gpu_enable_command_buffer", GRAPHS),
    "cpu": ("xla_cpu_scheduler_type", "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"),
}
"""XLA's options for programs, by backend. On CPUs operations run one after the other where they can: threads call
several programs at once already, and LAPACK calls would wait for each other (`runtime.configure`)."""


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
        self._name = str(made_of[0]) if made_of else getattr(function, "__name__", "program")
        self._ready: dict[str, Callable[..., Any]] = {}
        self._traced: dict[str, tuple[Any, Callable[[], Callable[..., Any]]]] = {}
        self._begun: set[str] = set()
        self._lock = Lock()

    @cached_property
    def _whole(self) -> Callable[..., Any]:
        """The function as a program of its own."""
        return jax.jit(_named(self._function, self._name), compiler_options=compiler_options())

    def __call__(self, *arguments: Any) -> Any:
        with awaited():
            return self.executable(*arguments)(*arguments)

    def within(self, *arguments: Any) -> Callable[..., Any]:
        """The function for use within another program that JAX's default backend runs: its cached trace, which cannot
        be batched or differentiated, or else `jitted`."""
        ready = self._prepared(*self._form(arguments), arguments)
        if isinstance(ready, jax.stages.Compiled) or ready is self._whole:
            return self.jitted
        loaded: Any = ready
        return jax.jit(loaded.__wrapped__)  # XLA's options are those of the other program

    def outputs(self, *arguments: Any, platform: str | None = None) -> Any:
        """Shapes and types of the outputs, from the function's trace; see `executable` for the arguments."""
        if platform not in (None, jax.default_backend()):
            return jax.eval_shape(self._uncached(arguments), *arguments)
        key, types, form = self._form(arguments)
        self._trace(key, types, form, arguments)
        if traced := self._traced.get(key):
            return traced[0]
        ready = self._ready[key]
        return ready.out_info if isinstance(ready, jax.stages.Compiled) else jax.eval_shape(ready, *arguments)

    def ahead(self, *types: Any, options: dict[str, Any] | None = None) -> Callable[[], None]:
        """Trace the function in this thread, or load its cached trace, for compilation ahead of time.

        Args:
            types: shapes and types of the arguments.
            options: XLA's options, for versions of XLA that know them.

        Returns:
            A function that compiles it in any thread for JAX's default device, so that the next call need not; it does
            nothing if that has begun before.
        """
        return self._begin(*self._form(types), types, options)

    def executable(self, *arguments: Any, platform: str | None = None) -> Callable[..., Any]:
        """The function for arguments of this form, which threads may call in parallel, traced in this thread or loaded.

        Compiled where JAX's default device is the only one, as on CPUs, like `ahead`, whatever devices the arguments
        are on: JAX's cache holds one program for both.

        Args:
            arguments: arrays, or their shapes and types (`jax.ShapeDtypeStruct`).
            platform: platform of the devices; traces are cached for JAX's default one only.
        """
        if platform not in (None, jax.default_backend()):
            return self._uncached(arguments)
        key, types, form = self._form(arguments)
        if jax.default_backend() == "cpu":
            self._begin(key, types, form, arguments)()
        return self._prepared(key, types, form, arguments)

    def _begin(
        self,
        key: str,
        types: list[jax.ShapeDtypeStruct],
        form: Any,
        arguments: Any,
        options: dict[str, Any] | None = None,
    ) -> Callable[[], None]:
        """Trace the function, and return a function that compiles it unless that has begun before."""
        self._trace(key, types, form, arguments)
        if key in self._begun:
            return lambda: None
        self._begun.add(key)

        def compile_it() -> None:
            ready: Any = self._prepared(key, types, form, arguments)
            lowered = ready.lower(*form.unflatten(types))
            try:
                self._ready[key] = lowered.compile(options)
            except jax.errors.JaxRuntimeError:
                if options is None:
                    raise
                self._ready[key] = lowered.compile()

        return compile_it

    def _form(self, arguments: Any) -> tuple[str, list[jax.ShapeDtypeStruct], Any]:
        """Key, types and structure of the arguments' form."""
        leaves, form = jax.tree.flatten(arguments)
        types = [leaf if isinstance(leaf, jax.ShapeDtypeStruct) else type_of(leaf) for leaf in leaves]
        return self._key(repr((form, types))), types, form

    def _prepared(self, key: str, types: list[jax.ShapeDtypeStruct], form: Any, arguments: Any) -> Callable[..., Any]:
        """The function of a form of arguments, traced and lowered, and compiled if `ahead` has.

        Lowering waits for the libraries of native code that tracing has begun to build.
        """
        self._trace(key, types, form, arguments)
        with self._lock:
            if key not in self._ready:
                self._ready[key] = self._traced[key][1]()
                del self._traced[key]
        return self._ready[key]

    def _trace(self, key: str, types: list[jax.ShapeDtypeStruct], form: Any, arguments: Any) -> None:
        """Trace the function in this thread, or load its cached trace, unless that was done before."""
        if key in self._traced or key in self._ready:
            return
        path = self._path(key)
        if kept := None if path is None else _read(path, self._name):
            self._ready[key] = kept
        elif path is None or not (traced := self._exportable(path, types, form)):
            self._ready[key] = self._uncached(arguments)
        else:
            outputs, export = traced
            self._traced[key] = outputs, lambda: export() or self._uncached(arguments)

    def _uncached(self, arguments: Any) -> Callable[..., Any]:
        """The function as a program of its own, traced."""
        jax.eval_shape(self._whole, *arguments)
        return self._whole

    @cached_property
    def _contents(self) -> Digest | None:
        if not self._made_of:
            return None
        found = trace_contents(self._made_of)
        if found.opaque:
            _say_untraceable(tuple(found.opaque))
        return None if found.opaque else found

    def _key(self, form: str) -> str:
        """What this function's programs depend on besides its contents, for a form of arguments."""
        simulates = any(isinstance(each, Task | Scene) for each in self._made_of)
        settings = [(name, value) for name, value in jax.config.values.items() if not UNTRACED.search(name)]
        native = native_identity() if simulates else None
        return repr((jax.default_backend(), native, precision(), settings, form))

    def _path(self, key: str) -> Path | None:
        """Path of the cached trace for a key; None if it is not cached."""
        folder = traces_folder()
        if folder is None or self._contents is None:
            return None
        return folder / f"{hashlib.sha256(repr((self._contents.hexdigest(), key)).encode()).hexdigest()[:32]}.trace"

    def _exportable(
        self, path: Path, types: Sequence[jax.ShapeDtypeStruct], form: Any
    ) -> tuple[Any, Callable[[], Callable[..., Any] | None]] | None:
        """Trace the function. None if that fails, else its outputs' types, and what lowers the trace and caches it, in
        any thread: that gives None if JAX cannot export it."""
        assert self._contents is not None
        structures: list[Any] = []

        def of_leaves(*leaves: Any) -> list[Any]:
            found, structure = jax.tree.flatten(self._function(*form.unflatten(leaves)))
            structures[:] = [structure]
            return found

        def export() -> Callable[..., Any] | None:
            try:
                program = jax.export.export(jitted, disabled_checks=_CallingAny())(*types)
            except (ValueError, NotImplementedError):  # an operation that cannot be exported
                return None
            called = libraries_in(program.mlir_module_serialized)
            trace = dataclasses.replace(program, disabled_safety_checks=_calling(called)).serialize()
            write_cached(path, header + bytes(trace))
            return _load(header + bytes(trace), self._name)

        jitted = jax.jit(_named(of_leaves, self._name))
        try:
            with observing(path.stem) if self._contents.sources.foreign else nullcontext():
                outputs = jitted.trace(*types).out_info
            header = _header(structures[0], sources_and_inputs() if self._contents.sources.foreign else {})
        except ValueError:  # outputs that cannot be pickled
            return None
        return structures[0].unflatten(outputs), export


class Builds:
    """Programs that are compiled side by side, while this thread traces the next one; options are those of XLA."""

    def __init__(self, threads: int | None = None, options: dict[str, Any] | None = None) -> None:
        self._pool = ThreadPoolExecutor(threads or available_cores(), thread_name_prefix="compile")
        self._options, self._running = options, list[tuple[Compiled, Future[None]]]()

    def start(self, program: Compiled, *types: Any) -> None:
        """Trace a program, and begin to compile it for JAX's default device; see `Compiled.ahead`."""
        self._running.append((program, self._pool.submit(program.ahead(*types, options=self._options))))

    def wait(self, program: Compiled | None = None) -> None:
        """Wait for one program, or all, so that what is timed afterwards has the machine to itself."""
        with awaited():
            for each in [each for each in self._running if program in (None, each[0])]:
                self._running.remove(each)
                each[1].result()


def _calling(libraries: Iterable[str]) -> list[jax.export.DisabledSafetyCheck]:
    """Permission for an exported program to call libraries of native code."""
    return [jax.export.DisabledSafetyCheck.custom_call(name) for name in sorted(libraries)]


class _CallingAny(Sequence[jax.export.DisabledSafetyCheck]):
    """Permission to call any library, whose names are known only once JAX, which asks afterwards, has lowered."""

    def __getitem__(self, index: Any) -> Any:
        return _calling(known_libraries())[index]

    def __len__(self) -> int:
        return len(known_libraries())


@cache
def compiler_options() -> dict[str, Any] | None:
    """XLA's options for programs of this process: `OPTIONS`, unless XLA_FLAGS has them.

    None on other devices, and if this version of XLA does not know the options.
    """
    option, value = OPTIONS.get(jax.default_backend(), ("", ""))
    if not option or option in os.environ.get("XLA_FLAGS", ""):
        return None
    try:
        jax.jit(lambda x: x + 1, compiler_options={option: value}).lower(1.0).compile()
    except jax.errors.JaxRuntimeError:
        return None
    return {option: value}


def type_of(leaf: Any) -> jax.ShapeDtypeStruct:
    """Shape and type of an array, as programs are compiled for."""
    kind = jax.typeof(leaf)
    return jax.ShapeDtypeStruct(kind.shape, kind.dtype, weak_type=kind.weak_type)


def _named(function: Callable[..., Any], name: str) -> Callable[..., Any]:
    """The function by a name of its own, which JAX's events and messages give."""

    def program(*arguments: Any) -> Any:
        return function(*arguments)

    program.__name__ = program.__qualname__ = name.replace(" ", "_")
    return program


@cache
def _say_untraceable(opaque: tuple[str, ...]) -> None:
    """Say why programs of a task are not kept between runs."""
    print(
        f"mjx-study: {opaque[0]} holds data that cannot be digested: the task's programs are traced anew in every run",
        file=sys.stderr,
    )


def _header(structure: Any, inputs: Mapping[str, str]) -> bytes:
    """Pickle the structure of the outputs and the inputs; ValueError if the structure is not the same afterwards."""
    try:
        header = pickle.dumps((structure.unflatten(range(structure.num_leaves)), inputs))
        same = jax.tree.structure(pickle.loads(header)[0]) == structure
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ValueError(f"outputs of a class that cannot be pickled: {error}") from error
    if not same:
        raise ValueError("outputs with parts beside their leaves")
    return header


def _read(path: Path, name: str) -> Callable[..., Any] | None:
    """The function whose trace is in a file; None if this or a library it calls is unusable, or an input differs."""
    kept = read_cached(path)
    try:
        return None if kept is None or not all(map(library_ready, libraries_in(kept))) else _load(kept, name)
    except Exception:  # JAX may raise anything; the trace is then made and written again
        return None


def _load(kept: bytes, name: str) -> Callable[..., Any] | None:
    stream = io.BytesIO(kept)
    tree, inputs = pickle.load(stream)
    if inputs_now(inputs) != inputs:
        return None
    exported, structure = jax.export.deserialize(bytearray(stream.read())), jax.tree.structure(tree)
    call = lambda *arguments: structure.unflatten(exported.call(*jax.tree.leaves(arguments)))  # noqa: E731
    return jax.jit(_named(call, name), compiler_options=compiler_options())
