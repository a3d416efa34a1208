"""Values of programs: sets of real numbers, and sets of whole numbers and truth values."""

from typing import TypeAlias

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from verifai_jax.addons.verification.sets.form import Form
from verifai_jax.addons.verification.sets.whole import Whole

Value: TypeAlias = Form | Whole


class MissingRule(NotImplementedError):
    """An error for an operation of a program that has no rule for sets."""


def constant(value: ArrayLike, dtype: np.dtype) -> Value:
    """Return a constant of a program as a set."""
    if jnp.issubdtype(dtype, jnp.floating):
        return Form.constant(np.asarray(value), np.dtype(dtype))
    if (jnp.issubdtype(dtype, jnp.integer) and dtype != jnp.uint64) or dtype == jnp.bool_:
        return Whole.constant(np.asarray(value), np.dtype(dtype))
    raise MissingRule(f"sets do not support numbers of type {dtype}")


def as_form(value: Value) -> Form:
    """Return a value that is a real number; others raise `NotImplementedError`."""
    if not isinstance(value, Form):
        raise NotImplementedError("whole numbers where only real ones are supported")
    return value


def as_whole(value: Value) -> Whole:
    """Return a whole number or a truth value; others raise `NotImplementedError`."""
    if not isinstance(value, Whole):
        raise NotImplementedError("real numbers where only whole ones are supported")
    return value
