"""Products of matrices and convolutions, on sets."""

import functools
import math
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from verifai_jax.addons.verification.sets.arrays import add_up, times_each
from verifai_jax.addons.verification.sets.form import Form, is_point, rounded
from verifai_jax.addons.verification.sets.interpreter import Interpreter, rule
from verifai_jax.addons.verification.sets.layers import SLACK, refined, through_layer
from verifai_jax.addons.verification.sets.values import Value, constant
from verifai_jax.addons.verification.sets.whole import Whole
from verifai_jax.core.compute.precision import in_precision

WORTH = 0.002
"""Share of the spread from which on what is not linear is worth remembering."""
WINDOW = ("window_strides", "padding", "lhs_dilation", "rhs_dilation")
Axes = tuple[Sequence[int], Sequence[int]]


@rule("dot_general")
def _dot(t: Interpreter, step: Any, inputs: list[Value]) -> list[Value]:
    contracted, batched = step.params["dimension_numbers"]
    form = step.outvars[0].aval
    return [_contracted(t, inputs[0], inputs[1], contracted, batched, np.dtype(form.dtype))]


def _contracted(
    t: Interpreter, a: Value, b: Value, contracted: Axes, batched: Axes, dtype: np.dtype
) -> Value:
    """Return sums of products over the contracted axes, those of each batch apart."""
    letters = iter("abcdefghijklmnopqrstuvw")
    joint = [next(letters) for _ in batched[0]], [next(letters) for _ in contracted[0]]
    names: list[str] = []
    for value, outer, inner in zip((a, b), batched, contracted, strict=True):
        known = dict(zip((*outer, *inner), (*joint[0], *joint[1]), strict=True))
        names.append("".join(known.get(i) or next(letters) for i in range(len(value.shape))))
    free = ["".join(c for c in name if c not in joint[0] + joint[1]) for name in names]
    result = "".join(joint[0]) + free[0] + free[1]
    for form, other, (own, its) in ((a, b, names), (b, a, names[::-1])):
        if isinstance(form, Whole) or isinstance(other, Whole):
            continue
        if is_point(other) and np.isfinite(other.centre).all():
            return _times(form, other.centre[0], own, its, result, dtype)
    axes = result + "".join(joint[1])

    def spread(name: str, array: np.ndarray, lead: int) -> np.ndarray:
        order = sorted(range(len(name)), key=lambda i: axes.index(name[i]))
        sizes = {name[i]: array.shape[lead + i] for i in range(len(name))}
        array = array.transpose(*range(lead), *(lead + i for i in order))
        return array.reshape(*array.shape[:lead], *(sizes.get(c, 1) for c in axes))

    a, b = (
        value.moved(functools.partial(spread, name))
        for value, name in zip((a, b), names, strict=True)
    )
    if isinstance(a, Whole) and isinstance(b, Whole):
        a, b = (Whole(each.low, each.high, dtype) for each in (a, b))
    return add_up(times_each(a, b), range(len(result), len(axes)))


def _times(
    a: Form, numbers: np.ndarray, own: str, its: str, result: str, dtype: np.dtype
) -> Form:  # fmt: skip
    """Return sums of products of a form and exact numbers, whose axes have names, as in einsum."""
    sizes = dict(zip(own + its, a.shape + numbers.shape, strict=True))
    terms, matrix = math.prod(sizes[c] for c in {*own + its} - {*result}), None
    if {*own}.isdisjoint(result):
        # A vector, whose sums are those of a matrix at once.
        matrix = numbers.transpose([its.index(c) for c in own + result])
        numbers = matrix = matrix.reshape(math.prod(a.shape), -1)

    def times(arrays: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        if matrix is None:
            names = f"...{own},{its}->...{result}"
            return np.einsum(names, arrays, numbers, optimize=["einsum_path", (0, 1)])
        lead = arrays.shape[: arrays.ndim - len(own)]
        sums = arrays.reshape(math.prod(lead), -1) @ numbers
        return sums.reshape(*lead, *(sizes[c] for c in result))

    shape = np.broadcast_shapes(a.centre.shape, a.radius.shape, a.size.shape)
    centre, radius, size = (np.broadcast_to(x, shape) for x in (a.centre, a.radius, a.size))
    gross, size = times(np.stack([radius, size]), np.abs(numbers))
    if a.slopes is None:
        return rounded(times(centre, numbers), None, gross, size, dtype, units=terms + 1.0)
    shape = np.broadcast_shapes((1, *shape), a.slopes.shape)
    parts = [np.broadcast_to(x, (len(x), *shape[1:])) for x in (a.slopes, centre[None])]
    linear = times(np.concatenate(parts), numbers)
    sums = rounded(linear[-1], linear[:-1], gross, size, dtype, None, a.frame, units=terms + 1.0)
    if a.radius.sum() > WORTH * a.spread.sum():
        if matrix is None:
            one = np.eye(math.prod(a.shape))
            matrix = times(one.reshape(len(one), *a.shape), numbers).reshape(len(one), -1)
        # Their rounding, and that of factors that go back through the matrix.
        alone = sums.radius - gross * (1 - (terms + 1) * SLACK)
        sums.common = through_layer(matrix, a, alone)
        if sums.common is not None:
            sums.radius = refined(sums.radius, sums.common)
    return sums


@rule("conv_general_dilated")
def _convolution(t: Interpreter, step: Any, inputs: list[Value]) -> list[Value]:
    """Collect the numbers that each result is a sum of, zeros for padding, and multiply those."""
    params, (image, kernel) = step.params, inputs
    forms, shape = params["dimension_numbers"], step.outvars[0].aval.shape
    groups, batches = params["feature_group_count"], params["batch_group_count"]
    dtype, parts = np.dtype(step.outvars[0].aval.dtype), groups * batches
    depth, inner, *taps = (kernel.shape[axis] for axis in forms.rhs_spec)
    points, each = [shape[a] for a in forms.out_spec[2:]], image.shape[forms.lhs_spec[0]] // batches
    numbers = np.arange(1.0, math.prod(image.shape) + 1).reshape(image.shape)
    with in_precision("float64"):
        patches = jax.lax.conv_general_dilated_patches(
            numbers, taps, *(params[name] for name in WINDOW), dimension_numbers=forms
        )
    # Zeros stand for padding.
    numbers = np.asarray(patches, np.int64).transpose(forms.out_spec) - 1
    numbers = numbers.reshape(batches, each, groups, inner * math.prod(taps), -1)
    # One part is a product of matrices, which is faster than one with an axis for parts.
    several = () if parts == 1 else (parts,)
    numbers = numbers.transpose(0, 2, 1, 4, 3).reshape(*several, -1, numbers.shape[3])
    flat = image.moved(lambda array, lead: array.reshape(*array.shape[:lead], -1))
    picked = flat.moved(lambda array, lead: array[..., np.maximum(numbers, 0)])
    if (numbers < 0).any():
        picked = times_each(picked, constant(1 * (numbers >= 0), flat.dtype))

    def arranged(array: np.ndarray, lead: int) -> np.ndarray:
        array = array.transpose(*range(lead), *(lead + axis for axis in forms.rhs_spec))
        return array.reshape(*array.shape[:lead], *several, depth // parts, numbers.shape[-1])

    last, joint = (len(several) + 1,), tuple(range(len(several)))
    found = _contracted(t, picked, kernel.moved(arranged), (last, last), (joint, joint), dtype)

    def placed(array: np.ndarray, lead: int) -> np.ndarray:
        front = array.shape[:lead]
        array = array.reshape(*front, parts, each, *points, depth // parts)
        order = (1, 0, 2 + len(points), *range(2, 2 + len(points)))
        array = array.transpose(*range(lead), *(lead + axis for axis in order))
        array = array.reshape(*front, each, depth, *points)
        back = np.argsort(forms.out_spec)
        return array.transpose(*range(lead), *(lead + int(axis) for axis in back))

    return [found.moved(placed)]
