"""Native code computes what JAX's operations do, for batches of any size, and does without where it must."""

import concurrent.futures.thread
import ctypes
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jax import lax
from mujoco import mjx

import mjx_study
from mjx_study import runtime
from mjx_study.graph import build, c, cuda, native, random
from mjx_study.graph.function import capture
from mjx_study.graph.native import SWITCH, computes_steps, native_identity, native_summary
from mjx_study.graph.nodes import ELEMENTWISE
from mjx_study.graph.scalars import unrolled
from mjx_study.runtime import SPLITTING
from mjx_study.simulation.dynamics import initial_state, step
from mjx_study.simulation.scene import put_scene
from tests.test_graph import FUNCTIONS, ROW, descent

pytestmark = pytest.mark.skipif(native_identity() is None, reason="there is no C compiler")

EXTREME = [1e300, -1e300, 5e-324, -1e-310, np.inf, -np.inf, np.nan]
SPECIAL = [0.0, -0.0, 1.0, -1.0, 2.0, 0.3, -0.7, 2.5, -2.5, 3.5, *EXTREME]
UNIT = [0.0, -0.0, 1.0, -1.0, 0.3, -0.7, 1e-9, 5e-324, np.nan, 1.5]
INTEGERS = [0, 1, -1, 7, -7, 2**31 - 1, -(2**31)]
FLOATS = {
    **{name: getattr(lax, name) for name in ("abs", "acos", "asin", "atan", "ceil", "cos", "cosh", "erf", "exp")},
    **{name: getattr(lax, name) for name in ("expm1", "floor", "is_finite", "log", "log1p", "logistic", "neg")},
    **{name: getattr(lax, name) for name in ("rsqrt", "sign", "sin", "sinh", "sqrt", "square", "tan", "tanh")},
    "bitcast": lambda x: lax.bitcast_convert_type(x, f"uint{8 * x.dtype.itemsize}"),
    "round": lambda x: (lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN), lax.round(x)),
    "integer_pow": lambda x: tuple(lax.integer_pow(x, y) for y in (-3, -1, 0, 1, 2, 5, 8)),
    "convert_element_type": lambda x: tuple(
        lax.convert_element_type(x, kind) for kind in ("int32", "uint8", "bool", "float32", "int64")
    ),
    "clamp": lambda x: lax.clamp(x.dtype.type(-1), x, x.dtype.type(2)),
}
PAIRS = {
    **{name: getattr(lax, name) for name in ("add", "sub", "mul", "div", "max", "min", "rem", "pow", "atan2")},
    **{name: getattr(lax, name) for name in ("eq", "ne", "lt", "le", "gt", "ge")},
    "add_any": lambda x, y: jax.jvp(lambda z: z * z, (x,), (y,)),
    "select_n": lambda x, y: lax.select_n(x > y, x, y),
}
WHOLE = {
    **{name: getattr(lax, name) for name in ("add", "sub", "mul", "div", "max", "min", "rem", "eq", "lt", "ge")},
    "and": lax.bitwise_and,
    "or": lax.bitwise_or,
    "xor": lax.bitwise_xor,
    "of one": lambda x, _: (abs(x), -x, ~x, jnp.sign(x), x.astype(float), x.astype(bool)),
    "one of three": lambda x, y: lax.select_n(x % 3, x, y, -x),
    "booleans": lambda x, y: ((x > y) == (y > 1), (x > y) < (y > 1), jnp.maximum(x > y, y > 1), (x > y) ^ (x > 1)),
}


def compare(function, *points, rtol=1e-12):
    """The function under `vmap`, in C, in NumPy and in JAX's operations."""
    with pytest.MonkeyPatch.context() as patch:
        found = []
        for switch in ("1", "0", "xla"):
            patch.setenv(SWITCH, switch)
            assert computes_steps() == {"1": "native", "0": "NumPy", "xla": "XLA"}[switch]
            program = jax.jit(jax.vmap(lambda *each: unrolled(function, *each)))
            assert ("native" in str(jax.make_jaxpr(program)(*points))) == (switch != "xla")
            found.append(jax.tree_util.tree_leaves_with_path(program(*points)))
    for *ours, (path, theirs) in zip(*found, strict=True):
        for _, each in ours:
            assert each.dtype == theirs.dtype
            name, least = jax.tree_util.keystr(path), 1e-300 if rtol < 1e-9 else 1e-37
            np.testing.assert_allclose(each, theirs, rtol=rtol, atol=least, err_msg=name)


def compare_table(table, points_of, rtol=1e-12):
    """All functions of a table in one program, each of its own points; those of fewer points have some twice."""
    points = {name: [np.asarray(each) for each in points_of(name)] for name in table}
    most = max(len(each) for given in points.values() for each in given)
    points = {name: [np.resize(each, most) for each in given] for name, given in points.items()}
    compare(lambda given: {name: function(*given[name]) for name, function in table.items()}, points, rtol=rtol)


def square(values):
    """All pairs of some values."""
    return [np.ravel(each) for each in np.meshgrid(values, values)]


def test_every_operation_is_covered():
    assert {*FLOATS, *PAIRS, *WHOLE, "not", "shift_left", "shift_right_logical"} >= ELEMENTWISE


@pytest.mark.parametrize(("kind", "rtol"), [(np.float64, 1e-12), (np.float32, 1e-5)])
def test_operations_of_floats(kind, rtol):
    def points_of(name):
        points = np.asarray(UNIT if name in ("acos", "asin") else SPECIAL)
        if name == "log":  # of a subnormal number XLA's is that of 0
            points = points[~((points != 0) & (np.abs(points) < 1e-300))]
        with np.errstate(over="ignore"):
            return [points.astype(kind)]

    compare_table(FLOATS, points_of, rtol)


@pytest.mark.parametrize(("kind", "rtol"), [(np.float64, 1e-12), (np.float32, 1e-5)])
def test_operations_of_two_floats(kind, rtol):
    def points_of(name):
        x, y = square(SPECIAL)
        kept = np.ones(x.shape, bool)
        with np.errstate(all="ignore"):
            if name in ("pow", "atan2"):  # of subnormal numbers, which XLA takes for 0, NumPy has values
                kept = ~np.isin([x, y], [5e-324, -1e-310]).any(0)
            if name == "rem":  # XLA from JAX 0.11 on gives NaN where a quotient overflows
                kept = np.abs(x / y) < 1e15
            return [each[kept].astype(kind) for each in (x, y)]

    compare_table(PAIRS, points_of, rtol)


@pytest.mark.parametrize("kind", ["uint64", "uint32", "uint16"])
def test_shifts(kind):
    most = np.iinfo(kind).max
    shifts = lambda x: (x << np.dtype(kind).type(5), x >> np.dtype(kind).type(9), x + x)  # noqa: E731
    compare(shifts, np.array([0, 1, 77, most // 3, most - 1, most], kind))


@pytest.mark.usefixtures("natively")
@pytest.mark.parametrize("size", [1, 6, 35, 400])
def test_normal_random_numbers(size):
    """Of the same keys as JAX's, to the rounding of XLA's polynomial, and the same in every batch."""
    data = np.asarray(jax.random.key_data(jax.random.split(jax.random.key(7), 500)))
    ours, theirs = (
        jax.jit(jax.vmap(lambda each, draw=draw: draw(jax.random.wrap_key_data(each), (size,), np.float64)))
        for draw in (random.normal, jax.random.normal)
    )
    assert "native" in str(jax.make_jaxpr(ours)(data))
    drawn = ours(data)
    np.testing.assert_allclose(drawn, theirs(data), rtol=1e-13)
    np.testing.assert_array_equal(ours(data[17:20]), drawn[17:20])


@pytest.mark.parametrize("shape", ["sphere", "cylinder"])
def test_gradients_of_contact_with_a_cylinder_are_native(shape: str) -> None:
    """MJX places its contacts by derivatives of a distance, so that gradients take second ones."""
    ball = f'<body pos="0 0 .19"><joint type="slide" axis="0 0 1"/><geom type="{shape}" size=".1 .1"/></body>'
    log = '<geom type="cylinder" size=".1 .1" euler="90 0 0"/>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{log}{ball}</worldbody></mujoco>")
    scene, before = put_scene(model, shape), native_summary().partition(",")[2]
    start = initial_state(scene)
    force = lambda state: jnp.sum(step(scene, scene.model, state, jnp.zeros(0))[0].qvel)  # noqa: E731
    found = jax.jit(jax.vmap(jax.grad(force)))(jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), start))
    assert native_summary().partition(",")[2] == before and np.abs(found.qpos).max() > 1


def test_normal_random_numbers_of_the_tails():
    x = np.concatenate([1 - np.geomspace(2.0**-53, 0.5, 200), np.linspace(-0.999, 0.999, 201)])
    np.testing.assert_allclose(random._erf_inv(x), lax.erf_inv(x), rtol=1e-13)


@pytest.mark.parametrize("kind", ["int64", "int32", "int8", "uint16"])
def test_operations_of_integers(kind):
    compare_table(WHOLE, lambda name: square(np.array(INTEGERS).astype(kind)))


@pytest.mark.parametrize(
    "name", ["loops", "loop of known length", "several computed indices", "whole arrays", "computed slice"]
)
@pytest.mark.parametrize("most", [10, 20])
def test_long_functions_are_divided(monkeypatch, name, most):
    """And their parts compiled in several files."""
    monkeypatch.setitem(c.MOST_TOGETHER, "cpu", (most, most))
    monkeypatch.setattr(c, "MOST_IN_SHARE", 20 * most)
    points = np.random.default_rng(0).normal(size=(9, 3))
    function = lambda x: jax.tree.map(lambda leaf: leaf + most, FUNCTIONS[name](x))  # noqa: E731
    source = c.source_of(capture(function, jax.ShapeDtypeStruct((3,), float), most=10**5))
    assert source.count("PART void part") > 2 and source.count(c.SHARE) > 1  # each part is declared and defined
    compare(function, points)


def test_what_a_sample_gives_depends_on_no_other():
    """Bitwise, whatever the batch, where loops end at different times."""
    points = np.random.default_rng(0).normal(size=(37, 3)) * np.geomspace(1e-3, 1e3, 37)[:, None]
    program = jax.jit(jax.vmap(lambda x: unrolled(FUNCTIONS["loops"], x)))
    roots, counts = program(points)
    assert len(np.unique(counts)) > 3
    for part in (slice(0, 1), slice(3, 12), slice(30, 37), slice(None, None, -1)):
        np.testing.assert_array_equal(program(points[part])[0], roots[part])
    np.testing.assert_array_equal(jax.jit(lambda x: unrolled(FUNCTIONS["loops"], x))(points[5])[0], roots[5])


@pytest.mark.parametrize("samples", [4803, 4800, 8 * 4803])
def test_threads_share_large_batches(samples: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bitwise the same, also where the last vector overlaps another share's, and with an input that all share."""

    def function(x, y):
        for _ in range(500):
            x = jnp.sin(x) + y
        return x, x[:1] > 0

    program = jax.jit(jax.vmap(lambda x, y: unrolled(function, x, y), (0, None)))
    points = np.random.default_rng(0).normal(size=(samples, 1))
    monkeypatch.setenv(SPLITTING, "1")
    alone = program(points, ROW[:1])
    for threads in (2, 3, 100):
        monkeypatch.setenv(SPLITTING, str(threads))
        for _ in range(5):
            for ours, theirs in zip(program(points, ROW[:1]), alone, strict=True):
                np.testing.assert_array_equal(ours, theirs)


def test_batches_of_batches_and_what_does_not_vary():
    def function(x, y):
        return jnp.outer(jnp.sin(x), y), jnp.sum(x) > y[0]

    here = lambda x, y: unrolled(function, x, y)  # noqa: E731
    x, y = np.random.default_rng(0).normal(size=(2, 5, 4, 3))
    for axes, given in [
        (((0, None), (0, None)), (x, ROW)),
        (((0, None), (None, 0)), (x, y[0])),
        (((None, 0), (0, None)), (x[0], y[:, 0])),
        (((1, 1), (0, 1)), (x, y.swapaxes(0, 2))),
    ]:
        for ours, theirs in zip(
            jax.jit(jax.vmap(jax.vmap(here, axes[1]), axes[0]))(*given),
            jax.vmap(jax.vmap(function, axes[1]), axes[0])(*given),
            strict=True,
        ):
            np.testing.assert_allclose(ours, theirs, rtol=1e-15)


@pytest.fixture
def folder(monkeypatch, tmp_path):
    """An empty cache of libraries, in a process that knows none."""
    monkeypatch.setattr(runtime, "_TRACES", [tmp_path / "traces"])
    monkeypatch.setattr(build, "_BUILT", {})
    return tmp_path / "native"


def source(factor):
    return c.source_of(capture(lambda x: x * factor, jax.ShapeDtypeStruct((3,), float), most=9))


def test_a_library_is_built_once_and_kept(folder, monkeypatch):
    name = build.build_library(source(2.5))
    assert build.library_ready(name)
    assert [path.name for path in folder.iterdir()] == [name] and folder.stat().st_mode & 0o077 == 0
    monkeypatch.setattr(build, "_BUILT", {})
    monkeypatch.setattr(build, "_loaded", lambda *given: given)
    monkeypatch.setattr(build, "_build", None)
    assert build.build_library(source(2.5)) == name
    assert build.library_ready(name)


@pytest.mark.parametrize(
    ("factor", "damage"), [(3.5, lambda path: path.write_bytes(path.read_bytes()[:-1] + b"?")), (4.5, os.unlink)]
)
def test_a_damaged_library_is_built_again(folder, monkeypatch, factor, damage):
    name = build.build_library(source(factor))
    assert build.library_ready(name)
    damage(folder / name)
    monkeypatch.setattr(build, "_BUILT", {})
    monkeypatch.setattr(build, "_loaded", lambda *given: given)
    assert not build.library_ready(name)
    monkeypatch.setattr(build, "_BUILT", {})
    assert build.library_ready(build.build_library(source(factor)))
    assert (folder / name).exists()


def test_threads_share_a_build(folder, monkeypatch):
    built = []
    monkeypatch.setattr(build, "_build", lambda name, source: built.append(name) or name)
    with ThreadPoolExecutor(8) as pool:
        names = list(pool.map(build.build_library, [source(5.5)] * 8))
        assert all(pool.map(build.library_ready, names))
    assert len(set(names)) == len(built) == 1


def test_a_failing_compiler_is_reported_and_done_without(folder, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(build.tempfile, "tempdir", str(tmp_path))
    name = build.build_library("this is not C")
    assert not build.library_ready(name)
    told = capsys.readouterr().err
    assert "failed: see the end of" in told and "XLA" not in told
    kept = told.strip().rpartition(" ")[2]
    assert "this is not C\n// " in Path(kept).read_text()
    monkeypatch.setattr(native, "library_ready", lambda name: False)
    found = jax.jit(jax.vmap(lambda x: unrolled(lambda x: x**3 + 7, x)))(ROW)
    np.testing.assert_allclose(found, ROW**3 + 7)


def test_a_process_that_ends_begins_no_compiler(folder, monkeypatch, capsys):
    """And its threads say nothing."""
    monkeypatch.setattr(concurrent.futures.thread, "_shutdown", True)
    assert not build.library_ready(build.build_library(source(6.5)))
    assert capsys.readouterr().err == ""


def test_each_function_that_is_left_is_counted_once(monkeypatch):
    monkeypatch.setattr(native, "_LEFT", native.Counter())
    with native.postponed():
        lowered = jax.jit(jax.vmap(lambda x: unrolled(lambda y: jnp.fft.fft(y).real, x))).lower(np.ones((2, 3)))
    assert "native" not in lowered.as_text() and native._LEFT == {"values of type complex128": 1}


ALONE = """
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
from mjx_study.graph.native import native_summary
from mjx_study.graph.scalars import unrolled
print(jax.make_jaxpr(jax.vmap(lambda x: unrolled(lambda x: x * 2, x)))(np.ones(3)))
found = jax.jit(jax.vmap(lambda x: unrolled(lambda x: x * 2, x)))(np.ones(3))
print(native_summary())
print(found)
"""


@pytest.mark.parametrize(
    ("setting", "lines", "in_xla"),
    [({"PATH": "/nowhere"}, 1, False), ({SWITCH: "0"}, 0, False), ({SWITCH: "xla"}, 0, True)],
)
def test_without_a_compiler(setting, lines, in_xla):
    environment = {key: value for key, value in os.environ.items() if key not in ("CC", SWITCH)} | setting
    done = subprocess.run([sys.executable, "-c", ALONE], capture_output=True, text=True, env=environment)
    assert done.stdout.splitlines()[-2:] == [f"{0 if in_xla else 1} libraries", "[2. 2. 2.]"]
    assert ("native" not in done.stdout) == in_xla
    assert done.stderr.count("mjx-study: no C compiler found: steps run more slowly, on CPUs in NumPy") == lines


def test_with_a_compiler_that_fails(tmp_path):
    compiler = tmp_path / "cc"
    compiler.write_text('#!/bin/sh\n[ "$1" = --version ]\n')
    compiler.chmod(0o700)
    environment = {key: value for key, value in os.environ.items() if key != SWITCH}
    environment |= {name: str(tmp_path) for name in ("XDG_CACHE_HOME", "TMPDIR")} | {"CC": str(compiler)}
    done = subprocess.run([sys.executable, "-c", ALONE], capture_output=True, text=True, env=environment)
    assert "native" in done.stdout and done.stdout.endswith("\n1 libraries\n[2. 2. 2.]\n")
    failure, instead = done.stderr.splitlines()
    assert f"{compiler} failed: see the end of" in failure and "XLA" not in failure
    assert instead == "mjx-study: steps run more slowly, on CPUs in NumPy"


def test_the_compiler_from_pypi(tmp_path):
    """The package's module runs a compiler with the arguments after `cc`, as Zig's does."""
    (word, *_), _ = build.compiler() or (("",), "")
    real, path = shutil.which(word), os.environ["PATH"]
    script = f"import os, sys\nos.environ['PATH'] = {path!r}\nos.execv({real!r}, [{real!r}, *sys.argv[2:]])\n"
    (tmp_path / "ziglang").mkdir()
    (tmp_path / "ziglang" / "__main__.py").write_text(script)
    environment = {key: value for key, value in os.environ.items() if key != "CC"} | {
        "PATH": "/nowhere",
        "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path]),
        "XDG_CACHE_HOME": str(tmp_path / "cache"),
    }
    done = subprocess.run([sys.executable, "-c", ALONE], capture_output=True, text=True, env=environment)
    assert "native" in done.stdout and "\n1 libraries\n" in done.stdout and not done.stderr


UNTOUCHED = 0x7FF123456789ABCD
BLOCK_ON_CPU = """
#include <math.h>
#include <string.h>
#define __CUDACC_RTC__
#define __device__
#define __global__
#define __forceinline__ inline
#define __noinline__
#define __grid_constant__
#define __align__(size) __attribute__((aligned(size)))
#define __launch_bounds__(threads)
static float __int_as_float(int bits) { float value; memcpy(&value, &bits, 4); return value; }
static struct { unsigned x; } threadIdx, blockIdx, gridDim;
"""
LAUNCH_ON_CPU = """
extern "C" void launch(const struct batch *batch, char *memory, unsigned blocks) {
  gridDim.x = blocks;
  for (blockIdx.x = 0; blockIdx.x < blocks; blockIdx.x++)
    for (threadIdx.x = 0; threadIdx.x < THREADS; threadIdx.x++)
#if LONG
      kernel(*batch, memory);
#else
      kernel(*batch);
#endif
}
"""


@pytest.mark.skipif(shutil.which("g++") is None, reason="there is no C++ compiler")
@pytest.mark.parametrize("long", [False, True])
def test_kernels_compute_what_their_graph_does(long: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Of a GPU, compiled for this processor: short ones with a thread per sample, long ones with fewer and in parts."""
    monkeypatch.setattr(c, "LONG_KERNEL", 0 if long else 10**9)
    monkeypatch.setitem(c.MOST_TOGETHER, "gpu, long", (9, 9))
    count, blocks = 300, 2 if long else 3
    points = np.random.default_rng(0).standard_normal((count, 3))
    several = "elementwise", "integers", "loops", "loop in a loop of members", "several computed indices", "constants"
    plain = lambda x: [descent(ROW + x / 9), *(FUNCTIONS[name](x) for name in several)]  # noqa: E731
    function = capture(plain, jax.ShapeDtypeStruct((3,), float), most=9999)
    source = c.source_of(function, "gpu")
    assert (source.count("PART void part") > 2) == long
    Path(tmp_path, "kernel.cc").write_text(BLOCK_ON_CPU + source + LAUNCH_ON_CPU)
    subprocess.run(["g++", "-w", "-shared", "-fPIC", "kernel.cc", "-o", "kernel.so"], cwd=tmp_path, check=True)
    found = [np.empty((aval.size, count), aval.dtype) for aval in function.avals]
    kept = int(source.partition("#define KEPT ")[2].split()[0])
    memory = np.full(blocks * 128 * kept, UNTOUCHED, np.uint64)
    columns, (inputs, outputs) = np.ascontiguousarray(points.T), (ctypes.c_void_p * 1, ctypes.c_void_p * len(found))
    fields = [("count", ctypes.c_long), ("inputs", inputs), ("outputs", outputs), ("shared", ctypes.c_int * 1)]
    batch = type("Batch", (ctypes.Structure,), {"_fields_": fields})(
        count, inputs(columns.ctypes.data), outputs(*(each.ctypes.data for each in found)), (ctypes.c_int * 1)(0)
    )
    ctypes.CDLL(str(tmp_path / "kernel.so")).launch(ctypes.byref(batch), ctypes.c_void_p(memory.ctypes.data), blocks)
    for ours, theirs in zip(found, jax.tree.leaves(jax.vmap(plain)(points)), strict=True):
        np.testing.assert_allclose(ours.T.reshape(theirs.shape), theirs, rtol=1e-12)
    own_places = (memory & 0xFFFFFFFF != UNTOUCHED & 0xFFFFFFFF) == long
    assert own_places.all()


@pytest.mark.skipif(cuda.nvrtc() is None, reason="there is no NVRTC")
@pytest.mark.parametrize("most", [100, 100_000])
def test_kernels_are_compiled_without_a_gpu(monkeypatch, most):
    """Short ones and long ones, also by an NVRTC that does not know the options, into code for the architecture."""
    point = jax.ShapeDtypeStruct((3,), float)
    monkeypatch.setitem(c.MOST_TOGETHER, "gpu, long", (20, most))
    function = capture(FUNCTIONS["loops"], point, most=999)
    kernels = [cuda.compile_kernel(c.source_of(function, "gpu"), "sm_90")]
    monkeypatch.setattr(cuda, "MOST_OPTIMISED", 0)
    kernels.append(cuda.compile_kernel(c.source_of(function, "gpu"), "sm_90"))
    monkeypatch.setattr(c, "LONG_KERNEL", 0)
    source = c.source_of(function, "gpu")
    kernels.append(cuda.compile_kernel(source, "sm_90"))
    monkeypatch.setattr(cuda, "QUICKLY", ("--no-such-option",))
    kernels.append(cuda.compile_kernel(source, "sm_90"))
    assert all(each.startswith(b"\x7fELF") and b"kernel" in each for each in kernels) and len({*kernels}) == 4
    with pytest.raises(ValueError, match='"x1" is undefined'):
        cuda.compile_kernel(source.replace("x1 ", "nothing ", 1), "sm_90")


def test_processes_build_at_once(tmp_path):
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path)}
    running = [
        subprocess.Popen([sys.executable, "-c", ALONE], stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment)
        for _ in range(3)
    ]
    for each in running:
        out, error = each.communicate()
        assert out.decode().splitlines()[-1] == "[2. 2. 2.]", error
        assert b"native" in out


def test_the_page_shows_what_is_written():
    page = (Path(__file__).parents[1] / "docs" / "native.md").read_text()
    python, shown = (page.partition(f"```{language}\n")[2].partition("```")[0] for language in ("python", "c"))
    names: dict[str, Any] = {"jnp": jnp}
    exec(python, names)
    written = c.source_of(capture(names["push"], jax.ShapeDtypeStruct((2,), float), most=99))
    assert f"{{\n{shown}}}\n" in written


def test_a_model_that_limits_its_contacts_is_native():
    """With `max_contact_points`, MJX keeps the deepest contacts: here two corners of a tilted box of four."""
    host = mujoco.MjModel.from_xml_string("""
        <mujoco><option iterations="50" ls_iterations="20" tolerance="1e-14"/>
          <custom><numeric name="max_contact_points" data="2"/></custom>
          <worldbody><geom type="plane" size="1 1 1"/>
            <body pos="0 0 0.099"><freejoint/><geom type="box" size="0.1 0.1 0.1" mass="1"/></body>
          </worldbody></mujoco>""")
    model, data = mjx.put_model(host), mjx.make_data(host)
    rows: Any = data._impl
    assert rows.contact.dist.shape == (2,)
    before = native._LEFT.copy()

    def height(tilt, advance):
        start = data.replace(qpos=data.qpos.at[4:6].set(tilt))
        return jax.lax.fori_loop(0, 3, lambda _, each: advance(model, each), start).qpos

    tilts = 0.004 * jnp.arange(-3.5, 4)[:, None] * jnp.array([1.0, 0.3])
    ours, stock = (jax.jit(jax.vmap(partial(height, advance=each)))(tilts) for each in (mjx_study.step, mjx.step))
    np.testing.assert_allclose(ours, stock, rtol=0, atol=1e-9)
    assert native._LEFT == before
