"""Process-wide settings: precision, devices, compilation cache. Applied by an explicit call, never on import."""

import ctypes
import functools
import hashlib
import os
import platform
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import jax
import mujoco
from jax.extend.backend import clear_backends

from mjx_study.caches import check_programs
from mjx_study.choices import PRECISIONS, unknown
from mjx_study.disk import private_folder
from mjx_study.version import version_of

_TRACES: Final[list[Path]] = []
_CORES: Final[list[int]] = []
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _KEPT = -1, -3, 1 << 30  # parameters of `mallopt`, and their value [bytes]
_POOL: Final = "PJRT_NPROC"
"""Environment variable with the size of XLA's thread pools; read when JAX sets up its devices."""
THREADS: Final = 4
"""Threads of XLA's pool for each core, so that one is free whatever waits: a program has few LAPACK calls at once."""
SPLITTING: Final = "MJX_STUDY_THREADS"
"""Environment variable with the maximum number of threads over which a call of native code is split."""


def configure(*, precision: str = "float64", cpu_devices: int | None = None, cache: str | Path | None = None) -> None:
    """Set up JAX for a study and send MuJoCo's warnings to standard error; call before creating any array.

    On CPUs batches call a program from as many threads as there are cores (`local_devices`), and XLA's pool runs some
    of its operations. jaxlib 0.10 splits LAPACK calls of 200,000 operations or more over that pool and waits inside it
    for the parts, for ever if as many calls wait as it has threads: there it gets `THREADS` for each core.

    Args:
        precision: float64 or float32. Stiff contact needs float64: equivalent float32 programs of one rollout differ in
            the second digit.
        cpu_devices: number of cores that samples use; None for all.
        cache: folder for compiled programs kept between runs, which this user owns and nobody else can write to; None
            for `default_cache()`. A URL is left to JAX.

    Raises:
        ValueError: unknown precision, fewer than one device, or a `cache` that others can write to.
    """
    if precision not in PRECISIONS:
        raise ValueError(unknown("precision", precision, PRECISIONS))
    cores = available_cores() if cpu_devices is None else cpu_devices
    if cores < 1:
        raise ValueError(f"cpu_devices must be at least 1, got {cores}")
    mujoco.set_mju_user_warning(print_warning)  # not a file in the current folder
    jax.config.update("jax_enable_x64", precision == "float64")
    jax.config.update("jax_num_cpu_devices", 1)
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    os.environ.setdefault(SPLITTING, str(cores))
    if not _CORES and jax.default_backend() == "cpu" and jax.__version_info__ < (0, 11):
        _enlarge_pool(cores)
    _keep_memory()
    _CORES[:] = [cores]
    _keep_programs(cache)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


def _keep_programs(cache: str | Path | None) -> None:
    """Set the folders of compiled programs and traces; without a private one, none are kept."""
    _TRACES.clear()
    folder = default_cache() if cache is None else cache
    if isinstance(folder, str) and "://" in folder:
        jax.config.update("jax_compilation_cache_dir", folder)
        return
    kept = None
    try:
        kept = None if folder is None else private_folder(Path(folder))
    except OSError as error:
        told = f"compiled programs cannot be kept in {folder}: {error.strerror or error}"
        if cache is not None:
            raise ValueError(f"{told}; give a folder that you own and only you can write to") from error
        print(f"mjx-study: {told}", file=sys.stderr)
    jax.config.update("jax_compilation_cache_dir", None if kept is None else str(kept / "programs"))
    if kept is not None:
        check_programs(kept / "programs")
        _TRACES.append(kept / "traces")


def print_warning(message: str) -> None:
    """Print a warning of MuJoCo's on standard error, if anybody reads it."""
    with suppress(OSError, AttributeError):
        print(f"MuJoCo: {message}", file=sys.stderr)


def _keep_memory() -> None:
    """Have glibc keep up to `_KEPT` bytes of freed memory.

    XLA allocates a program's temporary arrays at every call. The system would take back those of 32 MB or more, and
    clear them page by page at the next call.
    """
    with suppress(OSError, AttributeError):
        libc = ctypes.CDLL(None)
        libc.mallopt(_TRIM_THRESHOLD, _KEPT)
        libc.mallopt(_MMAP_THRESHOLD, _KEPT)


def _enlarge_pool(cores: int) -> None:
    """Set up JAX's CPU again, with a pool of `THREADS` for each core, unless the environment says how many."""
    if _POOL in os.environ:
        return
    clear_backends()
    os.environ[_POOL] = str(THREADS * max(2, cores))
    try:
        jax.local_devices()
    finally:
        del os.environ[_POOL]


def local_devices() -> list[Any]:
    """Devices that batches are spread over: all accelerators; or the CPU, once per core as set up by `configure`."""
    found = jax.local_devices()
    return found[:1] * (_CORES[0] if _CORES else 1) if found[0].platform == "cpu" else found


def available_cores() -> int:
    """Number of cores this process may run on."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def default_cache() -> Path | None:
    """Default folder for compiled programs, `$XDG_CACHE_HOME/mjx-study/<processor>`; None without a home folder.

    Programs compiled for one processor may use instructions that another lacks, so each has its own folder.
    """
    try:
        root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:
        return None
    return root / "mjx-study" / hashlib.sha256(f"private\n{processor()}".encode()).hexdigest()[:12]


def traces_folder() -> Path | None:
    """Folder for program traces kept between runs; None unless set up by `configure`."""
    return _TRACES[0] if _TRACES else None


def libraries_folder() -> Path | None:
    """Folder for native code kept between runs: beside the traces, or in `default_cache` without them."""
    folder = _TRACES[0].parent if _TRACES else default_cache()
    return None if folder is None else folder / "native"


@functools.cache
def processor() -> str:
    """The processor's name and instructions."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    kept = {line for line in lines if line.startswith(("model name", "flags", "Features", "CPU part"))}
    return "\n".join([*sorted(kept), platform.machine()])


def precision() -> str:
    """float64 or float32, as JAX is configured."""
    return "float64" if jax.config.read("jax_enable_x64") else "float32"


def environment() -> dict[str, Any]:
    """Versions, machine, devices and precision: what results depend on besides their configuration."""
    names = ("mjx-study", "mujoco", "mujoco-mjx", "jax", "jaxlib", "numpy")
    models = [line.split(":", 1)[1].strip() for line in processor().splitlines() if line.startswith("model name")]
    return {
        "versions": {name: version_of(name) for name in names},
        "python": platform.python_version(),
        "processor": models[0] if models else platform.machine(),
        "cores": available_cores(),
        "devices": [str(device) for device in local_devices()],
        "backend": jax.default_backend(),
        "device_kind": jax.local_devices()[0].device_kind,
        "precision": precision(),
    }
