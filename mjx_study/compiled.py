"""Functions compiled by JAX whose traces outlive the process: tracing a rollout's gradient takes seconds.

What XLA compiles is kept by JAX; the trace that leads there is kept here beside it, as StableHLO, under a digest of all
that it is made of (`identity.trace_contents`). What rests on code from outside of this package is traced in every
process.
"""

import hashlib
import pickle
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import jax
import jax.export

from mjx_study.disk import write_whole
from mjx_study.identity import trace_contents
from mjx_study.runtime import precision, traces_folder

UNTRACED: Final = re.compile("cache|^jax_log|num_cpu_devices")
"""Settings of JAX that no trace depends on."""


class Compiled:
    """A pure function compiled by JAX, once for each form of its arguments: shapes, types and pytrees.

    Args:
        function: of this package, of arrays in pytrees.
        made_of: its name and all that it closes over, as a task: what determines its trace beside the arguments' form.
            Without it the trace is not kept.

    Attributes:
        jitted: what `jax.jit` returns, whose trace is not kept; for use inside of other programs.
    """

    def __init__(self, function: Callable[..., Any], *made_of: Any):
        self.jitted = jax.jit(function)
        self._function, self._made_of = function, made_of
        self._ready: dict[Path, Callable[..., Any]] = {}

    def __call__(self, *arguments: Any) -> Any:
        return self.prepare(*arguments)(*arguments)

    @property
    def num_compilations(self) -> int:
        """Number of forms of arguments that it was compiled for, in this process."""
        return sum(each._cache_size() for each in (self.jitted, *self._ready.values()))  # type: ignore[attr-defined]

    def prepare(self, *arguments: Any, platform: str | None = None) -> Callable[..., Any]:
        """Trace the function in this thread, or find its trace.

        Args:
            arguments: arrays, or what tells their shapes and types (`jax.ShapeDtypeStruct`).
            platform: of the devices; traces are kept for JAX's default one.

        Returns:
            The function of arguments of this form, which threads may call side by side.
        """
        leaves, form = jax.tree.flatten(arguments)
        types = [leaf if isinstance(leaf, jax.ShapeDtypeStruct) else type_of(leaf) for leaf in leaves]
        path = self._path(repr((form, types))) if platform in (None, jax.default_backend()) else None
        if path is None:
            jax.eval_shape(self.jitted, *arguments)
            return self.jitted
        if path not in self._ready:
            self._ready[path] = _read(path) or self._export(path, types, form)
        return self._ready[path]

    @cached_property
    def _contents(self) -> str | None:
        return trace_contents(self._made_of) if self._made_of else None

    def ahead(self, *types: Any) -> Callable[[], None]:
        """Trace the function in this thread, or find its trace.

        Args:
            types: shapes and types of the arguments.

        Returns:
            What compiles it, in any thread, for JAX's default device; nothing is left to do for the next call.
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
        """Where the trace for arguments of a form is kept; None if it is not."""
        folder = traces_folder()
        if folder is None or self._contents is None:
            return None
        settings = [(name, value) for name, value in jax.config.values.items() if not UNTRACED.search(name)]
        text = repr((self._contents, jax.default_backend(), precision(), settings, form))
        return folder / f"{hashlib.sha256(text.encode()).hexdigest()[:32]}.trace"

    def _export(self, path: Path, types: Sequence[jax.ShapeDtypeStruct], form: Any) -> Callable[..., Any]:
        """Trace the function and write the trace down; without it if JAX cannot export it."""
        outputs: list[Any] = []

        def of_leaves(*leaves: Any) -> list[Any]:
            found, structure = jax.tree.flatten(self._function(*form.unflatten(leaves)))
            outputs[:] = [structure.unflatten(range(len(found)))]
            return found

        try:
            trace = jax.export.export(jax.jit(of_leaves))(*types).serialize()
        except ValueError:  # an operation without a stable form
            return self.jitted
        kept = pickle.dumps((bytes(trace), outputs[0]))
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, lambda file: file.write(kept))
        return _load(kept)


def type_of(leaf: Any) -> jax.ShapeDtypeStruct:
    """What a program is compiled for, of an array."""
    kind = jax.typeof(leaf)
    return jax.ShapeDtypeStruct(kind.shape, kind.dtype, weak_type=kind.weak_type)


def _read(path: Path) -> Callable[..., Any] | None:
    """The function whose trace is in a file; None if there is none, or none that can be read."""
    try:
        return _load(path.read_bytes())
    except Exception:  # also whatever a damaged file makes of it: the trace is made and written again
        return None


def _load(kept: bytes) -> Callable[..., Any]:
    trace, outputs = pickle.loads(kept)
    exported, structure = jax.export.deserialize(bytearray(trace)), jax.tree.structure(outputs)
    return jax.jit(lambda *arguments: structure.unflatten(exported.call(*jax.tree.leaves(arguments))))
