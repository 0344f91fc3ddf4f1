"""Fast parallel compilation, with little optimisation, of programs that run only a few times."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Final

import jax
import jax.numpy as jnp
from jax.errors import JaxRuntimeError

OPTIONS: Final = {"xla_backend_optimization_level": "0", "xla_cpu_use_fusion_emitters": False}
"""XLA options on CPUs: half the compile time of the default code generator, and fast enough for these checks."""
THREADS: Final = 2
"""Number of programs compiled at once; each takes a core and up to a gigabyte for large models."""


class Compiler:
    """Compiled programs by function and argument shapes; `start` compiles in a background thread."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(THREADS, thread_name_prefix="compile")
        self._programs: dict[Any, Future[Callable[..., Any]]] = {}

    def start(self, function: Callable[..., Any], *arguments: Any) -> Future[Callable[..., Any]]:
        """Trace the function for the shapes of the arguments, and compile it in the background."""
        shapes = jax.tree.map(lambda leaf: (jnp.shape(leaf), str(jnp.result_type(leaf))), arguments)
        key = (function, str(jax.tree.structure(arguments)), str(shapes))
        if key not in self._programs:
            lowered = jax.jit(function).lower(*arguments)
            self._programs[key] = self._pool.submit(_compile, lowered)
        return self._programs[key]

    def run(self, function: Callable[..., Any], *arguments: Any) -> Any:
        return self.start(function, *arguments).result()(*arguments)


def _compile(lowered: Any) -> Callable[..., Any]:
    if jax.default_backend() != "cpu":
        return lowered.compile()
    try:
        return lowered.compile(compiler_options=OPTIONS)
    except JaxRuntimeError:  # an XLA version without these options
        return lowered.compile()
