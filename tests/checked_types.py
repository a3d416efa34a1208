"""The type checker of the tests: beartype, which takes an int where a float is wanted.

install_import_hook("verifai_jax.estimation", "checked_types.check")
with unchecked():
    estimate("no problem")          # the function's own message, not the checker's
"""

import contextlib
from collections.abc import Iterator

import jaxtyping
from beartype import BeartypeConf, beartype

check = beartype(conf=BeartypeConf(is_pep484_tower=True))


@contextlib.contextmanager
def unchecked() -> Iterator[None]:
    """Let values of a wrong kind through, to read what a function itself says of them."""
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)
