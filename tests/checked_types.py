"""The type checker of the tests: beartype, which takes NumPy's numbers for Python's.

install_import_hook("verifai_jax.estimation", "checked_types.check")
with unchecked():
    estimate("no problem")          # the function's own message, not the checker's
"""

import contextlib
from collections.abc import Iterator

import jaxtyping
import numpy as np
from beartype import BeartypeConf, FrozenDict, beartype

NUMBERS = FrozenDict({int: int | np.integer, float: float | int | np.floating | np.integer})
"""An integer will do where a number is wanted, and NumPy's scalars are numbers."""

check = beartype(conf=BeartypeConf(hint_overrides=NUMBERS))


@contextlib.contextmanager
def unchecked() -> Iterator[None]:
    """Let values of a wrong kind through, to read what a function itself says of them."""
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)
