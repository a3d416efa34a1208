"""Code of the user that may fork."""

import contextlib
import os
from collections.abc import Iterator


@contextlib.contextmanager
def returning_once() -> Iterator[None]:
    """Run user code that may fork, and continue only in the original process.

    A forked copy that returns, for example because `exec` failed, ends silently: otherwise it would
    answer for its parent, and write into the folder of its parent's run.
    """
    owner = os.getpid()
    try:
        yield
    finally:
        if os.getpid() != owner:
            os._exit(1)
