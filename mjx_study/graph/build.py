"""Build C into libraries for this processor, once: by the system's compiler, into a cache checked before it is used.

A library's name is a digest of everything that it depends on: source, compiler, flags, processor and version of XLA's
interface.
"""

import ctypes
import functools
import hashlib
import itertools
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

import jax
import jax.ffi

from mjx_study.caches import read_cached, write_cached
from mjx_study.disk import temporary_folder
from mjx_study.graph import cuda, numpy_code
from mjx_study.graph.c import SHARE
from mjx_study.runtime import available_cores, libraries_folder, processor
from mjx_study.version import version_of
from mjx_study.watchdog import elsewhere

FLAGS: Final = (
    *("-std=gnu11", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-fwrapv"),
    *("-shared", "-fPIC", "-w"),
)
LONG: Final = 1_000_000
"""Characters from which a source is built by `QUICKLY`: a quadruped runs as fast, `landing` 10 to 25 % slower."""
QUICKLY: Final = "-O1", "-fschedule-insns2"
"""Three quarters of the time of `WELL` [gcc 12]."""
WELL: Final = ("-O2",)
MOST_SECONDS: Final = 600
"""Maximum time for a compiler to run [s]."""
PREFIX: Final = "mjx_study_"  # beginning of the names of libraries, which are those of their XLA targets

_BUILT: Final[dict[str, Future[Any]]] = {}
"""Handlers by name, None where the build failed; their libraries stay loaded."""
_LOCK: Final = threading.Lock()
_AT_ONCE: Final = threading.BoundedSemaphore(available_cores())


@functools.cache
def compiler() -> tuple[tuple[str, ...], str] | None:
    """Command and version of a C compiler: `$CC`, the system's cc, gcc or clang, or Zig from PyPI. None, and a line
    that says so, without one."""
    named = [shlex.split(each) for each in (os.environ.get("CC"), "cc", "gcc", "clang") if each]
    for words in (*named, [sys.executable, "-m", "ziglang", "cc"]):
        if shutil.which(words[0]) and (found := _run(*words, "--version")).returncode == 0:
            return tuple(words), found.stdout
    print(
        "mjx-study: no C compiler found: steps run more slowly, on CPUs in NumPy; the extra `compiler` brings one",
        file=sys.stderr,
    )
    return None


def _command() -> tuple[str, ...]:
    found = compiler()
    return found[0] if found else ("cc",)


@functools.cache
def build_identity(in_numpy: bool = False) -> str:
    """Digest of what libraries, or sources that NumPy runs, depend on besides their source."""
    if in_numpy:
        return _digest(sys.version, version_of("numpy"), version_of("jaxlib"))
    return _digest(
        compiler(), QUICKLY, WELL, _flags_here(), processor(), cuda.target(), cuda.QUICKLY, version_of("jaxlib")
    )


@functools.cache
def _flags_here() -> tuple[str, ...]:
    """Flags for this machine; `LIBMVEC` where glibc's functions of vectors are complete, which are then loaded."""
    processor = "-mcpu=native" if os.uname().machine in ("arm64", "aarch64") else "-march=native"
    try:
        vectorial = hasattr(ctypes.CDLL("libmvec.so.1", mode=ctypes.RTLD_GLOBAL), "_ZGVdN4v_tanh")
    except OSError:
        vectorial = False
    return processor, *FLAGS, *(["-DLIBMVEC"] if vectorial else [])


def _digest(*parts: Any) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:40]


def build_library(source: str) -> str:
    """Begin to build a library in the background, unless it is known, and return its name."""
    name = PREFIX + _digest(source, build_identity(source.startswith(numpy_code.BEGINNING)))
    with _LOCK:
        if name not in _BUILT:
            _BUILT[name] = future = Future()
            threading.Thread(target=_finish, args=(name, source, future), daemon=True).start()
    return name


def library_ready(name: str) -> bool:
    """Wait for a library to be built and loaded; whether that succeeded."""
    with _LOCK:
        if name not in _BUILT:
            _BUILT[name] = future = Future()
            future.set_result(_cached(name))
    return _BUILT[name].result() is not None


def known_libraries() -> list[str]:
    """Names of all libraries that this process has begun to build, or loaded."""
    return list(_BUILT)


def libraries_pending() -> int:
    """Number of libraries that are being built."""
    return sum(not each.done() for each in list(_BUILT.values()))


def libraries_in(content: bytes) -> set[str]:
    """Names of the libraries that an exported program calls."""
    return {found.decode() for found in re.findall(rf"{PREFIX}[0-9a-f]{{40}}".encode(), content)}


def _finish(name: str, source: str, future: Future[Any]) -> None:
    found = None
    try:
        found = _cached(name) or _build(name, source)
    except RuntimeError as error:
        if "interpreter shutdown" not in str(error):  # no thread begins any more
            raise
    finally:
        future.set_result(found)


def _build(name: str, source: str) -> Any:
    if source.startswith(numpy_code.BEGINNING):
        return _kept(name, source.encode())
    with temporary_folder() as folder:
        written, library = Path(folder, f"{name}.c"), Path(folder, f"{name}.so")
        written.write_text(source)
        with elsewhere():
            if (target := cuda.target()) is not None:
                try:
                    with _AT_ONCE:
                        kernel = cuda.compile_kernel(source, target.split()[1])
                    Path(folder, "kernel").write_bytes(kernel)
                except ValueError as error:
                    return _failed(written, "NVRTC", str(error))
            done = _compiled(source, library)
        if done.returncode:
            return _failed(written, shlex.join(_command()), done.stderr)
        content = library.read_bytes()
    return _kept(name, content)


def _compiled(source: str, library: Path) -> subprocess.CompletedProcess[str]:
    """Compile the shares of a source, at once as far as there are cores, and link them."""
    flags = *_command(), *(WELL if len(source) < LONG else QUICKLY), *_flags_here(), f"-I{jax.ffi.include_dir()}"
    folder, (head, *shares) = library.parent, source.split(SHARE)

    def one(number: int, share: str) -> subprocess.CompletedProcess[str]:
        Path(folder, f"{number}.c").write_text(head + share)
        return _run(*flags, "-c", f"{number}.c", folder=folder)

    with ThreadPoolExecutor(available_cores()) as pool:
        done = list(pool.map(one, itertools.count(), shares or [""]))
    objects = (f"{number}.o" for number in range(len(done)))
    failed = next((each for each in done if each.returncode), None)
    return failed or _run(*flags, *objects, "-o", library.name, "-lm", "-ldl", folder=folder)


def _kept(name: str, content: bytes) -> Any:
    """Load a library, and keep it in the cache."""
    if (at := libraries_folder()) is not None:
        write_cached(at / name, content)
    return _loaded(name, content)


def _failed(written: Path, compiler: str, errors: str) -> None:
    """Keep a source that failed to compile, with the compiler's errors at its end, unless the process is ending."""
    if not written.exists():
        return
    kept = Path(tempfile.mkdtemp(prefix="mjx-study-failed-"), written.name)
    kept.write_text(written.read_text() + "".join(f"\n// {line}" for line in errors.splitlines()))
    print(f"mjx-study: {compiler} failed: see the end of {kept}", file=sys.stderr)


def _run(*command: str, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    try:
        with _AT_ONCE:
            return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=MOST_SECONDS)
    except (OSError, subprocess.TimeoutExpired) as error:
        return subprocess.CompletedProcess(command, 1, "", str(error))


def _cached(name: str) -> Any:
    at = libraries_folder()
    content = None if at is None else read_cached(at / name)
    return None if content is None else _loaded(name, content)


def _loaded(name: str, content: bytes) -> Any:
    """Load a library, register its handler with XLA, and return it; None if that fails."""
    if content.startswith(numpy_code.BEGINNING.encode()):
        library = numpy_code.Library(content.decode())
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(library.handler), platform="cpu")
        return library
    with temporary_folder() as folder:  # the file whose digest was checked, whatever becomes of the one in the cache
        path = Path(folder, f"{name}.so")
        path.write_bytes(content)
        try:
            library = ctypes.CDLL(str(path))
            on_gpu = cuda.target() is not None
            if on_gpu and (error := library.prepare()):
                raise OSError(f"error {error} of the CUDA driver")
            jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(library.handler), platform="CUDA" if on_gpu else "cpu")
        except (OSError, AttributeError, jax.errors.JaxRuntimeError) as error:
            print(f"mjx-study: native code cannot be loaded: {error}", file=sys.stderr)
            return None
    return library
