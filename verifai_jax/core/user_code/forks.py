"""Code of the user that may fork."""

import contextlib
import os
from collections.abc import Iterator


@contextlib.contextmanager
def returning_once() -> Iterator[None]:
    """Run code of the user that may fork: only the process that entered goes on after it.

    A copy of this process that comes back, as where an `exec` fails, ends without a word: it would
    answer for its parent, and write into the folder of its parent's run.
    """
    owner = os.getpid()
    try:
        yield
    finally:
        if os.getpid() != owner:
            os._exit(1)
