"""The two precisions of simulations, verdicts and gradients."""

import threading
import weakref
from contextlib import AbstractContextManager
from functools import cache

import jax
import numpy as np

PRECISIONS = ("float32", "float64")


def in_precision(precision: str) -> AbstractContextManager[None]:
    """Return a context in which JAX computes in `"float32"` or `"float64"`.

    NumPy arrays that a traced function closes over become constants of that precision, whatever
    the function was traced in before.

    **Raises:** `ValueError` for another precision.
    """
    if precision not in PRECISIONS:
        raise ValueError(
            f"precision must be {' or '.join(map(repr, PRECISIONS))}; got {precision!r}"
        )
    _give_constants_their_precision()
    return jax.enable_x64(precision == "float64")  # pyright: ignore[reportReturnType]


@cache
def _give_constants_their_precision() -> None:
    """Let JAX make the constant of a NumPy array anew for each precision.

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
