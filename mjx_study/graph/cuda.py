"""Compile CUDA kernels by NVRTC, which comes with JAX's own wheels."""

import ctypes
import functools
import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import jax

MOST_OPTIMISED: Final = 300_000
"""Maximum length of a source [characters] that is worth full optimisation, which in longer ones spills registers."""
LESS: Final = ("--ptxas-options=-O1",)  # options for longer ones
QUICKLY: Final = "--Ofast-compile=min", "--split-compile=0"
"""Options for kernels that are `LONG`: a third of the time of `LESS`, on all cores; of NVRTC from 12.9 on."""
_INVALID_OPTION: Final = 5


@functools.cache
def nvrtc() -> Any:
    """NVIDIA's run-time compiler; None, and a line that says so, without one."""
    found = importlib.util.find_spec("nvidia")
    folders = [] if found is None else map(Path, found.submodule_search_locations or ())
    installed = (str(path) for folder in folders for path in sorted(folder.glob("*/lib/libnvrtc.so.*")))
    for name in (*installed, "libnvrtc.so", "libnvrtc.so.13", "libnvrtc.so.12"):
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    print("mjx-study: NVRTC not found: steps run through XLA, more slowly", file=sys.stderr)
    return None


@functools.cache
def target() -> str | None:
    """Version of the compiler, and architecture to compile for; None without a compiler or a GPU of NVIDIA."""
    if jax.default_backend() != "gpu" or not hasattr(jax.devices()[0], "compute_capability") or nvrtc() is None:
        return None
    major, minor = ctypes.c_int(), ctypes.c_int()
    nvrtc().nvrtcVersion(ctypes.byref(major), ctypes.byref(minor))
    capability = str(jax.devices()[0].compute_capability).replace(".", "")
    return f"{major.value}.{minor.value} sm_{capability}"


def compile_kernel(source: str, architecture: str) -> bytes:
    """Compile for an architecture, such as sm_90.

    Raises:
        ValueError: the source does not compile; the text is the compiler's.
    """
    choices = (QUICKLY, LESS) if "\n#define LONG 1\n" in source else (LESS,) if len(source) > MOST_OPTIMISED else ((),)
    for options in choices:
        status, found = _compiled(source, (f"--gpu-architecture={architecture}", "--std=c++17", "-w", *options))
        if status != _INVALID_OPTION:
            break
    if status:
        raise ValueError(found.decode(errors="replace").rstrip("\0"))
    return found


def _compiled(source: str, options: Sequence[str]) -> tuple[int, bytes]:
    """NVRTC's status with the kernel, or with its messages."""
    library, program, size = nvrtc(), ctypes.c_void_p(), ctypes.c_size_t()
    library.nvrtcCreateProgram(ctypes.byref(program), source.encode(), b"samples.cu", 0, None, None)
    try:
        given = (ctypes.c_char_p * len(options))(*map(str.encode, options))
        status = library.nvrtcCompileProgram(program, len(options), given)
        kind = "ProgramLog" if status else "CUBIN"
        getattr(library, f"nvrtcGet{kind}Size")(program, ctypes.byref(size))
        found = ctypes.create_string_buffer(size.value)
        getattr(library, f"nvrtcGet{kind}")(program, found)
        return status, found.raw
    finally:
        library.nvrtcDestroyProgram(ctypes.byref(program))
