"""Translated programs as libraries of machine code, compiled once and kept on disk.

name = library_name(fingerprint)                    # `Unavailable` without a compiler
library = load(name, lambda: translate(program))    # or `Unavailable`, which says why
library(rows, key, first, temperatures, numbers)    # [n, count] of bits
"""

import contextlib
import ctypes
import hashlib
import platform
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt32

from verifai_jax.addons.native.native_code import machine_code
from verifai_jax.addons.native.native_code.source import OTHERS, PRELUDE
from verifai_jax.core.compute.remembered import remembered_as
from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.core.store.foreign_files import read_bytes

FLAGS = (
    "-std=c++11", "-march=native", "-ffp-contract=fast",
    "-fno-math-errno", "-fno-trapping-math", "-fno-exceptions", "-fno-rtti", "-pthread",
)  # fmt: skip
"""Not `-ffast-math`, which takes NaN for a number. XLA contracts to fused operations, too."""
LONG = 8000
"""Lines of a program from which on it is compiled with -O1: in half the time, and slower by a
twentieth (a reverse sweep) to a third (a rollout)."""
PARTS = 4
"""Parts of a batch for each thread, so that a core that is busy delays the others less."""


class Library:
    """A loaded library that simulates a batch.

    - `path`: its file.
    - `count`: number of results of a simulation.
    """

    def __init__(self, path: Path, loaded: ctypes.CDLL, count: int) -> None:
        self.path, self.count = path, count
        self._width = int(loaded.width())
        self._run = loaded.run
        pointer, whole = ctypes.c_void_p, ctypes.c_long
        self._run.argtypes = [
            pointer, pointer, ctypes.c_int, pointer, pointer, whole, whole, ctypes.c_int, pointer,
        ]  # fmt: skip

    def __call__(
        self, rows: Float[np.ndarray, "n d"], key: UInt32[np.ndarray, "2"], first: int,
        temperatures: Float[np.ndarray, " n"], numbers: Float[np.ndarray, " numbers"], threads: int,
    ) -> UInt32[np.ndarray, "n count"]:  # fmt: skip
        """Simulate rows whose first one has this number, on several threads."""
        rows = np.ascontiguousarray(rows, np.float32)
        key, numbers = np.ascontiguousarray(key, np.uint32), np.ascontiguousarray(numbers)
        temperatures = np.ascontiguousarray(temperatures, np.float32)
        out = np.empty((self.count, len(rows)), np.uint32)
        blocks = -(-len(rows) // self._width)
        size = -(-blocks // (threads * PARTS if threads > 1 else 1)) * self._width
        inputs = [each.ctypes.data for each in (rows, key, temperatures, numbers)]
        others = min(threads, blocks, OTHERS + 1) - 1
        given, more, to = inputs[:2], inputs[2:], out.ctypes.data
        if len(rows) and self._run(*given, first, *more, len(rows), size, others, to):
            raise MemoryError("there is no memory for the arrays of a native program")
        return out.T


def library_name(fingerprint: str | None) -> str:
    """Return the name of a program's library, a hash of all that it depends on.

    **Arguments:**
    - `fingerprint`: the fingerprint of the program; None if it has none.
    **Raises:** `Unavailable` if there is no compiler, no cache folder, or no fingerprint.
    """
    tool = machine_code.compiler()
    about = tool.stat()
    which = (str(tool), about.st_size, about.st_mtime_ns, _processor(), FLAGS, PRELUDE)
    name = remembered_as("native", fingerprint, which)
    if name is None:
        raise machine_code.Unavailable("a part of the program cannot be hashed")
    return name


def load(name: str, count: int, translate: Callable[[], str], quickly: bool = False) -> Library:
    """Return the library with this name, compiling it if there is none.

    **Arguments:**
    - `name`: the name from `library_name`.
    - `count`: number of results of a simulation.
    - `translate`: a function that returns the source.
    - `quickly`: whether to compile in half the time, used for reverse sweeps.
    **Raises:** `Unavailable` if it cannot be compiled, stored or loaded.
    """

    def program() -> machine_code.Program:
        source = translate()
        effort = "-O1" if quickly or source.count("\n") > LONG else "-O2"
        return source, (effort, *FLAGS)

    return Library(*machine_code.load_library(name, program, ("width", "run")), count)


def is_approved(path: Path) -> bool | None:
    """Return whether the library in a file agrees with XLA, as stored by `approve`, or None."""
    try:
        known = read_bytes(path.with_suffix(".agrees"))
    except OSError:
        return None
    return next((agrees for agrees in (True, False) if known == _record(path, agrees)), None)


def approve(path: Path, agrees: bool) -> None:
    """Store whether the library in a file agrees with XLA, for later processes."""
    # If it cannot be stored, it is compared again.
    with contextlib.suppress(OSError), replacing(path.with_suffix(".agrees")) as partial:
        partial.write_bytes(_record(path, agrees))


def _record(path: Path, agrees: bool) -> bytes:
    text = f"{path.stem} {'agrees' if agrees else 'differs'}"
    return f"{text} {hashlib.sha256(text.encode()).hexdigest()}\n".encode()


@cache
def _processor() -> str:
    """Return what decides which instructions a compiler may use."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    wanted = ("model name", "flags", "Features", "CPU part")
    known = sorted({line for line in lines if line.startswith(wanted)})
    return "\n".join([platform.system(), platform.machine(), platform.processor(), *known])
