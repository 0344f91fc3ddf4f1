"""Settings that every test runs under: float64, batches on two cores, and reuse of random keys as an error."""

import ctypes
import gc
import os
import pkgutil
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax
import psutil
import pytest
from jaxtyping import install_import_hook

# Compilation is most of a test's time, and rounding does not matter: no optimisation, and XLA's plain emitters, which
# compile twice as fast as those of fusions. Subprocesses inherit it. XLA reads it when the first array is made, and
# aborts at a flag that it does not know.
FLAGS = [
    "--xla_backend_optimization_level=0",
    "--xla_cpu_parallel_codegen_split_count=1",
    *(["--xla_cpu_use_fusion_emitters=false"] if jax.__version_info__ < (0, 11) else []),
]
os.environ["XLA_FLAGS"] = " ".join([*FLAGS, os.environ.get("XLA_FLAGS", "")])

# Tracing makes millions of objects that live on; looking for garbage among them was a sixth of its time.
gc.set_threshold(1_000_000, 20, 50)

CACHE = os.environ.get("JAX_COMPILATION_CACHE_DIR") or str(Path(__file__).parents[1] / ".pytest_cache" / "jax")
SETTINGS = {
    "jax_enable_x64": True,
    "jax_debug_key_reuse": True,
    "jax_compilation_cache_dir": CACHE,
    "jax_persistent_cache_min_compile_time_secs": 0.5,
}
MOST = 4 * 2**30
"""Bytes of a process that keeps what it compiled."""
os.environ["PJRT_NPROC"], os.environ["MJX_STUDY_THREADS"] = "8", "2"  # as `configure` sets them on two cores
jax.config.update("jax_num_cpu_devices", 1)
jax.config.update("jax_cpu_enable_async_dispatch", False)
for name, value in SETTINGS.items():
    jax.config.update(name, value)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--no-types", action="store_true", help="do not check types and array shapes at run time")


def pytest_configure(config: pytest.Config) -> None:
    """Check types and array shapes in both packages, but for graphs, whose functions are called for every scalar."""
    if not config.getoption("--no-types"):
        modules = pkgutil.iter_modules([str(Path(__file__).parents[1] / "mjx_study")])
        checked = [f"mjx_study.{module.name}" for module in modules if module.name != "graph"]
        install_import_hook(["estimators", *checked], "beartype.beartype")


@pytest.fixture(scope="module", autouse=True)
def settings() -> Iterator[None]:
    """Each module begins with the same settings, and commands keep them: JAX takes its devices once per process."""
    from mjx_study import runtime  # not above: type checking is switched on after this file is imported
    from mjx_study.cli import options

    for name, value in SETTINGS.items():
        jax.config.update(name, value)
    runtime._TRACES.clear()
    runtime._CORES[:] = [2]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(options, "configure", lambda **_: None)
        yield


@pytest.fixture
def compilations() -> Iterator[list[str]]:
    """Names of the programs that XLA compiles during a test."""
    names: list[str] = []

    def compiled(event: str, duration_secs: float, **named: Any) -> None:
        if event.endswith("backend_compile_duration"):
            names.append(named["fun_name"])

    jax.monitoring.register_event_duration_secs_listener(compiled)
    yield names
    jax.monitoring.unregister_event_duration_listener(compiled)


@pytest.fixture(scope="module", autouse=True)
def memory(programs: tuple[dict[Any, Any], dict[Any, Any]]) -> Iterator[None]:
    """What is compiled is dropped between modules once this process has grown: all modules together need 20 GB.

    That takes seconds. The C library returns what is freed, so that it is not done again after every module.
    """
    yield
    if psutil.Process().memory_info().rss > MOST:
        for kept in programs:
            kept.clear()
        jax.clear_caches()
        gc.collect()
        with suppress(OSError, AttributeError):  # glibc alone has it
            ctypes.CDLL(None).malloc_trim(0)


@pytest.fixture(scope="session")
def programs() -> tuple[dict[Any, Any], dict[Any, Any]]:
    """Tasks and simulators that `shared_programs` has made."""
    return {}, {}


@pytest.fixture(scope="module")
def shared_programs(programs: tuple[dict[Any, Any], dict[Any, Any]]) -> Iterator[None]:
    """Studies that need the same task and chunk size share them with all that is compiled."""
    from mjx_study.experiment import descent_rollouts, plan, sampling
    from mjx_study.options.configuration import BUILDER_OPTIONS
    from mjx_study.runtime import precision  # not above: type checking is switched on after this file is imported
    from mjx_study.tasks import TASKS

    build, make = plan._build, sampling.Simulator
    tasks, simulators = programs

    def built(config: Any, which: Any, timestep: float | None, cone: str | None, given: Any) -> Any:
        if not isinstance(which, str) or which not in TASKS:
            return build(config, which, timestep, cone, given)
        own = [getattr(config, name) for name in BUILDER_OPTIONS]
        key = (which, timestep, cone, *own, config.onset, config.noise, precision())
        key = (*key, plan.task_with_options)  # which a test may replace
        if key not in tasks:
            tasks[key] = build(config, which, timestep, cone, given)
        return tasks[key]

    def made(task: Any, *, chunk_size: int) -> Any:
        if not any(task is each for each in tasks.values()):
            return make(task, chunk_size=chunk_size)
        if (id(task), chunk_size) not in simulators:
            simulators[id(task), chunk_size] = make(task, chunk_size=chunk_size)
        return simulators[id(task), chunk_size]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "_build", built)
        for module in (sampling, descent_rollouts):
            patch.setattr(module, "Simulator", made)
        yield


@pytest.fixture
def natively(monkeypatch: pytest.MonkeyPatch) -> None:
    """Native code, also where all tests run without."""
    from mjx_study.graph.native import SWITCH  # not above, for the same reason

    monkeypatch.delenv(SWITCH, raising=False)


@pytest.fixture
def stubbed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cells of gradients take no time, and their numbers are NaN."""
    from tests.documents import planned_arrays, stub_cells  # not above, for the same reason

    stub_cells(monkeypatch, planned_arrays)


@pytest.fixture(scope="module")
def workers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A client of two workers, which tell in a file what they compute of the task `poison`."""
    from mjx_study.execution.cluster import connected
    from tests.poison import ACCOUNT

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(ACCOUNT, str(tmp_path_factory.mktemp("account") / "account"))
        with connected("local:2") as client:
            yield client
