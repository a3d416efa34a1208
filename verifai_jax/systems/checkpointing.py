"""A scan over a long horizon whose reverse-mode memory grows with the square root of its length.

    carry, outputs = checkpointed_scan(step, carry, length)             # step(carry, k)

A reverse sweep needs the intermediate results of every step, which soon exceed the memory. Here
only the carry of every segment is kept, and the steps of a segment are computed again in the
reverse sweep.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PyTree

MAX_PLAIN_STEPS = 512
"""Steps up to which a scan is left whole: its reverse sweep then costs no second simulation."""


def checkpointed_scan(
    step: Callable[[Any, Any], tuple[Any, Any]], carry: PyTree, length: int, *, unroll: int = 1
) -> tuple[Any, Any]:
    """Scan `step(carry, k)` over `k = 0 ... length - 1`, in segments if it is long.

    The results of the forward pass are those of one scan; segments save memory in reverse mode.
    """
    if length <= MAX_PLAIN_STEPS:
        return jax.lax.scan(step, carry, jnp.arange(length), unroll=unroll)
    each = _segment_length(length)
    whole = length // each * each

    @jax.checkpoint
    def segment(carry: PyTree, first: Int[Array, ""]) -> Any:
        return jax.lax.scan(step, carry, first + jnp.arange(each), unroll=unroll)

    carry, parts = jax.lax.scan(segment, carry, jnp.arange(0, whole, each))
    outputs = jax.tree.map(lambda leaf: leaf.reshape(whole, *leaf.shape[2:]), parts)
    if whole == length:
        return carry, outputs
    carry, rest = jax.lax.scan(step, carry, jnp.arange(whole, length), unroll=unroll)
    return carry, jax.tree.map(lambda a, b: jnp.concatenate([a, b]), outputs, rest)


def _segment_length(length: int) -> int:
    """Return a length of segments near the root of the length, that divides it if one does.

    Or else one that leaves a single step over, as whole seconds and the sample at their end do: XLA
    writes a loop of one step out, and finds that nothing comes of moving on from there, where any
    other rest compiles the step once more.
    """
    root = math.isqrt(length)
    for whole in (length, length - 1):
        divisors = [n for n in range(root // 2, 2 * root) if whole % n == 0]
        if divisors:
            return min(divisors, key=lambda n: abs(n - root))
    return root
