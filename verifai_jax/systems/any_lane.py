"""Work of a step that is skipped if no lane of a batch needs it."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree


@jax.custom_batching.custom_vmap
def in_any_lane(condition: Any) -> Any:
    """Return the condition; in a batch, whether it holds in any lane.

    All lanes share the result, so that a branch on it remains a branch under `jax.vmap`.
    """
    return condition


@in_any_lane.def_vmap
def _(_: int, batched: Any, conditions: Any) -> tuple[Any, bool]:
    whole = conditions.any(axis=0) if batched[0] else conditions
    return in_any_lane(whole), False


def changed_if_needed(
    change: Callable[..., Any], needed: Bool[Array, ""], value: PyTree, *others: PyTree
) -> Any:
    """Return `change(value, *others)`, or `value` unchanged if no lane of a batch needs a change.

    In a lane that needs no change, `change` must return `value`. Derivatives are those of `change`,
    even in such a lane.
    """
    if jax.default_backend() != "cpu":
        # On an accelerator the host would wait at each step for the condition.
        return change(value, *others)

    @jax.custom_jvp
    def changed(needed: Any, value: PyTree, *others: PyTree) -> Any:
        # A loop of one pass or none: unlike a branch it copies nothing of the value.
        def once(carry: tuple[Any, PyTree]) -> tuple[Any, PyTree]:
            return jnp.array(False), change(carry[1], *others)

        return jax.lax.while_loop(lambda carry: carry[0], once, (in_any_lane(needed), value))[1]

    changed.defjvp(lambda primals, tangents: jax.jvp(change, primals[1:], tangents[1:]))
    return changed(needed, value, *others)
