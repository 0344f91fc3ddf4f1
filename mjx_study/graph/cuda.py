"""Compile CUDA kernels by NVRTC, which comes with JAX's own wheels."""

import ctypes
import functools
import importlib.util
import sys
from pathlib import Path
from typing import Any, Final

import jax

MOST_OPTIMISED: Final = 300_000
"""Maximum length of a source [characters] that is worth full optimisation, which in longer ones spills registers."""


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


def compile_kernel(source: str) -> bytes:
    """Compile for the GPU of `target`.

    Raises:
        ValueError: the source does not compile; the text is the compiler's.
    """
    library, program, size = nvrtc(), ctypes.c_void_p(), ctypes.c_size_t()
    _, architecture = (target() or "").split()
    options = [f"--gpu-architecture={architecture}", "--std=c++17"]
    options += ["--ptxas-options=-O1"] if len(source) > MOST_OPTIMISED else []
    library.nvrtcCreateProgram(ctypes.byref(program), source.encode(), b"samples.cu", 0, None, None)
    try:
        given = (ctypes.c_char_p * len(options))(*map(str.encode, options))
        if library.nvrtcCompileProgram(program, len(options), given):
            library.nvrtcGetProgramLogSize(program, ctypes.byref(size))
            log = ctypes.create_string_buffer(size.value)
            library.nvrtcGetProgramLog(program, log)
            raise ValueError(log.value.decode(errors="replace"))
        library.nvrtcGetCUBINSize(program, ctypes.byref(size))
        kernel = ctypes.create_string_buffer(size.value)
        library.nvrtcGetCUBIN(program, kernel)
        return kernel.raw
    finally:
        library.nvrtcDestroyProgram(ctypes.byref(program))
