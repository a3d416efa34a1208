"""The error of a policy that cannot be loaded."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from verifai_jax.core.messages.text import one_line
from verifai_jax.core.store.foreign_files import ForeignFileError

MAX_BYTES = 150_000_000
"""Maximum bytes of a file, also after unpacking; policies for control have a thousandth."""
MAX_NUMBERS = 2**24
"""Maximum count of numbers that a graph computes for one observation; policies need 1 %."""
MAX_VALUES = 100_000
"""Maximum count of values in a pickle, and of nodes in a graph."""


class PolicyError(ValueError):
    """An error for a file or an object that is not a usable policy."""


@contextmanager
def refused(what: str, said: Callable[[BaseException], str] = str) -> Iterator[None]:
    """Make any other error within a `PolicyError` of one line: this text, and what it `said`."""
    try:
        yield
    except PolicyError:
        raise
    except ForeignFileError as error:
        raise PolicyError(str(error)) from error
    except Exception as error:
        raise PolicyError(f"{what}: {one_line(said(error))}") from error
