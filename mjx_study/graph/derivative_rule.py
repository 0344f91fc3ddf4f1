"""Functions with a derivative rule of their own, at every order.

`jax.custom_jvp` keeps its rule for the first derivative only. When JAX prepares a `scan` for reverse mode, it
replaces calls inside by their bodies, whose own derivative any further differentiation then takes: silently zero behind
a `stop_gradient`, wrong behind a solver's loop (fault 32 in `docs/gradient-faults.md`). A primitive keeps its rule.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import zero_from_primal
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

Rule = Callable[[tuple[Any, ...], tuple[Any, ...]], tuple[Any, Any]]
"""From the arguments, and their changes with None in place of leaves that do not change, to the value and its change,
linear in them."""
FlatRule = Callable[[Sequence[Any], Sequence[Any]], tuple[list[Any], list[Any]]]
"""The same for lists of arrays; changes of the value may be None, too."""
Transpose = Callable[[Sequence[Any], Sequence[Any]], list[Any]]
"""From the arguments, None in place of those in which a function is linear, and the adjoints of its value, to the
adjoints of the latter, None for others."""


def with_rule(function: Callable[..., Any], rule: Rule) -> Callable[..., Any]:
    """`function` of pytrees of arrays, differentiated by `rule`; it must not capture traced arrays.

    Only the value that the rule returns may depend on the function itself, which then has the rule, too.
    """

    def ruled(*arguments: Any) -> Any:
        leaves, structure = jax.tree.flatten(arguments)
        shape: Any = None

        def flat(*leaves: Any) -> Any:
            nonlocal shape
            value = function(*structure.unflatten(leaves))
            shape = jax.tree.structure(value)
            return jax.tree.leaves(value)

        def flat_rule(primals: Sequence[Any], changes: Sequence[Any]) -> Any:
            value, change = rule(structure.unflatten(primals), structure.unflatten(changes))
            return jax.tree.leaves(value), jax.tree.leaves(change)

        outputs = flat_with_rule(flat, leaves, flat_rule)
        return jax.tree.unflatten(shape, outputs)

    return ruled


def flat_with_rule(
    function: Callable[..., Any], arguments: Sequence[Any], rule: FlatRule, transpose: Transpose | None = None
) -> list[Any]:
    """`function(*arguments)`, a list of arrays, differentiated by `rule` and transposed by `transpose`."""
    jaxpr = jax.make_jaxpr(function)(*arguments)
    return _ruled.bind(*arguments, jaxpr=jaxpr, rule=rule, transpose=transpose)


def refusing(message: str) -> Callable[[Any], Any]:
    """The identity of pytrees of arrays, whose differentiation raises TypeError."""

    def rule(primals: Any, changes: Any) -> Any:
        raise TypeError(message)

    return with_rule(lambda value: value, rule)


def instantiated(primals: Any, changes: Any) -> Any:
    """Changes with zeros in place of None."""
    return jax.tree.map(lambda leaf, change: zero_from_primal(leaf) if change is None else change, primals, changes)


def _differentiate(
    primals: Any, tangents: Any, *, jaxpr: ClosedJaxpr, rule: FlatRule, transpose: Transpose | None
) -> Any:
    value, changes = rule(primals, [None if type(each) is ad.Zero else each for each in tangents])
    kinds = [each.to_tangent_aval() for each in jaxpr.out_avals]
    return value, [
        ad.Zero(kind) if each is None else _typed(each, kind) for each, kind in zip(changes, kinds, strict=True)
    ]


def _transpose(
    adjoints: Any, *arguments: Any, jaxpr: ClosedJaxpr, rule: FlatRule, transpose: Transpose | None
) -> list[Any]:
    assert transpose is not None
    fixed = [None if ad.is_undefined_primal(each) else each for each in arguments]
    found = transpose(fixed, [ad.instantiate_zeros(each) for each in adjoints])
    return [
        None if each is None else _typed(each, to.aval) if ad.is_undefined_primal(to) else each
        for each, to in zip(found, arguments, strict=True)
    ]


def _typed(change: Any, kind: Any) -> Any:
    """A change with its type, which entries of a graph do not tell of an empty array."""
    return jax.lax.convert_element_type(change, kind.dtype)


def _batch(arguments: Any, axes: Any, *, jaxpr: ClosedJaxpr, rule: FlatRule, transpose: Transpose | None) -> Any:
    def batched_rule(primals: Any, changes: Any) -> Any:
        moved = [None if change is None else axis for change, axis in zip(changes, axes, strict=True)]
        return jax.vmap(rule, (list(axes), moved))(list(primals), list(changes))

    def batched_transpose(fixed: Any, adjoints: Any) -> list[Any]:
        assert transpose is not None
        known = [None if each is None else axis for each, axis in zip(fixed, axes, strict=True)]
        found = jax.vmap(transpose, (known, 0))(list(fixed), list(adjoints))
        return [
            None if each is None else jnp.sum(each, 0) if axis is None else jnp.moveaxis(each, 0, axis)
            for each, axis in zip(found, axes, strict=True)
        ]

    batched = jax.make_jaxpr(jax.vmap(jaxpr_as_fun(jaxpr), axes))(*arguments)
    turned = None if transpose is None else batched_transpose
    outputs = _ruled.bind(*arguments, jaxpr=batched, rule=batched_rule, transpose=turned)
    return outputs, [0] * len(outputs)


def _evaluate(*arguments: Any, jaxpr: ClosedJaxpr, rule: FlatRule, transpose: Transpose | None) -> list[Any]:
    return jaxpr_as_fun(jaxpr)(*arguments)


_ruled = Primitive("ruled")
_ruled.multiple_results = True
_ruled.def_impl(_evaluate)
_ruled.def_abstract_eval(lambda *_, jaxpr, rule, transpose: jaxpr.out_avals)
ad.primitive_jvps[_ruled] = _differentiate
ad.primitive_transposes[_ruled] = _transpose
batching.primitive_batchers[_ruled] = _batch
mlir.register_lowering(_ruled, mlir.lower_fun(_evaluate, multiple_results=True))
