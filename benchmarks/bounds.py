"""Bounds of networks and of small examples, beside those of immrax.

    python -m venv peer && peer/bin/pip install immrax pandas click     # immrax 0.3.8, jax 0.10.2
    OPENBLAS_NUM_THREADS=1 PYTHONPATH=. peer/bin/python benchmarks/bounds.py

Networks with random weights, and examples of immrax's documentation: how wide bounds are, as the
mean over boxes of the ratio of ours to theirs (of CROWN's for networks, of the tightest of natural,
Jacobian-based and mixed inclusion functions otherwise), and the processor's seconds for a batch,
compiled before: medians of both, which take turns, and of the ratios of their turns. Bounds contain
the values at sampled points.
"""

import argparse
import itertools
import time
from collections.abc import Callable

import immrax
import jax
import jax.numpy as jnp
import numpy as np

from verifai_jax.addons.verification.sets import Form, Interpreter
from verifai_jax.addons.verification.sets.values import as_form

NETWORKS = {
    "2-16-1 tanh": ((2, 16, 1), "tanh"), "4-20-1 tanh": ((4, 20, 1), "tanh"),
    "3-24-24-24-8 relu": ((3, 24, 24, 24, 8), "relu"), "4-64-64-2 relu": ((4, 64, 64, 2), "relu"),
    "4-64-64-2 sigmoid": ((4, 64, 64, 2), "sigmoid"),
    "6-64-64-64-3 sigmoid": ((6, 64, 64, 64, 3), "sigmoid"),
}  # fmt: skip
ACTIVE = {"tanh": lambda x: 2 * jax.nn.sigmoid(2 * x) - 1, "relu": jax.nn.relu,
          "sigmoid": jax.nn.sigmoid}  # fmt: skip
"""immrax takes tanh as this, against NaN in its own."""
TURNS = 15


def network(sizes: tuple[int, ...], kind: str) -> Callable:
    """Return a network with random weights, of a gain at which layers keep their scale."""
    random = np.random.default_rng(0)
    layers = [
        (jnp.float32(random.normal(size=(m, n)) * 1.4 / np.sqrt(n)),
         jnp.float32(0.3 * random.normal(size=m)))
        for n, m in itertools.pairwise(sizes)
    ]  # fmt: skip

    def function(x):
        for matrix, shift in layers[:-1]:
            x = ACTIVE[kind](matrix @ x + shift)
        return layers[-1][0] @ x + layers[-1][1]

    return function


def column(parts):
    """Return a vector of numbers; immrax has no rule for `stack`."""
    return jnp.concatenate([jnp.reshape(part, (1,)) for part in parts])


EXAMPLES = {
    "(x + y)^2, x + y + 2xy": (
        2, lambda x: column([(x[0] + x[1]) ** 2, x[0] + x[1] + 2 * x[0] * x[1]])
    ),
    "Van der Pol": (2, lambda x: column([x[1], (1 - x[0] ** 2) * x[1] - x[0]])),
    "pendulum": (2, lambda x: column([x[1], -9.81 * jnp.sin(x[0]) - 0.2 * x[1]])),
    "vehicle": (
        4, lambda x: column([x[3] * jnp.cos(x[2]), x[3] * jnp.sin(x[2]), x[3] * x[0], x[1]])
    ),
}  # fmt: skip


def ours(function: Callable, dim: int) -> Callable:
    """Return a function of the corners of boxes to ours."""
    program = jax.make_jaxpr(function)(jax.ShapeDtypeStruct((dim,), np.float32))

    def bounds(low, high):
        leaf = Form.leaf(low, high, np.eye(dim), np.dtype(np.float32))
        (result,) = Interpreter(len(low), dim)(program, [leaf])
        return as_form(result).bounds()

    return bounds


def crown(function: Callable) -> Callable:
    """Return a function of the corners of boxes to CROWN's bounds by immrax."""

    def of_box(low, high):
        box = immrax.interval(low, high)
        found = immrax.crown(function)(box)(box)
        return found.lower, found.upper

    return jax.jit(jax.vmap(of_box))


def inclusions(function: Callable) -> Callable:
    """Return a function of the corners of boxes to the tightest of immrax's inclusion functions."""

    def of_box(low, high):
        box = immrax.interval(low, high)
        found = [kind(function)(box) for kind in (immrax.natif, immrax.jacif, immrax.mjacif)]
        ends = jnp.array([f.lower for f in found]), jnp.array([f.upper for f in found])
        return ends[0].max(0), ends[1].min(0)

    return jax.jit(jax.vmap(of_box))


def compare(name: str, function: Callable, dim: int, theirs: Callable, boxes: int) -> None:
    """Print the ratios of widths and of seconds for boxes of three sizes."""
    random, mine = np.random.default_rng(1), ours(function, dim)
    for width in (0.02, 0.2, 1.0):
        middle = random.uniform(-1, 1, (boxes, dim))
        low, high = np.float32(middle - width / 2), np.float32(middle + width / 2)
        both = (lambda low, high: mine(low.astype(float), high.astype(float))), theirs
        results = [jax.block_until_ready(bounds(low, high)) for bounds in both]
        results = [[np.asarray(end, float) for end in found] for found in results]
        seconds = np.zeros((TURNS, 2))
        for turn, i in itertools.product(range(TURNS), range(2)):
            begun = time.process_time()
            jax.block_until_ready(both[i](low, high))
            seconds[turn, i] = time.process_time() - begun
        medians = 1e3 * np.median(seconds, 0)
        points = low + random.random((200, *low.shape)).astype(np.float32) * (high - low)
        values = np.asarray(jax.vmap(jax.vmap(function))(points), float)
        (first, last), (begin, end) = results
        assert np.all((first <= values) & (values <= last)), "a value is outside of our bounds"
        ratio = (last - first) / (end - begin)
        print(f"| {name} | {width} | {np.mean(ratio):z.3f} | {np.max(ratio):z.3f} | "
              f"{medians[0]:z.3g} | {medians[1]:z.3g} | "
              f"{np.median(seconds[:, 0] / seconds[:, 1]):z.2g} |", flush=True)  # fmt: skip


def main() -> None:
    """Compare the bounds of all networks and examples."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", default=[*NETWORKS, *EXAMPLES])
    parser.add_argument("--boxes", type=int, default=256)
    options = parser.parse_args()
    boxes = options.boxes
    print(f"immrax {immrax.__version__ if hasattr(immrax, '__version__') else ''}, {boxes} boxes")
    print("| function | width | ours / theirs, mean | worst | ours, ms | theirs, ms | ratio |")
    for name in options.names:
        if name in NETWORKS:
            sizes, kind = NETWORKS[name]
            function = network(sizes, kind)
            compare(name, function, sizes[0], crown(function), boxes)
        else:
            dim, function = EXAMPLES[name]
            compare(name, function, dim, inclusions(function), boxes)


if __name__ == "__main__":
    main()
