"""Concurrent compilation of programs: XLA compiles outside of Python's lock, one program per core.

    ask = compile_soon("the search", jax.jit(f).lower(state))   # at once, in the background
    ask(state)                                          # waits until it is compiled, and calls it
    describe_compilation()                              # "compiling the search, 3 s"
    while_compiling(import_matplotlib)                  # at the first long wait, or never
    ENGINES: Slot[EngineMode, Engine] = Slot("engines")
    engine = problem.programs.get(ENGINES, mode, lambda: Engine(problem, *mode))

Results do not depend on the time of compilation. Programs compiled for an object are cached and
freed with it, in a slot that fixes the types of keys and values. Each shape needs its own program,
so numbers of rows are rounded up to powers of two.

XLA spends most of its time on optimisation. A program that runs only a few dozen times finishes
sooner with less of it (`XlaOptimization`), as compilation then takes a half to a fifth of the time.
"""

import threading
import time
from collections.abc import Callable, Hashable, Iterator, Mapping
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import cache, lru_cache, partial, wraps
from typing import Any, Generic, Literal, TypeVar, cast

import jax
import numpy as np

from verifai_jax.core.compute.cores import available_cores
from verifai_jax.core.compute.devices import enable_compile_cache
from verifai_jax.core.display.lazy import uncollected

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


@dataclass(frozen=True)
class Slot(Generic[K, V]):
    """A kind of cached value, by name; `K` is the type of its keys and `V` that of its values."""

    name: str


class ProgramCache:
    """Cached values by slot and key, which live as long as the object that owns the cache."""

    def __init__(self) -> None:
        self._slots: dict[str, dict[Hashable, object]] = {}

    def get(self, slot: Slot[K, V], key: K, make: Callable[[], V]) -> V:
        """Return the value of this key; `make` computes it the first time.

        If `make` raises, the error is passed on and nothing is stored.
        """
        values = self._slots.setdefault(slot.name, {})
        if key not in values:
            values[key] = make()
        return cast(V, values[key])

    def peek(self, slot: Slot[K, V], key: K) -> V | None:
        """Return the value of this key; None if it has not been made."""
        return cast("V | None", self._slots.get(slot.name, {}).get(key))

    def clear(self) -> None:
        """Remove all values, so that their memory can be freed."""
        self._slots.clear()


KEPT = 32
"""Values of static arguments whose programs `jit_each` keeps: those of a few dozen formulas."""


def jit_each(
    static: int = 1, inline: bool = False
) -> Callable[[Callable[..., V]], Callable[..., V]]:
    """Return a decorator like `jax.jit` for functions whose first arguments are static.

    Only the programs of the last `KEPT` static values are kept. `jax.jit` keeps those of all as
    long as the function lives, so a process that judges ever more formulas would grow without end.

    **Arguments:**
    - `static`: number of static arguments; they are hashable, and come first.
    - `inline`: whether the steps become those of a surrounding program.
    """

    def decorated(function: Callable[..., V]) -> Callable[..., V]:
        @lru_cache(KEPT)
        def compiled(*values: Hashable) -> Callable[..., V]:
            return jax.jit(partial(function, *values), inline=inline)

        @wraps(function)
        def call(*arguments: Any) -> V:
            return compiled(*arguments[:static])(*arguments[static:])

        return call

    return decorated


def power_of_two(count: int) -> int:
    """Return the least power of two that is at least `count`, and at least 1."""
    return 1 << max(count - 1, 0).bit_length()


def pad_rows(rows: Any, count: int | None = None) -> np.ndarray:
    """Return rows followed by copies of the last one.

    **Arguments:**
    - `rows`: an array `[n, ...]`; an empty one is returned unchanged.
    - `count`: number of rows of the result, at least `n`; the next power of two when left out.
    """
    rows = np.asarray(rows)
    missing = (power_of_two(len(rows)) if count is None else count) - len(rows)
    if not missing:
        return rows
    return np.concatenate([rows, np.repeat(rows[-1:], missing, axis=0)])


XlaOptimization = Literal["most", "little", "least"]
"""How much XLA does to make a program fast on a processor. `little` computes what `most` does, on
some processors to the last bit, in programs without long chains of products and sums; `least`
rounds each product."""
_OPTIONS: dict[XlaOptimization, dict[str, Any]] = {
    "most": {},
    "little": {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 2},
    "least": {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 0},
}
_WHOLE_LOOPS = {"xla_disable_hlo_passes": "cpu-parallel-task-assigner"}
"""Without the pass that splits a loop over cores: each time it is waited for takes longer than a
step of a simulation."""
_WIDE = {"xla_cpu_prefer_vector_width": 512}
"""The widest vectors of any processor, of which XLA takes half by itself: with them simulations ran
up to 1.25 times as fast."""
_running: dict[int, tuple[str, float]] = {}
"""What is being compiled: a name for people, and when it began."""
_lock = threading.Lock()
_waited = 0.0
"""Seconds that this process has waited for programs."""
LONG = 0.4
"""Seconds of waiting for a program, from which on work is done that is needed later only: it would
delay a result for which programs need but be loaded."""
_meanwhile: dict[Callable[[], object], float] = {}
"""What is done at the next wait for a program, and after how many seconds of it."""


class Compilation:
    """A program that is compiled or being compiled; calling it waits for the compilation.

    - `name`: the name of the program in messages.
    """

    def __init__(
        self, name: str, lowered: jax.stages.Lowered, effort: XlaOptimization = "most",
        splits: bool = True, wide: bool = False,
    ) -> None:  # fmt: skip
        self.name = name
        self._how: tuple[XlaOptimization, bool, bool] = effort, splits, wide
        self._lowered: jax.stages.Lowered | None = lowered
        self._future: Future[jax.stages.Compiled] = _pool().submit(
            _compiled, name, lowered, *self._how
        )
        self._program: jax.stages.Compiled | None = None

    def result(self) -> jax.stages.Compiled:
        """Wait for the compilation, and return the compiled program.

        **Raises:** the error of the compiler.
        """
        if self._program is None:
            began = time.perf_counter()
            try:
                for work, after in sorted(_meanwhile.items(), key=lambda each: each[1]):
                    wait([self._future], after)
                    if self._future.done():
                        break
                    if _meanwhile.pop(work, None) is not None:
                        work()
                self._program = self._future.result()
            except CancelledError:
                assert self._lowered is not None
                self._program = _compiled(self.name, self._lowered, *self._how)
            except KeyboardInterrupt:
                # Or else the process would not end before all others are compiled.
                _pool().shutdown(wait=False, cancel_futures=True)
                _pool.cache_clear()
                raise
            finally:
                global _waited
                with _lock:
                    _waited += time.perf_counter() - began
            self._lowered = None
        return self._program

    def __call__(self, *arguments: Any) -> Any:
        """Call the program."""
        return (self._program or self.result())(*arguments)


def seconds_waited() -> float:
    """Return how many seconds all threads of this process have waited for programs."""
    return _waited


def compile_soon(
    name: str, lowered: jax.stages.Lowered, effort: XlaOptimization = "most", splits: bool = True,
    wide: bool = False,
) -> Compilation:  # fmt: skip
    """Compile a program in the background.

    **Arguments:**
    - `name`: the name of the program in messages, such as "the search".
    - `lowered`: the program, lowered by JAX.
    - `effort`: XLA's optimisation effort; accelerators always use the maximum.
    - `splits`: whether its loops may be split over cores; False if it already uses all of them.
    - `wide`: whether it may use the processor's widest vectors; only for a program without XLA's
      own math functions, one of which is wrong with these.
    """
    enable_compile_cache()
    return Compilation(name, lowered, effort, splits, wide)


def while_compiling(work: Callable[[], object], after: float = LONG) -> None:
    """Run some work once, when this process next waits for a program; never if it does not wait.

    **Arguments:**
    - `work`: work that will be needed anyway, such as an import; no result may depend on it.
    - `after`: minimum seconds of waiting before it; 0 for work that a first result needs.
    """
    _meanwhile[work] = after


@contextmanager
def tracing(name: str = "") -> Iterator[None]:
    """Return a context, or a decorator, for tracing, in which garbage collection is suspended.

    **Arguments:**
    - `name`: the name of the program for `describe_compilation` during tracing; none by default.
    """
    with _said(name) if name else nullcontext(), uncollected():
        yield


@contextmanager
def _said(name: str) -> Iterator[None]:
    """Return a context in which this thread is said to compile the program."""
    index = threading.get_ident()
    with _lock:
        before = _running.get(index)
        _running[index] = (name, time.perf_counter())
    try:
        yield
    finally:
        with _lock:
            if before is None:
                del _running[index]
            else:
                _running[index] = before


def describe_compilation() -> str:
    """Describe the present compilation and its duration; empty if nothing is compiling."""
    with _lock:
        running = list(_running.values())
    if not running:
        return ""
    names = dict.fromkeys(name for name, _ in running)
    seconds = time.perf_counter() - min(began for _, began in running)
    return f"compiling {' and '.join(names)}, {seconds:z.0f} s"


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(available_cores(), "compile")


def _compiled(
    name: str, lowered: jax.stages.Lowered, effort: XlaOptimization, splits: bool, wide: bool
) -> jax.stages.Compiled:
    with _said(name):
        options: dict[str, Any] = (
            _OPTIONS[effort] | ({} if splits else _WHOLE_LOOPS) | (_WIDE if wide else {})
        )
        # The user of this switch wants the least of all programs.
        reduced = jax.config.read("jax_disable_most_optimizations")
        if not options or reduced or jax.default_backend() != "cpu":
            return lowered.compile()
        try:
            return lowered.compile(options)
        except jax.errors.JaxRuntimeError:
            # An XLA that does not know one of the options; asking before takes longer.
            known = known_options(options)
            if known == options:
                raise
            return lowered.compile(known)


def known_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the compile options that the XLA of this process supports.

    XLA's options change between versions. XLA refuses a program with an unknown option, and an
    unknown one in `XLA_FLAGS` ends the process.

    **Arguments:**
    - `options`: values by their names.
    """
    nothing = jax.jit(lambda: np.float32(0)).lower()

    def is_known(name: str) -> bool:
        try:
            nothing.compile(compiler_options={name: options[name]})
        except jax.errors.JaxRuntimeError:
            return False
        return True

    return {name: options[name] for name in options if is_known(name)}
