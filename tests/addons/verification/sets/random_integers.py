"""Random programs on arrays of whole numbers of all types, and their values in the machine."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from verifai_jax.addons.verification.sets import Form, Interpreter, MissingRule, Whole

SIZE = 4
"""Numbers of an array; each program has three, the first two of whole numbers."""
TYPES = ("int8", "uint8", "int16", "uint16", "int32", "uint32")
FLOATS = ("float32", "float16", "bfloat16")
Operation = Callable[..., Any]


def _of(kind: str) -> Callable[[Any], Any]:
    return lambda x: x.astype(kind)


ONE: dict[str, Operation] = {
    "neg": jnp.negative, "abs": jnp.abs, "square": jnp.square, "cube": lambda x: x**3,
    "fourth": lambda x: x**4, "invert": jnp.invert, "sign": jnp.sign,
    "sum": lambda x: jnp.full_like(x, jnp.sum(x, dtype=x.dtype)),
    "prod": lambda x: jnp.full_like(x, jnp.prod(x, dtype=x.dtype)),
    "max": lambda x: jnp.full_like(x, jnp.max(x)), "min": lambda x: jnp.full_like(x, jnp.min(x)),
    "cumsum": lambda x: jnp.cumsum(x, dtype=x.dtype),
    "cumprod": lambda x: jnp.cumprod(x, dtype=x.dtype),
    "cummax": lambda x: lax.cummax(x), "cummin": lambda x: lax.cummin(x, reverse=True),
    "argmax": lambda x: jnp.full_like(x, jnp.argmax(x)),
    "argmin": lambda x: jnp.full_like(x, jnp.argmin(x)), "rev": lambda x: x[::-1],
    "mean": lambda x: jnp.full_like(x, jnp.floor(jnp.mean(x, dtype="float32"))),
    "iota": lambda x: x + jnp.arange(SIZE, dtype=x.dtype) * jnp.asarray(100, x.dtype),
    "dot constant": lambda x: jnp.full_like(x, jnp.dot(x, jnp.arange(1, SIZE + 1, dtype=x.dtype))),
    "mask": lambda x: x & 13, "clip": lambda x: jnp.clip(x, 3, 90), "scan": lambda x: lax.scan(
        lambda c, a: (c * jnp.asarray(3, x.dtype) + a, c), x[0], x)[1],
    "count": lambda x: jnp.full_like(x, jnp.sum((x > 3).astype("int8"), dtype="int8")),
    "half": lambda x: (x.astype("float16") * 3).astype(x.dtype),
    "brain": lambda x: (x.astype("bfloat16") / 3).astype(x.dtype),
    "single": lambda x: (x.astype("float32") * 1e6).astype(x.dtype),
    "set": lambda x: x.at[1].set(x[2] * 2), "bits and": lambda x: lax.full_like(
        x, lax.reduce_and(x, (0,))),
    "while": lambda x: lax.while_loop(lambda s: s[0] < 3, lambda s: (s[0] + 1, s[1] * s[1] + 1),
                                      (0, x))[1],
} | {kind: _of(kind) for kind in TYPES}  # fmt: skip
TWO: dict[str, Operation] = {
    "add": jnp.add, "sub": jnp.subtract, "mul": jnp.multiply, "div": lax.div, "rem": lax.rem,
    "floor": jnp.floor_divide, "mod": jnp.mod, "maximum": jnp.maximum, "minimum": jnp.minimum,
    "and": jnp.bitwise_and, "or": jnp.bitwise_or, "xor": jnp.bitwise_xor,
    "dot": lambda x, y: jnp.full_like(x, jnp.dot(x, y)),
    "wide dot": lambda x, y: jnp.full_like(x, lax.dot(x, y, preferred_element_type="int32")),
    "where": lambda x, y: jnp.where(x < y, x + 1, y * 2),
    "equal": lambda x, y: (x == y).astype(x.dtype) + x,
    "outer": lambda x, y: jnp.sum(x[:, None] * y[None], axis=1, dtype=x.dtype),
    "join": lambda x, y: jnp.concatenate([x, y])[2 : 2 + SIZE],
}  # fmt: skip


def program(random: np.random.Generator, depth: int) -> tuple[str, Operation]:
    """Draw a program of three arrays: its text, and the function."""
    if depth == 0:
        which = int(random.integers(3))
        if which < 2:
            return f"x{which}", lambda *x: x[which]
        kind = str(random.choice(TYPES))
        return f"{kind}(f)", lambda *x: x[2].astype(kind)
    names = [*ONE] if random.random() < 0.5 else [*TWO]
    name = str(random.choice(names))
    parts = [program(random, depth - 1) for _ in range(1 if name in ONE else 2)]

    def run(*x: Any) -> Any:
        operands = [part(*x) for _, part in parts]
        if len(operands) == 2:
            operands[1] = operands[1].astype(operands[0].dtype)
        return (ONE | TWO)[name](*operands)

    return f"{name}({', '.join(text for text, _ in parts)})", run


def escapes(seed: int, boxes: int = 6, points: int = 48) -> list[str]:
    """Return which values of a random program lie outside of their sets, as sentences."""
    random = np.random.default_rng(seed)
    text, run = program(random, int(random.integers(1, 4)))
    kinds = [np.dtype(str(random.choice(TYPES))) for _ in range(2)]
    sets, drawn = [], []
    for kind in kinds:
        info = np.iinfo(kind)
        ends = random.integers(info.min, info.max, (boxes, SIZE, 2), endpoint=True)
        near = random.integers(max(info.min, -5), 12, (boxes, SIZE, 2))
        ends = np.sort(np.where(random.random((boxes, SIZE, 1)) < 0.6, near, ends))
        ends = np.where(random.random((boxes, SIZE, 1)) < 0.3, ends[..., :1], ends)
        low, high = ends[..., 0].astype(np.int64), ends[..., 1].astype(np.int64)
        sets.append(Whole(low, high, kind))
        some = random.integers(low, high, (points, boxes, SIZE), endpoint=True)
        edge = np.where(random.random(some.shape) < 0.5, low, high)
        drawn.append(np.where(random.random((points, 1, 1)) < 0.6, edge, some).astype(kind))
    scale = 10.0 ** random.integers(0, 12, (boxes, SIZE, 1))
    ends = np.sort((random.normal(size=(boxes, SIZE, 2)) * scale).astype(np.float32))
    sets.append(Form.leaf(ends[..., 0].astype(float), ends[..., 1].astype(float),
                          np.eye(SIZE), np.dtype(np.float32)))  # fmt: skip
    share = np.round(random.random((points, boxes, SIZE)), int(random.integers(0, 3)))
    drawn.append(np.clip(ends[..., 0] + share * (ends[..., 1] - ends[..., 0]), ends[..., 0],
                         ends[..., 1]).astype(np.float32))  # fmt: skip
    closed = jax.make_jaxpr(run)(*(x[0, 0] for x in drawn))
    try:
        (value,) = Interpreter(boxes, SIZE)(closed, sets)
    except MissingRule as error:
        return [f"refused: {error}"]
    batched = jax.vmap(jax.vmap(run))
    low, high = (np.broadcast_to(end, (boxes, SIZE)) for end in (value.low, value.high))
    found = []
    for values in (np.asarray(jax.jit(batched)(*drawn)), np.asarray(batched(*drawn))):
        wrong = (values < low) | (values > high)
        for which in np.argwhere(wrong)[:1]:
            at = tuple(which)
            found.append(
                f"{seed}: {text} of {[str(k) for k in kinds]} at "
                f"{[x[at[:2]].tolist() for x in drawn]} is {values[at]}, not in "
                f"[{low[at[1:]]}, {high[at[1:]]}]"
            )
    return found
