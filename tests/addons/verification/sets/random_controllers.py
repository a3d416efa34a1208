"""Random controllers of tables, sorts, switches, indices and convolutions: vectors of three."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

SIZE = 3
Map = Callable[[Array], Array]


def _numbers(random: np.random.Generator, *shape: int) -> Array:
    return jnp.asarray(random.normal(size=shape), jnp.float32)


def _knots(random: np.random.Generator, count: int = 6) -> Array:
    return jnp.sort(_numbers(random, count))


def _index(random: np.random.Generator, count: int) -> Callable[[Array], Array]:
    """Return a whole number that a number chooses, now and then one that is outside."""
    scale, shift = float(random.uniform(0.5, 4)), int(random.integers(0, count))
    return lambda x: jnp.floor(scale * x).astype(jnp.int32) + shift


def _interp(random: np.random.Generator) -> Map:
    knots, heights = _knots(random), _numbers(random, 6)
    return lambda x: jnp.interp(x, knots, heights)


def _interp_within(random: np.random.Generator) -> Map:
    knots, heights = _knots(random), _numbers(random, 6)
    return lambda x: x + jnp.interp(x[0], knots, heights, left=2.0, right=-1.0)


def _searchsorted(random: np.random.Generator) -> Map:
    knots, side = _knots(random), ("left", "right")[random.integers(2)]
    return lambda x: jnp.searchsorted(knots, x, side=side).astype(jnp.float32) / 3 - x


def _digitize(random: np.random.Generator) -> Map:
    knots, heights = _knots(random, 4), _numbers(random, 5)
    right = bool(random.integers(2))
    return lambda x: heights[jnp.digitize(x, knots, right=right)] + 0.5 * x


def _piecewise(random: np.random.Generator) -> Map:
    a, b = (float(each) for each in random.normal(size=2))
    return lambda x: jnp.piecewise(
        x, [x < a, x >= a + 0.3], [lambda x: b * x, lambda x: x * x, lambda x: jnp.sin(x)]
    )


def _sort(random: np.random.Generator) -> Map:
    descending = bool(random.integers(2))
    return lambda x: jnp.sort(x, descending=descending) - 0.5 * x


def _sort_long(random: np.random.Generator) -> Map:
    matrix = _numbers(random, SIZE, 9)
    return lambda x: jnp.sort(x @ matrix).reshape(3, 3).sum(0)


def _argsort(random: np.random.Generator) -> Map:
    heights = _numbers(random, SIZE)
    return lambda x: heights[jnp.argsort(x)] * x


def _sorted_by(random: np.random.Generator) -> Map:
    matrix = _numbers(random, SIZE, SIZE)
    return lambda x: lax.sort((x @ matrix, x), num_keys=1)[1]


def _sort_whole(random: np.random.Generator) -> Map:
    scale = float(random.uniform(1, 5))
    return lambda x: (
        (
            jnp.sort((scale * x).astype(jnp.int32)) + jnp.argsort((scale * x).astype(jnp.int32))
        ).astype(jnp.float32)
        / scale
    )


def _median(random: np.random.Generator) -> Map:
    matrix = _numbers(random, SIZE, int(random.integers(2, 6)))
    return lambda x: x - jnp.median(x @ matrix)


def _quantile(random: np.random.Generator) -> Map:
    share = float(random.uniform())
    return lambda x: x * jnp.quantile(x, share)


def _top(random: np.random.Generator) -> Map:
    heights = _numbers(random, SIZE)

    def top(x: Array) -> Array:
        best, which = lax.top_k(x, 2)
        return jnp.concatenate([best + heights[which], x[:1]])

    return top


def _table(random: np.random.Generator) -> Map:
    heights, index = _numbers(random, 7), _index(random, 7)
    return lambda x: heights[index(x)] - x


def _filled(random: np.random.Generator) -> Map:
    heights, index = _numbers(random, 7), _index(random, 7)
    return lambda x: jnp.clip(heights.at[index(x)].get(mode="clip"), -1, 1)


def _matrix_table(random: np.random.Generator) -> Map:
    heights, index = _numbers(random, 4, 5, SIZE), _index(random, 4)
    return lambda x: heights[index(x[0]), index(x[1])] * x


def _windows(random: np.random.Generator) -> Map:
    heights, index = _numbers(random, 6), _index(random, 4)
    return lambda x: lax.dynamic_slice(heights, (index(x[1]),), (SIZE,)) + x


def _written(random: np.random.Generator) -> Map:
    index, height = _index(random, SIZE), float(random.normal())
    return lambda x: x.at[index(x[0])].set(height * x[1])


def _added(random: np.random.Generator) -> Map:
    index = _index(random, SIZE)
    return lambda x: x.at[index(x[2])].add(0.5 * x[1]).at[jnp.array([2, 0])].add(x[:2])


def _replaced(random: np.random.Generator) -> Map:
    heights, index = _numbers(random, 5), _index(random, 3)
    return lambda x: lax.dynamic_update_slice(heights, x[:2], (index(x[2]),))[:SIZE]


def _switch(random: np.random.Generator) -> Map:
    matrix, index = _numbers(random, SIZE, SIZE), _index(random, 3)
    return lambda x: lax.switch(
        index(x[0]), [lambda y: y @ matrix, jnp.tanh, lambda y: y[::-1], jnp.abs], x
    )


def _advised(random: np.random.Generator) -> Map:
    """The greatest output chooses one of three networks."""
    first, rest = _numbers(random, SIZE, 3), _numbers(random, 3, SIZE, SIZE)

    def advised(x: Array) -> Array:
        branches = [lambda y, w=w: jnp.maximum(y @ w, 0.0) - y for w in rest]
        return lax.switch(jnp.argmax(x @ first), branches, x)

    return advised


def _weights_by_index(random: np.random.Generator) -> Map:
    first, rest = _numbers(random, SIZE, 3), _numbers(random, 3, SIZE, SIZE)
    return lambda x: jnp.tanh(x @ rest[jnp.argmax(x @ first)])


def _convolution(random: np.random.Generator) -> Map:
    """Two layers with strides, padding, dilation and groups, flattened to three."""
    groups = int(random.integers(1, 3))
    stride, gap, spread = (int(each) for each in random.integers(1, 3, 3))
    into = _numbers(random, SIZE, 2 * 4 * 5)
    kernel = _numbers(random, 4, 2 // groups, 2, 3) / 2
    low, high = (int(each) for each in random.integers(0, 3, 2))

    def network(x: Array) -> Array:
        image = jnp.tanh(x @ into).reshape(1, 2, 4, 5)
        hidden = lax.conv_general_dilated(
            image, kernel, (stride, 1), ((low, high), (1, 0)), lhs_dilation=(spread, 1),
            rhs_dilation=(1, gap), feature_group_count=groups,
        )  # fmt: skip
        return jax.nn.relu(hidden).reshape(-1)[:SIZE] + hidden.mean()

    return network


def _pointwise(random: np.random.Generator) -> Map:
    """Matrix products written as convolutions, as MATLAB exports them."""
    layers = [_numbers(random, 12, 1, 1, SIZE), _numbers(random, SIZE, 12, 1, 1) / 2]

    def network(x: Array) -> Array:
        form = ("NCHW", "OIHW", "NCHW")
        y = x.reshape(1, 1, 1, SIZE)
        y = lax.conv_general_dilated(y, layers[0], (1, 1), "VALID", dimension_numbers=form)
        y = jax.nn.relu(y)
        return lax.conv_general_dilated(y, layers[1], (1, 1), "VALID").reshape(SIZE)

    return network


def _kernel_of_state(random: np.random.Generator) -> Map:
    signal = _numbers(random, 5)
    return lambda x: jnp.convolve(signal, x, mode="same")[1:4]


def _batches(random: np.random.Generator) -> Map:
    into, kernel = _numbers(random, SIZE, 4 * 2 * 5), _numbers(random, 4, 2, 2)

    def network(x: Array) -> Array:
        y = (x @ into).reshape(4, 5, 2)
        y = lax.conv_general_dilated(
            y, kernel, (2,), "SAME", batch_group_count=2, dimension_numbers=("NWC", "OIW", "NWC")
        )
        return jnp.tanh(y.reshape(-1)[:SIZE])

    return network


PARTS: dict[str, Callable[[np.random.Generator], Map]] = {
    name.removeprefix("_"): part for name, part in list(globals().items())
    if name.startswith("_") and name not in ("_numbers", "_knots", "_index")
    and callable(part) and getattr(part, "__module__", "") == __name__
}  # fmt: skip
"""Makers of maps of three numbers to three, by their names."""


def controller(random: np.random.Generator, parts: int) -> tuple[str, Map]:
    """Return a composition of so many parts, with its name."""
    names = [sorted(PARTS)[i] for i in random.integers(len(PARTS), size=parts)]
    maps = [PARTS[name](random) for name in names]

    def composed(x: Array) -> Array:
        for each in maps:
            x = each(x)
        return x

    return " > ".join(names), composed
