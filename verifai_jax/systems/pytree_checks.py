"""Checks of the results of a user's functions, before anything compiles.

States, controls and memories are pytrees; here they are compared leaf by leaf, by name.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree


def as_floating(tree: PyTree, origin: str) -> Any:
    """Return the same pytree with all leaves as arrays of one floating-point dtype.

    **Raises:** `ValueError`, naming `origin`, for a tree without leaves, or with one that is not
    real.
    """
    leaves = jax.tree.leaves(tree)
    if not leaves:
        raise ValueError(f"{origin} must return a state; got {tree!r}, which has no numbers in it")
    for path, leaf in jax.tree.leaves_with_path(tree):
        if not _is_real(leaf):
            raise ValueError(f"{origin} must return real numbers; {_name(path)} is {leaf!r}")
    dtype = jnp.result_type(float, *leaves)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), tree)


def in_working_precision(tree: PyTree) -> Any:
    """Return a pytree as arrays, with real numbers in JAX's present precision.

    Values made outside a system have the precision that JAX had at that time.
    """
    real = jnp.result_type(float)

    def leaf(value: Any) -> Any:
        array = jnp.asarray(value)
        other = jnp.issubdtype(array.dtype, jnp.floating) and array.dtype != real
        return array.astype(real) if other else array

    return jax.tree.map(leaf, tree)


def as_precise_as(tree: PyTree, like: PyTree) -> Any:
    """Return a pytree with real numbers in the precision of those in a similar one."""

    def leaf(value: Any, other: Any) -> Any:
        have, want = getattr(value, "dtype", None), getattr(other, "dtype", None)
        return value if have == want or not _both_real(have, want) else jnp.asarray(value, want)

    if jax.tree.structure(tree) != jax.tree.structure(like):
        return tree  # `check_like` says it.
    return jax.tree.map(leaf, tree, like)


def _both_real(one: Any, other: Any) -> bool:
    return all(kind is not None and jnp.issubdtype(kind, jnp.floating) for kind in (one, other))


def check_like(
    got: PyTree, wanted: PyTree, origin: str, role: str, note: str = "", *,
    same_precision: bool = True,
) -> None:  # fmt: skip
    """Refuse a pytree of shapes that differs from the `wanted` one in structure, shape or dtype.

    A weakly typed number (a Python literal) matches any dtype to which it can be converted.

    **Arguments:**
    - `same_precision`: whether real numbers must have the same number of bits; if not, the caller
      converts them (`as_precise_as`).
    **Raises:** `ValueError` with the form that `origin` must return as `role`, and the first
    difference.
    """
    must = f"{origin} must return {role}"
    if jax.tree.structure(got) != jax.tree.structure(wanted):
        raise ValueError(f"{must}: {outline(wanted)}; got {outline(got)}{note}")
    pairs = zip(jax.tree.leaves_with_path(wanted), jax.tree.leaves(got), strict=True)
    for (path, want), have in pairs:
        if have.shape != want.shape:
            raise ValueError(
                f"{must}; {_name(path)} must have shape {list(want.shape)}, "
                f"got {list(have.shape)}{note}"
            )
        fits = have.dtype == want.dtype or (
            have.weak_type and jnp.promote_types(have.dtype, want.dtype) == want.dtype
        )
        fits = fits or (not same_precision and _both_real(have.dtype, want.dtype))
        if not fits:
            real = jnp.issubdtype(have.dtype, jnp.floating)
            hint = ", so begin with a real number, such as 0.0" if real else ""
            raise ValueError(
                f"{must}; {_name(path)} must be {want.dtype}, got {have.dtype}{hint}{note}"
            )


def default_signals(state: PyTree, control: PyTree) -> dict[str, Array]:
    """Return signals named after the parts of the state and of the control.

    A state without names (an array, a plain tuple) has no default. For a pair `(positions,
    velocities)` of dictionaries, the names of both are used. A control without names is called
    `control`.

    **Raises:** `ValueError` if there are no names, or one is used twice.
    """
    parts = [_named(state)]
    if parts[0] is None and isinstance(state, tuple | list):
        parts = [_named(part) for part in state]
    if any(part is None for part in parts):
        raise ValueError(
            f"a state of the form {outline(state)} has no names to call its signals by; "
            "give signals=..., a function (time, state, control, features) -> dict"
        )
    if control is not None:
        named = _named(control)
        parts.append({"control": control} if named is None else named)
    signals: dict[str, Array] = {}
    for part in parts:
        for name, value in (part or {}).items():
            if name in signals:
                raise ValueError(
                    f"two parts of the state and the control are called {name!r}; "
                    "give signals=... to tell them apart"
                )
            signals[name] = value
    return signals


def check_signals(signals: object) -> None:
    """Refuse samples that a `Trace` cannot hold.

    **Raises:** `ValueError` for anything but a dictionary of scalars and vectors.
    """
    if not isinstance(signals, Mapping) or not signals:
        raise ValueError(
            f"signals must return a dictionary of named samples; got {outline(signals)}"
        )
    for name, value in signals.items():
        if not hasattr(value, "shape") or len(value.shape) > 1:
            raise ValueError(
                f"signal {name!r} must be a scalar or a vector at each sample; got "
                f"{outline(value)}; choose the signals of the trace with signals="
            )


def _named(tree: PyTree) -> dict[str, Any] | None:
    if isinstance(tree, Mapping):
        return {str(name): value for name, value in tree.items()}
    fields = getattr(tree, "_fields", None)
    return None if fields is None else dict(zip(fields, tree, strict=True))


def _is_real(leaf: object) -> bool:
    try:
        dtype = jnp.result_type(leaf)
    except TypeError:
        return False
    return jnp.issubdtype(dtype, jnp.floating) or jnp.issubdtype(dtype, jnp.integer)


def _name(path: jax.tree_util.KeyPath) -> str:
    return jax.tree_util.keystr(path) or "it"


def outline(tree: PyTree) -> str:
    """Describe a tree in one line, arrays by dtype and shape: `{'x': float32[]}`."""

    def leaf(value: Any) -> str:
        if not hasattr(value, "shape"):
            return repr(value)
        return f"{value.dtype}[{','.join(map(str, value.shape))}]"

    return str(jax.tree.map(lambda value: _Verbatim(leaf(value)), tree))


class _Verbatim(str):
    """Text that prints without quotes."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)
