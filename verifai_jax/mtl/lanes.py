"""Lanes under `jax.vmap`: a batching rule that adds a lane axis, and work in chunks of lanes."""

import functools
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree


@runtime_checkable
class Work(Protocol):
    """A function of lanes: `out_axes` says where each of its results keeps them."""

    out_axes: tuple[int, ...]

    def __call__(self, lanes: int, *arguments: PyTree) -> tuple[PyTree, ...]:
        """Return the results for arguments with this number of lane axes."""
        ...


def on_lanes(
    function: Work, lanes: int, axes: tuple[int, ...], spread: bool
) -> Callable[..., tuple[PyTree, ...]]:
    """Give `function(lanes, *arguments)` a batching rule that adds a lane axis to the arguments.

    `axes` says where each argument (a pytree) keeps its lane axes. `spread` repeats arguments that
    all lanes share, which a gradient with respect to them needs.
    """

    @jax.custom_batching.custom_vmap
    def call(*arguments: Any) -> Any:
        return function(lanes, *arguments)

    @call.def_vmap
    def rule(size: int, batched: PyTree, *arguments: Any) -> Any:
        def moved(axis: int, array: Array, is_batched: bool) -> Array:
            if is_batched:
                return jnp.moveaxis(array, 0, axis)
            array = jnp.expand_dims(array, axis)
            return jnp.repeat(array, size, axis) if spread else array

        arguments = tuple(
            jax.tree.map(functools.partial(moved, axis), argument, flags)
            for axis, argument, flags in zip(axes, arguments, batched, strict=True)
        )
        out = on_lanes(function, lanes + 1, axes, spread)(*arguments)
        out_axes = function.out_axes
        out = tuple(
            jax.tree.map(lambda a, axis=axis: jnp.moveaxis(_widened(a, axis, size), axis, 0), part)
            for part, axis in zip(out, out_axes, strict=True)
        )
        return out, jax.tree.map(lambda _: True, out)

    return call


def _widened(a: Array, axis: int, size: int) -> Array:
    if a.shape[axis] == size:
        return a
    return jnp.broadcast_to(a, (*a.shape[:axis], size, *a.shape[axis + 1 :]))


LANES = 256
"""Lanes worked on together: 256 of a thousand float32 samples are 1 MB, a cache's worth."""


def in_chunks(
    function: Callable[..., tuple[PyTree, ...]],
    axes: tuple[int, ...],
    out_axes: tuple[int, ...],
    *arguments: PyTree,
) -> tuple[PyTree, ...]:
    """Compute `function(*arguments)` over the first lane axis, a cache's worth at a time.

    Arguments keep their lanes on `axes`, results on `out_axes`.
    """
    sizes = {
        leaf.shape[axis]
        for argument, axis in zip(arguments, axes, strict=True)
        for leaf in jax.tree.leaves(argument)
    }
    size = max(sizes, default=1)
    # The engine's batches come in at most 512 lanes, which fit well enough as they are.
    if size <= 2 * LANES or jax.default_backend() != "cpu":
        return function(*arguments)
    count = -(-size // LANES)
    lanes = -(-size // count)

    def chunk(k: Array) -> Any:
        def part(axis: int, leaf: Array) -> Array:
            if leaf.shape[axis] != size:
                return leaf
            return jax.lax.dynamic_slice_in_dim(leaf, k, lanes, axis)

        return function(
            *(
                jax.tree.map(functools.partial(part, axis), argument)
                for argument, axis in zip(arguments, axes, strict=True)
            )
        )

    def step(i: Array, out: tuple[PyTree, ...]) -> tuple[PyTree, ...]:
        # The last chunk starts early enough to be full, and does some lanes again.
        k = jnp.minimum(i * lanes, size - lanes)
        return tuple(
            jax.tree.map(
                lambda whole, new, axis=axis: jax.lax.dynamic_update_slice_in_dim(
                    whole, new, k, axis
                ),
                *pair,
            )
            for *pair, axis in zip(out, chunk(k), out_axes, strict=True)
        )

    shapes = jax.eval_shape(chunk, jnp.int32(0))
    empty = tuple(
        jax.tree.map(
            lambda s, axis=axis: jnp.zeros((*s.shape[:axis], size, *s.shape[axis + 1 :]), s.dtype),
            part,
        )
        for part, axis in zip(shapes, out_axes, strict=True)
    )
    return jax.lax.fori_loop(0, count, step, empty)
