"""Symbols of loops, which keep nonlinear uncertainties correlated.

If each step of a loop enclosed the set of states in a box, the boxes would grow. Here the
uncertainties of a loop's carried numbers are symbols, which the next step treats like those of the
features. Once there are many, the shortest are replaced by those of one parallelepiped.

Source: R. Lohner, Enclosing the solutions of ordinary initial and boundary value problems (1987);
N. Nedialkov, K. Jackson, G. Corliss, Validated solutions of initial value problems for ordinary
differential equations, Applied Mathematics and Computation 105 (1999), section 6. A. Girard,
Reachability of uncertain linear systems using zonotopes, HSCC (2005).
"""

import itertools
from collections.abc import Sequence

import numpy as np

from verifai_jax.addons.verification.sets.arrays import together
from verifai_jax.addons.verification.sets.form import SLACK, Form, Frame, padded
from verifai_jax.addons.verification.sets.values import as_form
from verifai_jax.addons.verification.sets.whole import Whole

WIDEST = 24
"""Numbers that a loop carries at most for its symbols to be worth their cost, which is squared."""
FINE, COARSE, FINE_BOXES = (20, 15), (6, 4), 64
"""Symbols for each number that a loop carries, beyond which they are made fewer, and how many are
left then: the longest, and those of one parallelepiped around the others. If all become a
parallelepiped, the TORA of benchmarks/ainncs.py has no bounds. Many boxes are small ones, for which
fewer symbols do, and which take twice the time with more."""
_NUMBERS = itertools.count(1)


def framed(carry: Sequence[Form | Whole], boxes: int, features: int) -> list[Form | Whole]:
    """Return what a loop carries, with its uncertainties as symbols of a new frame.

    Integers, and values equal for all boxes, stay unchanged.
    """
    kept = {i: v for i, v in enumerate(carry)
            if isinstance(v, Form) and (v.slopes is not None or len(v.centre) > 1)}  # fmt: skip
    out, sizes = list(carry), [int(np.prod(v.shape, dtype=np.int64)) for v in kept.values()]
    count = sum(sizes)
    if not count or count > WIDEST:
        return [v.unframed() if isinstance(v, Form) else v for v in carry]
    flat = [v.moved(lambda a, lead: a.reshape(*a.shape[:lead], -1)) for v in kept.values()]
    ends = [np.concatenate([np.broadcast_to(v.bounds()[side], (boxes, *v.shape)) for v in flat], 1)
            for side in (0, 1)]  # fmt: skip
    whole = as_form(together(flat, np.concatenate))
    old = max(0 if whole.slopes is None else len(whole.slopes), features)
    slopes = np.broadcast_to(padded(whole, old), (old, boxes, count))
    centre, radius, size = (
        np.broadcast_to(each, (boxes, count)) for each in (whole.centre, whole.radius, whole.size)
    )
    bounded = np.isfinite(radius)
    radius = np.where(bounded, radius, 0.0)
    noise = np.zeros((boxes, count, old - features + count))
    noise[:, :, : old - features] = slopes[features:].transpose(1, 2, 0)
    noise[:, np.arange(count), old - features + np.arange(count)] = radius
    sides, rest = noise, np.zeros((boxes, count))
    limit, left = FINE if boxes <= FINE_BOXES else COARSE
    if noise.shape[2] > limit * count:
        sides, rest = _reduced(noise, left)
    new = np.concatenate([slopes[:features], sides.transpose(2, 0, 1)])
    radius = np.where(bounded, rest + 4 * SLACK * np.abs(noise).sum(2), np.inf)
    size = np.minimum(size, np.maximum(*map(np.abs, ends)))
    frame = Frame(next(_NUMBERS), features)
    for i, value, stop, each in zip(kept, kept.values(), np.cumsum(sizes), sizes, strict=True):
        part, shape = slice(stop - each, stop), (boxes, *value.shape)
        pieces = [array[:, part].reshape(shape) for array in (centre, radius, size, *ends)]
        own = new[:, :, part].reshape(len(new), *shape)
        # Bounded numbers get no interval: what is computed with it would cost, and is no tighter.
        low, high = (None, None) if np.isfinite(pieces[1]).all() else (pieces[3], pieces[4])
        out[i] = Form(pieces[0], own, pieces[1], pieces[2], value.dtype, low, high, frame)
    return out


def _reduced(noise: np.ndarray, of_each: int) -> tuple[np.ndarray, np.ndarray]:
    """Return fewer symbols that contain those of `noise`: the longest ones, and a parallelepiped.

    A parallelepiped around all of them would forget how the longest ones move together.
    """
    count = noise.shape[1]
    size = np.abs(noise / np.maximum(np.abs(noise).sum(2, keepdims=True), 1e-300))
    # Girard: what a box around a symbol has more than the symbol itself.
    gain = size.sum(1) - size.max(1)
    order = np.argsort(-gain, axis=1, kind="stable")
    arranged = np.take_along_axis(noise, order[:, None, :], axis=2)
    kept = (of_each - 1) * count
    sides, rest = _sides(arranged[:, :, kept:])
    return np.concatenate([arranged[:, :, :kept], sides], axis=2), rest


def _sides(noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return sides of parallelepipeds around zonotopes, as columns, and what rounding misses."""
    scale = np.abs(noise).sum(2)
    count = noise.shape[1]
    unit = noise / np.where(scale > 0, scale, 1.0)[:, :, None]
    own = np.arange(count)
    unit[:, own, own - count] += scale == 0
    rows = np.arange(len(unit))
    rest, own_sides = unit, np.empty_like(unit[:, :, :count])
    turned = np.empty_like(own_sides)
    for k in range(count):
        # The longest of what is not spanned yet.
        longest = np.argmax(np.square(rest).sum(1), axis=1)
        side = rest[rows, :, longest]
        side = side / np.linalg.norm(side, axis=1, keepdims=True)
        turned[:, :, k] = side
        whole = unit[rows, :, longest]
        own_sides[:, :, k] = whole / np.linalg.norm(whole, axis=1, keepdims=True)
        rest = rest - side[:, :, None] * (side[:, None] @ rest)
    # Sides as they are lose nothing of what they carry, orthogonal ones less of what is new.
    skewed = _around(unit, own_sides, np.linalg.inv(own_sides))
    straight = _around(unit, turned, turned.transpose(0, 2, 1))
    better = np.abs(skewed[0]).sum((1, 2)) <= np.abs(straight[0]).sum((1, 2))
    sides = np.where(better[:, None, None], skewed[0], straight[0]) * scale[:, :, None]
    missed = np.where(better[:, None], skewed[1], straight[1])
    return sides, scale * (missed + 2.0**-45) * 2


def _around(
    unit: np.ndarray, frame: np.ndarray, inverse: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the sides along a frame, and what an inverse that is not exact misses."""
    lengths = np.abs(inverse @ unit).sum(2)
    missed = np.abs(np.eye(unit.shape[1]) - frame @ inverse).sum(2)
    return frame * lengths[:, None, :], missed
