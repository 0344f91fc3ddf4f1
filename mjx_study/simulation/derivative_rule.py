"""Functions with a derivative rule of their own, at every order.

`jax.custom_jvp` keeps its rule for the first derivative only. When JAX prepares a `scan` for reverse mode, it
replaces calls inside by their bodies, whose own derivative any further differentiation then takes: silently zero behind
a `stop_gradient`, wrong behind a solver's loop (fault 32 in `docs/gradient-faults.md`). A primitive keeps its rule.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.custom_derivatives import zero_from_primal
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

Rule = Callable[[tuple[Any, ...], tuple[Any, ...]], tuple[Any, Any]]
"""From the arguments, and their changes with None in place of leaves that do not change, to the value and its change,
linear in them."""
_FlatRule = Callable[[Sequence[Any], Sequence[Any]], tuple[list[Any], list[Any]]]


def with_rule(function: Callable[..., Any], rule: Rule) -> Callable[..., Any]:
    """`function` of pytrees of arrays, differentiated by `rule`; it must not capture traced arrays.

    Only the value that the rule returns may depend on the function itself, which then has the rule, too.
    """

    def ruled(*arguments: Any) -> Any:
        leaves, structure = jax.tree.flatten(arguments)
        jaxpr, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)

        def flat_rule(primals: Sequence[Any], changes: Sequence[Any]) -> Any:
            value, change = rule(structure.unflatten(primals), structure.unflatten(changes))
            return jax.tree.leaves(value), jax.tree.leaves(change)

        return jax.tree.unflatten(jax.tree.structure(shape), _ruled.bind(*leaves, jaxpr=jaxpr, rule=flat_rule))

    return ruled


def refusing(message: str) -> Callable[[Any], Any]:
    """The identity of pytrees of arrays, whose differentiation raises TypeError."""

    def rule(primals: Any, changes: Any) -> Any:
        raise TypeError(message)

    return with_rule(lambda value: value, rule)


def instantiated(primals: Any, changes: Any) -> Any:
    """Changes with zeros in place of None."""
    return jax.tree.map(lambda leaf, change: zero_from_primal(leaf) if change is None else change, primals, changes)


def _differentiate(primals: Any, tangents: Any, *, jaxpr: ClosedJaxpr, rule: _FlatRule) -> Any:
    return rule(primals, [None if type(each) is ad.Zero else each for each in tangents])


def _batch(arguments: Any, axes: Any, *, jaxpr: ClosedJaxpr, rule: _FlatRule) -> Any:
    def batched_rule(primals: Any, changes: Any) -> Any:
        moved = [None if change is None else axis for change, axis in zip(changes, axes, strict=True)]
        return jax.vmap(rule, (list(axes), moved))(list(primals), list(changes))

    batched = jax.make_jaxpr(jax.vmap(jaxpr_as_fun(jaxpr), axes))(*arguments)
    outputs = _ruled.bind(*arguments, jaxpr=batched, rule=batched_rule)
    return outputs, [0] * len(outputs)


def _evaluate(*arguments: Any, jaxpr: ClosedJaxpr, rule: _FlatRule) -> list[Any]:
    return jaxpr_as_fun(jaxpr)(*arguments)


_ruled = Primitive("ruled")
_ruled.multiple_results = True
_ruled.def_impl(_evaluate)
_ruled.def_abstract_eval(lambda *_, jaxpr, rule: jaxpr.out_avals)
ad.primitive_jvps[_ruled] = _differentiate
batching.primitive_batchers[_ruled] = _batch
mlir.register_lowering(_ruled, mlir.lower_fun(_evaluate, multiple_results=True))
