"""Programs compiled side by side: XLA compiles outside of Python's lock, one program a core.

    ask = compile_soon("the search", jax.jit(f).lower(state))   # at once, in the background
    ask(state)                                          # waits until it is compiled, and calls it
    describe_compilation()                              # "compiling the search, 3 s"

What a program computes does not depend on when it was compiled, so neither do results.
"""

import gc
import threading
import time
from collections.abc import Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import Any

import jax

from verifai_jax.core.cores import available_cores
from verifai_jax.core.devices import enable_compile_cache

_running: dict[int, tuple[str, float]] = {}
"""What is being compiled: a name for people, and when it began."""
_lock = threading.Lock()


class Compilation:
    """A program that is being compiled, or is already; calling it waits until it is.

    - `name`: of the program, for people.
    """

    def __init__(self, name: str, lowered: jax.stages.Lowered) -> None:
        self.name = name
        self._lowered: jax.stages.Lowered | None = lowered
        self._future: Future[jax.stages.Compiled] = _pool().submit(_compiled, name, lowered)
        self._program: jax.stages.Compiled | None = None

    def result(self) -> jax.stages.Compiled:
        """Return the compiled program, once it is compiled.

        **Raises:** what the compiler raised.
        """
        if self._program is None:
            try:
                self._program = self._future.result()
            except CancelledError:
                assert self._lowered is not None
                self._program = _compiled(self.name, self._lowered)
            except KeyboardInterrupt:
                # Or else the process would not end before all others are compiled.
                _cancel_waiting()
                raise
            self._lowered = None
        return self._program

    def __call__(self, *arguments: Any) -> Any:
        """Call the program."""
        return (self._program or self.result())(*arguments)


def compile_soon(name: str, lowered: jax.stages.Lowered) -> Compilation:
    """Compile a program in the background.

    **Arguments:**

    - `name`: of the program, for people: "the search".
    - `lowered`: the program, lowered by JAX.
    """
    enable_compile_cache()
    return Compilation(name, lowered)


@contextmanager
def tracing() -> Iterator[None]:
    """Return a context, or a decorator, for tracing programs: the garbage collector waits.

    What is traced is millions of small objects that live until all is compiled. The collector
    would look at all of them again and again, for a fifth of the time.
    """
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def describe_compilation() -> str:
    """Say what is being compiled and for how long so far; empty where nothing is."""
    with _lock:
        running = list(_running.values())
    if not running:
        return ""
    names = dict.fromkeys(name for name, _ in running)
    seconds = time.perf_counter() - min(began for _, began in running)
    return f"compiling {' and '.join(names)}, {seconds:.0f} s"


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(available_cores(), "compile")


def _cancel_waiting() -> None:
    """Give up what waits for its turn; it is compiled when it is called, if it ever is."""
    _pool().shutdown(wait=False, cancel_futures=True)
    _pool.cache_clear()


def _compiled(name: str, lowered: jax.stages.Lowered) -> jax.stages.Compiled:
    place = threading.get_ident()
    with _lock:
        _running[place] = (name, time.perf_counter())
    try:
        return lowered.compile()
    finally:
        with _lock:
            del _running[place]
