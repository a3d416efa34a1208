"""The two precisions of simulations, verdicts and gradients."""

import re
import threading
import warnings
import weakref
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import cache
from typing import Any

import jax
import numpy as np

from verifai_jax.core.compute.keys import IMPLEMENTATION

PRECISIONS = ("float32", "float64")
_TRUNCATION = re.compile("Explicitly requested dtype .* is not available")


def in_precision(precision: str) -> AbstractContextManager[None]:
    """Return a context in which JAX computes in `"float32"` or `"float64"`.

    NumPy arrays in the closure of a traced function become constants of that precision, even if the
    function was traced in another one before.

    **Raises:** `ValueError` for another precision.
    """
    if precision not in PRECISIONS:
        raise ValueError(
            f"precision must be {' or '.join(map(repr, PRECISIONS))}; got {precision!r}"
        )
    _give_constants_their_precision()
    return _computing_in(precision)


@contextmanager
def _computing_in(precision: str) -> Iterator[None]:
    x64 = jax.enable_x64(precision == "float64")
    with truncate_silently(), x64, reproducible_random(), whole_products():
        yield


def whole_products() -> AbstractContextManager[Any]:
    """Return a context in which accelerators multiply matrices in the elements' precision.

    By default a GPU rounds the factors of a float32 product to 10 bits (TF32), and a TPU to 7. On
    an H200 the actions of small networks were off by up to 5e-3, which changes verdicts. CPUs do
    not round, so nothing is changed there.
    """
    if jax.default_backend() == "cpu":
        return nullcontext()
    return jax.default_matmul_precision("highest")


@contextmanager
def reproducible_settings() -> Iterator[None]:
    """Return a context, or a decorator, in which a user's JAX settings do not affect results.

    Random numbers depend on the generator and its settings, all types on x64. A run uses the
    settings that its seed refers to, whatever the user's configuration.
    """
    with jax.enable_x64(False), reproducible_random():
        yield


@contextmanager
def reproducible_random() -> Iterator[None]:
    """Return a context, or a decorator, with the random generator that seeds refer to."""
    with jax.threefry_partitionable(True), jax.default_prng_impl(IMPLEMENTATION):
        yield


@contextmanager
def truncate_silently() -> Iterator[None]:
    """Suppress JAX's warning that a system's float64 is truncated, since a run sets the precision.

    A system that calls `jnp.asarray(x, float)` works in both precisions, so the advice to enable
    x64 for all of JAX does not help its author. All other warnings are unaffected. The filter is
    inserted into the list itself, because `warnings.catch_warnings` would make Python forget which
    warnings of the user's code it has shown.
    """
    filters: list[object] = warnings.filters  # pyright: ignore[reportAssignmentType]
    filters.insert(0, entry := ("ignore", _TRUNCATION, UserWarning, None, 0))
    try:
        yield
    finally:
        filters.remove(entry)


@cache
def _give_constants_their_precision() -> None:
    """Let JAX make the constant of a NumPy array again for each precision.

    JAX remembers the constant by the array alone: as long as a program that was traced in one
    precision is alive, the array is a constant of that precision in all others too, and they do
    not compile ("Cannot lower jaxpr"), or compute with rounded numbers. JAX lets the conversion of
    a type be registered; one that looks at the precision is registered for arrays. It is no
    public interface: where a version of JAX has none, its own conversion stays.
    """
    try:
        from jax._src import dtypes, literals

        typed, register = literals.TypedNdArray, dtypes.canonicalize_value_handlers.__setitem__
    except (ImportError, AttributeError):
        return
    constants: dict[tuple[int, np.dtype], tuple[weakref.ref, weakref.ref]] = {}
    lock = threading.Lock()

    def constant(array: np.ndarray) -> np.ndarray:
        dtype = dtypes.canonicalize_dtype(array.dtype)
        name = (id(array), dtype)
        with lock:
            known = constants.get(name)
            # One object as long as it is used: a program then has one constant for each array.
            made = None if known is None or known[0]() is not array else known[1]()
            if made is None:
                made = typed(np.asarray(array, dtype))

                def forget(_: weakref.ref, name: tuple[int, np.dtype] = name) -> None:
                    constants.pop(name, None)

                constants[name] = (weakref.ref(array), weakref.ref(made, forget))
            return made

    register(np.ndarray, constant)
