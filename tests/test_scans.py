"""Loops of known length as native code compute what `jax.lax.scan` does, in batches, and stay scans where they must."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from mjx_study.choices import TASK_DESCRIPTIONS
from mjx_study.graph import c, native, scans
from mjx_study.graph.native import SWITCH, native_identity
from mjx_study.graph.scalars import unrolled
from mjx_study.graph.scans import with_native_scans
from mjx_study.objective import Simulator
from mjx_study.objective.programs import SamplePrograms
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import single_contact
from mjx_study.tasks.network import with_network
from tests.test_graph import FUNCTIONS

pytestmark = pytest.mark.skipif(native_identity() is None, reason="there is no C compiler")


@pytest.fixture(autouse=True, params=["1", "0"], ids=["C", "NumPy"])
def end(request, monkeypatch):
    """What computes the loops."""
    monkeypatch.setenv(SWITCH, request.param)
    return request.param


DRAW = np.random.default_rng(0)
ROWS = DRAW.normal(size=(21, 5, 3))
STARTS = DRAW.normal(size=(21, 3))
FIXED = np.array([0.3, -0.7])


def several(fixed, start, rows):
    """A loop with numbers, truth values and nothing carried, an invariant, and a solver's loop inside."""

    def body(carry, row):
        x, count, above, nothing = carry
        root = unrolled(lambda y: FUNCTIONS["loops"](y)[0], 1.5 + jnp.tanh(x + row))
        after = jnp.sin(fixed[0]) * root + jnp.where(above, row, fixed[1])
        return (after, count + 1, jnp.sum(after) > 0, nothing), (x, above, 7.0, row[:2], nothing)

    return lax.scan(body, (start, 0, False, jnp.zeros(0)), rows)


def backward(fixed, start, rows):
    return lax.scan(lambda carry, row: (carry * 0.5 + row, carry), start, rows, reverse=True)


def gradient(fixed, start, rows):
    def total(fixed, start, rows):
        def body(x, row):
            x = unrolled(lambda x, row, shift: jnp.sin(x) * row + shift, x, row, fixed[0])
            return x, jnp.sum(x**2) * fixed[1]

        last, costs = lax.scan(body, start, rows)
        return jnp.sum(last) + jnp.sum(costs)

    return jax.value_and_grad(total, (0, 1, 2))(fixed, start, rows)


def indexed(fixed, start, rows):
    """Known rows, a constant array, and an index."""
    table = jnp.arange(15.0).reshape(5, 3)
    return lax.scan(lambda x, at: (x + table[at] * fixed[0], at), start, jnp.arange(5))


def looked_up(fixed, start, rows):
    """Entries of arrays in memory, and of others, at indices that a loop computes."""

    def sums(x, first):
        more = lambda carry: (carry[0] + 1, carry[1] + rows[carry[0]] * fixed[carry[0] % 2] - x[carry[0] % 3])  # noqa: E731
        return lax.while_loop(lambda carry: carry[0] < 5, more, (first, x))[1]

    body = lambda x, row: (0.1 * sums(x, jnp.int32(jnp.abs(4 * row[0])) % 6) + row, rows[jnp.int32(8 * row[1]), 1:])  # noqa: E731
    return lax.scan(body, start, rows)


def stopped(fixed, start, rows):
    """The gradient of a loop with values whose derivative is cut off."""
    inner = lambda x, row: x * lax.stop_gradient(jnp.sin(x)) + row  # noqa: E731
    body = lambda x, row: (unrolled(inner, x, row), lax.stop_gradient(row))  # noqa: E731
    return jax.grad(lambda x: jnp.sum(lax.scan(body, x, rows)[0] ** 2))(start)


def nested(fixed, start, rows):
    inner = lambda x, row: lax.fori_loop(0, 3, lambda k, y: y * 0.5 + row, x)  # noqa: E731
    return jax.jit(lambda start: lax.scan(lambda x, row: (inner(x, row), None), start, rows))(start)


LOOPS = {each.__name__: each for each in (several, backward, gradient, indexed, looked_up, stopped, nested)}


def in_a_batch(function):
    return jax.jit(jax.vmap(function, (None, 0, 0)))


@cache
def of_scans(name, end):
    """What a loop gives with `jax.lax.scan`, whose steps may be native."""
    return in_a_batch(LOOPS[name])(FIXED, STARTS, ROWS)


@pytest.mark.parametrize("most", [10, 60, 500])
@pytest.mark.parametrize("name", LOOPS)
def test_loops(monkeypatch, name, most, end):
    theirs = of_scans(name, end)
    monkeypatch.setitem(c.MOST_TOGETHER, "cpu", (most, most))
    program = in_a_batch(with_native_scans(LOOPS[name]))
    traced = str(jax.make_jaxpr(program)(FIXED, STARTS, ROWS))
    assert "native[" in traced and "scan[" not in traced
    ours = program(FIXED, STARTS, ROWS)
    assert jax.tree.structure(ours) == jax.tree.structure(theirs)
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-14)


def test_what_a_sample_gives_depends_on_no_other():
    program = in_a_batch(with_native_scans(gradient))
    whole = jax.tree.leaves(program(FIXED, STARTS, ROWS))
    for part in (slice(0, 1), slice(3, 12), slice(2, 21), slice(None, None, -1)):
        for some, every in zip(jax.tree.leaves(program(FIXED, STARTS[part], ROWS[part])), whole, strict=True):
            np.testing.assert_array_equal(some, every[part])


def whole_array(fixed, start, rows):
    return lax.scan(lambda x, row: (jnp.fft.fft(x + row).real, None), start, rows)


def random(fixed, start, rows):
    def step(key, row):
        key, drawn = jax.random.split(key)
        return key, row + jax.random.normal(drawn)

    return lax.scan(step, jax.random.key(0), rows)[1]


def seeded(fixed, start, rows):
    return lax.scan(lambda x, row: (x + row * jax.random.normal(jax.random.key(0)), None), start, rows)


def printing(fixed, start, rows):
    def body(x, row):
        jax.debug.print("{}", row[0])
        return x + row, None

    return lax.scan(body, start, rows)


def long(fixed, start, rows):
    return lax.scan(lambda x, row: (x + jnp.sum(jnp.outer(jnp.sin(row), jnp.arange(1, 900.0))), None), start, rows)


def wide(fixed, start, rows):
    return lax.scan(lambda x, row: (x + row[0], None), jnp.zeros(600), rows)


def test_loops_without_passes_or_results():
    empty = lambda x, row: (x, jnp.zeros(0))  # noqa: E731
    last, nothing = in_a_batch(with_native_scans(lambda _, x, rows: lax.scan(empty, x, rows[:0])))(FIXED, STARTS, ROWS)
    np.testing.assert_array_equal(last, STARTS)
    assert nothing.shape == (21, 0, 0)
    none = in_a_batch(with_native_scans(lambda _, x, rows: lax.scan(empty, x[:0], rows)))(FIXED, STARTS, ROWS)
    assert [each.shape for each in none] == [(21, 0), (21, 5, 0)]


@pytest.mark.parametrize(
    ("loop", "reason"),
    [
        (whole_array, "loop with values of type complex128"),
        (random, "loop over random keys"),
        (seeded, "loop with random_seed"),
        (printing, "loop with side effects"),
        (long, "loop of more than 1000 operations"),
        (wide, "loop of more than 500 values from pass to pass"),
    ],
)
def test_what_stays_a_scan(monkeypatch, loop, reason):
    monkeypatch.setattr(scans, "MOST_OPERATIONS", 1000)
    monkeypatch.setattr(native, "_LEFT", native.Counter())
    program = in_a_batch(with_native_scans(loop))
    both = (jax.tree.leaves(each(FIXED, STARTS, ROWS)) for each in (program, in_a_batch(loop)))
    for ours, theirs in zip(*both, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12)
    assert "scan[" in str(jax.make_jaxpr(program)(FIXED, STARTS, ROWS))
    assert reason in native.native_summary()


def test_steps_of_a_loop_that_stays_are_native(monkeypatch):
    monkeypatch.setattr(scans, "MOST_OPERATIONS", 2)
    loop = lambda fixed, start, rows: lax.scan(  # noqa: E731
        lambda x, row: (unrolled(lambda y: jnp.sin(y) * 0.123, x) + row * row + fixed[0], None), start, rows
    )
    program = in_a_batch(with_native_scans(loop))
    traced = str(jax.make_jaxpr(program)(FIXED, STARTS, ROWS))
    assert "scan[" in traced and "native[" in traced
    np.testing.assert_allclose(program(FIXED, STARTS, ROWS)[0], in_a_batch(loop)(FIXED, STARTS, ROWS)[0], rtol=1e-12)


def batch_of(task, monkeypatch, names, samples=11):
    contact, keys = single_contact(task)[0].contact, jax.random.split(jax.random.key(0), samples)
    given = task.theta, contact, task.sigma, np.asarray(jax.random.key_data(keys)), np.ones(samples)
    for switch in ("xla", "1", "0"):
        monkeypatch.setenv(SWITCH, switch)
        simulator = Simulator(task, chunk_size=samples)
        yield [jax.tree.leaves(simulator.run(name, *given)) for name in names]


def agree(task, monkeypatch, names, tolerance=1e-11):
    for name, theirs, *ours in zip(names, *batch_of(task, monkeypatch, names), strict=True):
        for other, *each in zip(theirs, *ours, strict=True):
            for one in each:
                np.testing.assert_allclose(
                    one,
                    other,
                    rtol=0,
                    atol=tolerance * np.max(np.abs(np.nan_to_num(other)), initial=1e-3),
                    err_msg=name,
                )


@pytest.mark.parametrize(
    "name",
    ["pusher", *(pytest.param(each, marks=pytest.mark.slow) for each in sorted({*TASK_DESCRIPTIONS} - {"pusher"}))],
)
@pytest.mark.parametrize("end", ["1"], indirect=True)
def test_batches_of_tasks(monkeypatch, name):
    agree(make_task(name, horizon=12), monkeypatch, ["value", "gradient", "steps"])


@pytest.mark.slow
@pytest.mark.parametrize("end", ["1"], indirect=True)
def test_other_programs(monkeypatch):
    names = list(SamplePrograms(make_task("ball_wall")).by_name)
    agree(make_task("ball_wall", horizon=30), monkeypatch, names)
    agree(make_task("sliding_box", horizon=12, adjoint="tape"), monkeypatch, ["value", "gradient"])


@pytest.mark.parametrize("end", ["1"], indirect=True)
def test_networks_and_their_libraries(monkeypatch):
    """Rollouts with a network are one library beside that of the noise; a wide network stays with XLA."""
    task = with_network(make_task("pusher", horizon=12), (8, 8), jax.random.key(1))
    agree(task, monkeypatch, ["value", "gradient"])
    monkeypatch.setenv(SWITCH, "1")
    contact = single_contact(task)[0].contact
    for name, calls in (("value", 2), ("gradient", 3)):
        program = jax.make_jaxpr(with_native_scans(SamplePrograms(task).by_name[name]))
        traced = str(program(task.theta, contact, task.sigma, np.zeros(2, np.uint32), 1.0))
        assert traced.count("native[") == calls and "scan[" not in traced
    monkeypatch.setattr(scans, "MOST_CARRIED", 50)
    agree(task, monkeypatch, ["value", "gradient"])
    assert "50 values from pass to pass" in native.native_summary()
