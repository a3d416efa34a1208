"""Processes that are killed in place of each operation on files that they begin."""

import os
import sys
import threading
import traceback
import warnings
from collections.abc import Callable

CHANGES = {"os.mkdir", "os.remove", "os.rename", "os.rmdir", "os.link", "os.symlink", "os.truncate",
           "fsync"}  # fmt: skip
"""Events of Python's audit of operations that change files, besides `open` for writing, and ours
of `os.fsync`, which has none."""
KILLED = 9


def killed_at(number: int, work: Callable[[], object]) -> bool:
    """Run work in a forked child that dies in place of an operation; return whether it did."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Of JAX, whose threads the child does not need.
        child = os.fork()
    if child == 0:
        status, seen, own = 1, 0, threading.get_ident()

        def watch(event: str, arguments: tuple[object, ...]) -> None:
            nonlocal seen
            writes = event == "open" and isinstance(arguments[2], int)
            writes = writes and arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
            if (writes or event in CHANGES) and threading.get_ident() == own:
                seen += 1
                if seen == number:
                    os._exit(KILLED)

        try:
            sys.addaudithook(watch)
            work()
            status = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert status in (0, KILLED), f"the work itself ended with {status}"
    return status == KILLED


def killed_everywhere(work: Callable[[], object], check: Callable[[], object]) -> int:
    """Kill work in place of its first operation, its second and so on; check after each.

    `check` brings back what the work begins from. Return the number of operations.
    """
    number, synchronise = 1, os.fsync
    os.fsync = lambda file: sys.audit("fsync")  # The disk itself lives on.
    try:
        while killed_at(number, work):
            check()
            number += 1
    finally:
        os.fsync = synchronise
    return number - 1
