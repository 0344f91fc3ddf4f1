"""Functions computed entry by entry are the functions."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_study.graph import function, scalars
from mjx_study.graph.c import source_of
from mjx_study.graph.function import capture
from mjx_study.graph.indexing import FEWEST_ROWS
from mjx_study.graph.linear_map import derivative
from mjx_study.graph.native import SWITCH
from mjx_study.graph.nodes import TooLargeError
from mjx_study.graph.scalars import traced_part, unrolled

ROUTES = {"1": "C", "0": "NumPy", "xla": "JAX's operations"}

TABLE = np.arange(12.0).reshape(4, 3) - 5
ROW = np.array([0.3, -1.2, 2.5])
FIELD = np.sin(np.arange(300.0)).reshape(20, 15)


def _newton_root(x):
    """A loop whose body needs what is computed before it, and a loop within it."""
    target = jnp.sum(x**2)

    def halved(y):
        return jax.lax.while_loop(lambda z: z > 4.0, lambda z: z / jnp.maximum(2.0, target / 50), y)

    return jax.lax.while_loop(
        lambda carry: (carry[1] < 20) & (jnp.abs(carry[0] ** 2 - target) > 1e-12),
        lambda carry: ((halved(carry[0]) + target / halved(carry[0])) / 2, carry[1] + 1),
        (target, 0),
    )


def _members(x):
    """Members for which the loops below run differently often, some of them not at all."""
    return jnp.stack([x, x[::-1] / 2, 3 * x, 0 * x])


def _until(limit, carry, by=1.7):
    """Grow an array until its sum of magnitudes reaches a limit; the passes, and a value that no pass changes."""
    size = lambda y: jnp.sum(jnp.abs(y))  # noqa: E731
    return jax.lax.while_loop(
        lambda carry: (size(carry[0]) < limit) & (carry[1] < 30),
        lambda carry: (by * carry[0] + carry[2], carry[1] + 1, carry[2]),
        (carry, 0, jnp.sum(carry) / 9),
    )


def _loop_in_loop(x):
    """A loop whose passes run a loop, both of a length that depends on the member."""
    return jax.lax.while_loop(
        lambda carry: (carry[1] < 5) & (carry[0] < 40.0),
        lambda carry: (_until(carry[0] + 2, jnp.stack([x[0], carry[0]]))[0][1] + 0.5, carry[1] + 1),
        (jnp.abs(x[1]), 0),
    )


def _loop_in_branch(x):
    """A loop of a computed length in a branch that some members take, and one of a known length in the other."""
    length = jnp.abs(x[1] * 3).astype(int)
    return jax.lax.cond(
        x[0] < 1.0,
        lambda y: jax.lax.fori_loop(0, length, lambda index, z: z * 1.5 + index, y),
        lambda y: jax.lax.fori_loop(0, 3, lambda index, z: z - index, y),
        x,
    )


def descent(x):
    """A loop of known length, whose passes descend to the best of several points; its last value goes unused."""
    height = lambda y: jnp.sum(jnp.sqrt(1 + (y - x) ** 2) * (2 + jnp.sin(x[2])))  # noqa: E731

    def lower(carry, _):
        point, _, count = carry
        points = point - jnp.geomspace(0.01, 2.0, 16)[:, None] * jax.grad(height)(point)
        best = jnp.argmin(jax.vmap(height)(points))
        return (points[best], height(points[best]), count + best), None

    (point, _, count), _ = jax.lax.scan(lower, (x[::-1] + 0.1, 0.0, 0), length=5)
    return point, count


def _descent_in_descent(x):
    """Loops of known length in one, which passes on a scalar."""
    return jax.lax.fori_loop(0, 3, lambda _, y: descent(x + y / 9)[0] @ x / 4, x[1])


FUNCTIONS = {
    "elementwise": lambda x: jnp.where(x > 0, jnp.sin(x) * x**3, jnp.exp(-x)) + jnp.arctan2(x, 2) / jnp.sqrt(1 + x**2),
    "integers": lambda x: (jnp.floor(x).astype(int) % 3, ~(x > 0) | (x < -1), jnp.sign(x), jnp.clip(x, -1, 1)),
    "known index": lambda x: jnp.outer(x, x)[jnp.array([2, 0, 2]), 1],
    "computed index": lambda x: jnp.asarray(TABLE)[jnp.argmax(x)] * x[jnp.argmin(x)],
    "several computed indices": lambda x: jnp.asarray(TABLE)[jnp.argsort(x)] @ x,
    "computed index beyond an end": lambda x: jnp.stack([x, x[::-1]], 1)[jnp.floor(4 * x).astype(int)],
    "index beyond the end": lambda x: jnp.take(x, jnp.array([1, 7]), mode="clip"),
    "add to one place twice": lambda x: jnp.zeros((3, 3)).at[jnp.array([0, 2, 0])].add(x[:, None]).at[1, 2].set(x[0]),
    "set beyond the end": lambda x: x.at[jnp.array([1, 9])].set(4.0),
    "multiply, raise and lower": lambda x: x.at[jnp.array([0, 2, 0])].mul(3.0).at[1:].max(0.2).at[:2].min(x[0]),
    "segments": lambda x: jax.ops.segment_sum(x, jnp.array([1, 1, 0]), 2),
    "pad, tile and stack": lambda x: (jnp.pad(x, (1, 2)), jnp.tile(x[::-1], 2), jnp.stack([x, -x], 1).T.reshape(-1)),
    "dynamic slices": lambda x: jax.lax.dynamic_update_slice(TABLE[0], jax.lax.dynamic_slice(x, (2,), (2,)), (0,)),
    "computed slice": lambda x: jax.lax.dynamic_slice(jnp.outer(x, x), (jnp.argmax(x), 0), (1, 2)),
    "products": lambda x: jnp.einsum("bij,bjk->bik", jnp.stack([jnp.outer(x, x)] * 2), jnp.ones((2, 3, 2), int)),
    "products of what is computed": lambda x: jnp.outer(x, jnp.sin(x)) @ jnp.stack([x, x**2], 1),
    "sums": lambda x: (jnp.cumsum(x), jax.lax.cumsum(x, reverse=True), jnp.sum(jnp.outer(x, x), 0)),
    "sums along any axis": lambda x: [
        jax.lax.cumsum(jnp.stack([jnp.outer(x, x**2), jnp.outer(x, jnp.sin(x))]), axis, reverse)
        for axis in range(3)
        for reverse in (False, True)
    ],
    "reductions": lambda x: (jnp.max(x), jnp.min(jnp.outer(x, x), axis=1), jnp.any(x > 1), jnp.all(x > -9)),
    "first of equals": lambda x: (jnp.argmax(jnp.abs(jnp.round(x)) * 0), jnp.argmin(jnp.outer(x, x), axis=1)),
    "largest entries": lambda x: (jax.lax.top_k(jnp.outer(x, x), 2), jax.lax.top_k(jnp.abs(jnp.round(x)), 3)),
    "largest entries of any kind": lambda x: jax.lax.top_k(jnp.log(x).at[0].set(jnp.inf), x.size),
    "chosen by largest": lambda x: jnp.outer(x, x)[jax.lax.top_k(-x, 2)[1]] * x,
    "whole arrays": lambda x: (jnp.sort(x), jnp.linalg.cholesky(jnp.outer(x, x) + 9 * jnp.eye(3))),
    "sorted by two keys": lambda x: x[jnp.lexsort((-x, jnp.round(x)))],
    "loops": _newton_root,
    "loop of members": lambda x: jax.vmap(partial(_until, 9.0))(_members(x)),
    "loop of members with limits of their own": lambda x: jax.vmap(_until)(3 * jnp.arange(1, 4) + x, _members(x)[:3]),
    "loop of members with limits alone": lambda x: jax.vmap(_until, (0, None))(x**2 + 3, x),
    "loop of members that grow differently": lambda x: jax.vmap(_until, (None, None, 0))(9.0, x, 2 + x**2),
    "loop of members of members": lambda x: jax.vmap(jax.vmap(_until, (0, None)), (None, 0))(x**2 + 3, _members(x)),
    "loop of members along another axis": lambda x: jax.vmap(lambda y: _until(9.0, y)[0], 1, 1)(_members(x)),
    "loop in a loop of members": lambda x: jax.vmap(_loop_in_loop)(_members(x)),
    "loops in branches of members": lambda x: jax.vmap(_loop_in_branch)(_members(x)),
    "loop of known length": descent,
    "loop of known length of members": lambda x: jax.vmap(descent)(_members(x)),
    "loop of known length in another": _descent_in_descent,
    "passes that stack scalars": lambda x: jnp.min(jax.lax.map(lambda w: (x[0] - w) ** 2, jnp.asarray(TABLE[:, 1]))),
    "passes of scalars": lambda x: jax.lax.scan(lambda y, row: (y + jnp.sum(jnp.full(3, row)), y), 0.0, x),
    "passes that give what they get": lambda x: jax.lax.scan(lambda y, row: (y, row), x[0], x),
    "recomputed": lambda x: jax.checkpoint(lambda y: jnp.sin(y) * jax.checkpoint(jnp.cumsum)(y + TABLE[0, 0]))(x),
    "loop of no step": lambda x: jax.lax.fori_loop(0, 0, lambda _, y: y * 2, x),
    "empty": lambda x: (x[:0], jnp.sum(x[:0]), jnp.zeros((0, 3)) @ x, jnp.zeros((2, 0)) @ x[:0]),
    "constants": lambda x: (jnp.ones(2), 3, jnp.sum(TABLE)),
    "constants as integers": lambda x: [jnp.array([1e10, -1e10, jnp.nan, 2.7]).astype(to) for to in ("int32", "uint8")],
    "first nan": lambda x: [find(x * jnp.array([[1, jnp.nan, 1], [1, 1, 1]]), 1) for find in (jnp.argmax, jnp.argmin)],
}  # fmt: skip


def _looked_up(x):
    """Entries, rows and blocks of large constant arrays at computed indices, some beyond an end."""
    i, j = (jnp.floor(4 * each).astype(int) for each in (x[0], x[1] * x[2]))
    field, whole = jnp.asarray(FIELD), jnp.asarray(np.floor(9 * FIELD).astype(np.int16))
    tall = jnp.asarray(np.tile(FIELD, (5, 1)))
    return (
        field[i, j] + field[j + 1, 2],
        field.at[i, j].get(mode="fill", fill_value=7.0),
        jnp.take(field, j, mode="clip"),
        tall[i] * x[0],
        whole[jnp.stack([i, j]), 3],
        jax.lax.dynamic_slice(tall, (j, i), (2, 3)),
        field[i][j] > field[j, i],
    )


def _of_few_bits(x):
    """Large arrays at indices of types that cannot count their entries."""
    tall, long = jnp.asarray(np.tile(FIELD, (5, 1))), jnp.sin(jnp.arange(300.0))
    i, j = (jnp.floor(30 * jnp.abs(x[0])).astype(kind) for kind in (jnp.int8, jnp.uint8))
    return (
        tall[i, 2],
        jnp.take(tall, j, axis=0, mode="clip"),
        long[i] + long[j],
        jax.lax.dynamic_slice(long, (i,), (2,)),
    )


FUNCTIONS["computed indices of large arrays"] = _looked_up
FUNCTIONS["indices of few bits"] = _of_few_bits


@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_value_is_the_functions(name, monkeypatch):
    """By every route."""
    points = np.stack([ROW, ROW[::-1], -2 * ROW, np.zeros(3) + 1])
    function = FUNCTIONS[name]
    assert scalars.captured_once(function, jax.ShapeDtypeStruct((3,), float)) is not None, "it would be left as it is"
    plain = jax.jit(jax.vmap(function))(points)
    for route in ROUTES:
        monkeypatch.setenv(SWITCH, route)
        here = jax.jit(jax.vmap(lambda x: unrolled(function, x)))(points)
        assert jax.tree.structure(plain) == jax.tree.structure(here)
        for ours, theirs in zip(jax.tree.leaves(here), jax.tree.leaves(plain), strict=True):
            assert ours.dtype == theirs.dtype
            np.testing.assert_allclose(ours, theirs, rtol=1e-14, atol=1e-14, err_msg=f"through {ROUTES[route]}")


@pytest.mark.parametrize(
    "name",
    ["elementwise", "computed index", "computed indices of large arrays", "add to one place twice", "products",
     "products of what is computed", "sums", "sums along any axis", "reductions", "passes that stack scalars",
     "passes of scalars", "recomputed", "loop of known length", "loop of known length of members",
     "loop of known length in another"],
)  # fmt: skip
def test_both_modes_differentiate_it(name):
    def total(function, x):
        return sum(jnp.sum(jnp.sin(jnp.asarray(leaf, float))) for leaf in jax.tree.leaves(function(x)))

    plain = lambda x: total(FUNCTIONS[name], x)  # noqa: E731
    here = lambda x: total(lambda y: unrolled(FUNCTIONS[name], y), x)  # noqa: E731
    for mode in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(jax.jit(mode(here))(ROW), jax.jit(mode(plain))(ROW), rtol=1e-13)


def test_a_functions_own_derivative_is_kept():
    @jax.custom_jvp
    def length(x):
        return jnp.sqrt(jnp.sum(x**2))

    @length.defjvp
    def _(primals, tangents):
        (x,), (change,) = primals, tangents
        value = length(x)
        return value, jnp.where(value > 0, x @ change / jnp.where(value > 0, value, 1.0), 0.0)

    gradient = jax.jit(jax.grad(lambda x: unrolled(lambda y: 2 * length(y * jnp.asarray([1.0, 0.0, 1.0])), x)))
    np.testing.assert_allclose(gradient(ROW), 2 * np.array([0.3, 0, 2.5]) / np.hypot(0.3, 2.5), rtol=1e-14)
    np.testing.assert_array_equal(gradient(np.zeros(3)), np.zeros(3))


def _inside(function, *arguments):
    """The jaxpr of a function, or of the one that it calls and nothing else."""
    jaxpr = jax.make_jaxpr(function)(*arguments).jaxpr
    while len(jaxpr.eqns) == 1 and jaxpr.eqns[0].primitive.name in ("jit", "ruled"):
        jaxpr = jaxpr.eqns[0].params["jaxpr"].jaxpr
    return jaxpr


def _operations(function, *arguments) -> list[str]:
    jaxpr = _inside(function, *arguments)
    moves = {"slice", "squeeze", "reshape", "broadcast_in_dim", "stack", "concatenate", "convert_element_type"}
    return [name for each in jaxpr.eqns if (name := each.primitive.name) not in moves]


def test_constants_fold_and_what_occurs_twice_or_for_nothing_is_dropped(monkeypatch):
    monkeypatch.setenv(SWITCH, "xla")
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

    def function(x):
        unused = jnp.exp(x)
        turned = jnp.asarray(turn) @ x
        return turned, jnp.sin(x[0] * x[1]) + jnp.sin(x[1] * x[0]), jnp.where(turn > 0, unused[0] * 0, 2.0)

    operations = _operations(lambda x: unrolled(function, x), ROW)
    assert sorted(operations) == ["add", "mul", "neg", "sin"]


def test_large_constant_arrays_are_tables():
    """At least `FEWEST_ROWS` possible values; one definition for all that read an array."""
    row = jax.ShapeDtypeStruct((3,), float)

    def looked_up(size, x):
        array, places = jnp.sin(jnp.arange(size)), jnp.floor(x).astype(int)
        return array[places[0]] * array[places[1:]]

    for size, tables in ((FEWEST_ROWS - 1, 0), (FEWEST_ROWS, 1)):
        source = source_of(capture(partial(looked_up, size), row, most=2000))
        assert source.count("\nCONSTANTS(") == tables and source.count(" = TABLE(") == 3 * tables


def test_passes_of_a_known_number_are_a_loop_if_they_are_long(monkeypatch):
    sizes = []
    for most in (2_000, 10**6):
        monkeypatch.setattr(function, "MOST_WRITTEN_OUT", most)
        found = capture(lambda x: descent(descent(x)[0])[0], jax.ShapeDtypeStruct((3,), float), most=10**5)
        sizes.append([found.size, derivative(found, (0,)).push.size, derivative(found, (0,)).pull().size])
    assert np.all(np.divide(*sizes) < 0.5), sizes


def test_what_does_not_change_in_a_loop_is_computed_before_it(monkeypatch):
    monkeypatch.setenv(SWITCH, "xla")

    def function(x):
        return jax.lax.while_loop(lambda y: y < 9.0, lambda y: y * jnp.cosh(x[0]) + 1, x[1])

    jaxpr = _inside(lambda x: unrolled(function, x), ROW)
    assert "cosh" in [each.primitive.name for each in jaxpr.eqns]
    (loop,) = (each for each in jaxpr.eqns if each.primitive.name == "while")
    assert "cosh" not in str(loop.params["body_jaxpr"])


def _one_term(x):
    """A sum of which constants leave one term, which is -0 where the sum is 0."""
    return jnp.sum(jnp.zeros(3).at[1].set(-x))


@pytest.mark.parametrize("native", ROUTES, ids=ROUTES.get)
@pytest.mark.parametrize(
    "function",
    [
        lambda x: jnp.minimum(1 / (0.5 * _one_term(x)), 1e6),
        lambda x: jnp.minimum(1 / jnp.sum(x * jnp.array([2.0, 3.0])), 1e6),
        lambda x: jnp.arctan2(jnp.zeros(3).at[0].set(-1.0) @ jnp.stack([x, x, x]), -1.0 - x),
        lambda x: jax.lax.integer_pow(jnp.where(x < 1, _one_term(x), 2.0), -3),
        lambda x: jax.lax.rsqrt(_one_term(x)),
    ],
    ids=["quotient", "products", "angle", "power", "root"],
)
def test_a_sum_of_zeros_is_not_negative(function, native, monkeypatch):
    monkeypatch.setenv(SWITCH, native)
    points = jnp.array([0.0, -0.0, -0.7])
    found, slopes = jax.jit(jax.vmap(jax.value_and_grad(lambda x: unrolled(function, x))))(points)
    np.testing.assert_allclose(found, jax.vmap(function)(points), rtol=1e-12)
    np.testing.assert_allclose(slopes[2], jax.grad(function)(points[2]), rtol=1e-12)


@pytest.mark.parametrize("native", ROUTES, ids=ROUTES.get)
def test_a_function_with_side_effects_is_left_as_it_is(native, monkeypatch, capfd):
    monkeypatch.setenv(SWITCH, native)

    def printing(x):
        jax.debug.print("called with {}", x)
        return 2 * x

    assert jax.jit(lambda x: unrolled(printing, x))(1.0) == 2.0
    jax.effects_barrier()
    assert capfd.readouterr().out == "called with 1.0\n"


@pytest.mark.parametrize("native", ROUTES, ids=ROUTES.get)
def test_random_keys_stay_with_jax(native, monkeypatch):
    monkeypatch.setenv(SWITCH, native)
    function = lambda x: x + jax.random.normal(jax.random.key(0), (3,))  # noqa: E731
    with jax.debug_key_reuse(False):  # which takes the stacking of a key's entries for a use
        np.testing.assert_allclose(jax.jit(lambda x: unrolled(function, x))(ROW), function(ROW), rtol=1e-15)


def test_values_alone_can_be_too_large(monkeypatch):
    """A call with its own derivative is one operation, unless only values are wanted."""
    monkeypatch.setitem(scalars.MOST_SCALARS, "cpu", 9)
    monkeypatch.setattr(scalars, "MOST_NATIVE", dict.fromkeys(scalars.MOST_NATIVE, 9))

    @jax.custom_jvp
    def long(x):
        return jnp.stack([jnp.sin(at * x) for at in range(50)]).sum()

    long.defjvp(lambda at, by: (long(*at), 7 * by[0]))
    value, slope = jax.value_and_grad(lambda x: unrolled(lambda y: 2 * long(y), x))(0.3)
    np.testing.assert_allclose(value, 2 * long(0.3), rtol=1e-12)
    assert slope == 14


def test_a_constant_zero_times_infinity_is_zero():
    assert jax.jit(lambda x: unrolled(lambda y: jnp.asarray([0.0, 1.0]) * y, x))(jnp.inf).tolist() == [0.0, np.inf]


def test_chains_of_any_length():
    """A product and a sum of more terms than Python nests calls, below a fraction."""
    terms = np.linspace(0.9, 1.1, 1500)

    def function(x):
        product, _ = jax.lax.scan(lambda found, each: (found * each * x, None), x, terms)
        return 1 / product + 1 / jnp.sum(terms * x)

    points = jnp.array([0.999, 1.0])
    found = jax.jit(jax.vmap(lambda x: unrolled(function, x)))(points)
    np.testing.assert_allclose(found, jax.vmap(function)(points), rtol=1e-11)


def test_what_is_far_too_large_is_refused_before_it_is_written_out():
    """A product of matrices that takes 1e12 multiplications."""
    wide = jax.ShapeDtypeStruct((10_000, 10_000), float)
    with pytest.raises(TooLargeError):
        capture(lambda x: x @ x, wide, most=1_000_000)


@pytest.mark.parametrize("most", [3, 11])
def test_what_is_too_large_is_left_as_it_is(monkeypatch, most):
    monkeypatch.setitem(scalars.MOST_SCALARS, "cpu", most)
    monkeypatch.setattr(scalars, "MOST_NATIVE", dict.fromkeys(scalars.MOST_NATIVE, most))
    function = lambda x: jnp.outer(x, x) @ jnp.cos(x)  # noqa: E731
    assert _operations(lambda x: unrolled(function, x), ROW) == _operations(function, ROW)


def test_a_function_is_written_out_once_for_arguments_of_equal_content(monkeypatch):
    written = []
    out = scalars.capture
    monkeypatch.setattr(scalars, "capture", lambda *given, **named: written.append(given) or out(*given, **named))
    function = lambda power, table, x: jnp.asarray(table) @ x**power  # noqa: E731

    def at(x, table=ROW, power=2):
        return jax.jit(lambda x: unrolled(partial(function, power), table, x))(x)

    for _ in range(2):
        np.testing.assert_allclose(at(ROW), ROW @ ROW**2)
        np.testing.assert_allclose(jax.vmap(at)(np.stack([ROW, -ROW])), [ROW @ ROW**2] * 2)
    assert len(written) == 1
    np.testing.assert_allclose(at(ROW, power=3), ROW @ ROW**3)
    np.testing.assert_allclose(at(ROW, table=np.nextafter(ROW, 9)), np.nextafter(ROW, 9) @ ROW**2, rtol=1e-15)
    np.testing.assert_allclose(at(ROW.astype(np.float32)), ROW @ ROW**2, rtol=1e-6)
    assert len(written) == 4
    monkeypatch.setattr(scalars, "MOST_KEPT", 1)
    at(ROW, power=4)
    assert len(written) == 5 and len(scalars._CAPTURED) == 1


def test_constants_stay_out_of_what_is_traced():
    kept = {}

    @jax.jit
    def function(x):
        traced, whole = traced_part({"constant": ROW, "input": x})
        kept["number"] = sum(each is not None for each in traced)
        again = whole([2 * each if each is not None else None for each in traced])
        assert again["constant"] is ROW
        return again["input"]

    assert function(3.0) == 6.0
    assert kept["number"] == 1
