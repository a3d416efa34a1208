"""Simulations by native code if its compilation pays, and by XLA otherwise.

    engine = NativeEngine(engine_for(problem, 32768), wanted="auto", budget=100_000)
    engine.evaluate(u, key, first=0)                    # Verdicts, as of an `Engine`

Rows from `FIRST` on are native if the budget is large enough for this problem. XLA simulates the
earlier rows while the native program is compiled, and all rows whose robustness is so near to zero
that rounding may decide the verdict. A native program is used only if it agrees with XLA on its
first rows.
"""

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Array, Float, Key

from verifai_jax.addons.native.native_code.machine_code import Unavailable, compiler
from verifai_jax.core.compute.compilation import Slot
from verifai_jax.evaluation.engine import FIRST, Engine, Wanted
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.sampled import sampled_in
from verifai_jax.mtl.tree import Term, postorder

if TYPE_CHECKING:
    from verifai_jax.addons.native.native_program import NativeProgram, Rows, RunKey, Temperature
WORTH = 3e9
"""Operations of a run from which on a native program is worth it by default. XLA's programs do 1.3
to 4.5e10 a second on two cores (seven problems), and translator and compiler take 1.3 s, once for
all runs of a machine: a dozen such runs, of a tenth of a second each, pay for it."""
SLACK = 4e-7
"""Robustness below which rounding may decide a verdict, relative to the greatest number of the
formula, its reach in seconds included: three units in the last place of single precision."""


class NativeEngine:
    """Evaluates batches of a problem like the given engine, with native code for later rows.

    **Arguments:**
    - `engine`: the XLA engine, in single precision, for points of the unit cube.
    - `wanted`: `"native"`, or `"auto"` for the rule in the module's docstring.
    - `budget`: number of simulations of the run.
    """

    def __init__(self, engine: Engine, wanted: Wanted, budget: int) -> None:
        self.engine, self._budget = engine, budget
        self._wanted: Wanted = wanted
        self._why = ""
        self._waited = 0.0
        self._met: list[tuple[Any, Verdicts]] = []

    @property
    def notes(self) -> tuple[str, ...]:
        """Decisions of the engine that may surprise a user."""
        why = (f"simulated by XLA, not natively: {self._why}",) if self._why else ()
        return (*self._begun.notes, *why)

    @property
    def precision(self) -> str:
        """Precision of the simulations."""
        return self.engine.precision

    @property
    def padded(self) -> int:
        """Number of rows of the XLA program."""
        return self._begun.padded

    @property
    def compile_seconds(self) -> float:
        """Seconds spent compiling."""
        few = self._begun
        whole = 0.0 if few is self.engine else self.engine.compile_seconds
        return few.compile_seconds + whole + self._waited

    @property
    def _begun(self) -> Engine:
        """The engine of XLA that is being compiled, or would be: nothing is traced to know."""
        return self.__dict__.get("_xla", self.engine)

    @property
    def chosen(self) -> Wanted:
        """The engine that simulates the rows from `FIRST` on, if that is decided."""
        if "_is_worth" not in self.__dict__:
            return self._wanted
        return "native" if self._is_worth and not self._why else "xla"

    def begin_compiling(self) -> None:
        """Trace now, and compile in the background."""
        self._xla.begin_compiling()
        if self._is_worth and self.engine.batch > FIRST:
            # The first round needs it; it is made of what was traced just now.
            with self._noting():
                self._program.begin()

    def compile(self) -> None:
        """Compile the programs of the first rows now."""
        self._xla.compile()

    def evaluate(
        self, rows: Float[np.ndarray, "n d"], key: Key[Array, ""], first: int = 0,
        temperature: Float[np.ndarray, " n"] | float = 1.0,
    ) -> Verdicts:  # fmt: skip
        """Simulate rows; see `Engine.evaluate`."""
        if not self._is_worth:
            return self.engine.evaluate(rows, key, first, temperature)
        before = min(max(FIRST - first, 0), len(rows))
        parts = []
        if before:
            some = rows[:before], key, first, _cut(temperature, slice(before))
            parts.append(self._by_xla(*some))
            self._met.append((some, parts[0]))
        with self._noting():
            self._program.begin()
        if before < len(rows):
            rest = _cut(temperature, slice(before, None))
            parts.append(self._by_native(rows[before:], key, first + before, rest))
        return Verdicts.concatenate(parts)

    @cached_property
    def _is_worth(self) -> bool:
        """True where the work of the run is worth a native program, and there may be one."""
        asked = self._wanted == "native"
        if jax.default_backend() != "cpu":
            self._why = f"runs on the {jax.default_backend()}" if asked else ""
            return False
        if not asked and self._budget * self.engine.program.work < WORTH:
            return False
        with self._noting():
            compiler()
        return not self._why

    @contextmanager
    def _noting(self) -> Iterator[None]:
        """Return a context in which any error becomes the reason for which XLA simulates."""
        try:
            yield
        except Unavailable as error:
            self._why = str(error)
        except Exception as error:
            # Native code is not needed for anything, so nothing that it raises ends a run.
            self._why = f"it failed ({type(error).__name__}: {error})"

    @cached_property
    def _xla(self) -> Engine:
        """The engine of XLA: of the whole batch where it does all, or of few rows."""
        if not self._is_worth or self.engine.batch <= FIRST:
            return self.engine
        return self.engine.problem.programs.get(SMALL, self.engine, self._small)

    def _small(self) -> Engine:
        return self.engine.with_batch(FIRST)

    @cached_property
    def _program(self) -> "NativeProgram":
        from verifai_jax.addons.native.native_program import NativeProgram

        return self.engine.problem.programs.get(
            PROGRAMS, self.engine, lambda: NativeProgram(self.engine)
        )

    def _by_xla(
        self, rows: "Rows", key: "RunKey", first: int, temperature: "Temperature"
    ) -> Verdicts:
        size, parts = self._xla.batch, []
        for begin in range(0, len(rows), size):
            some = slice(begin, begin + size)
            warm = _cut(temperature, some)
            parts.append(self._xla.evaluate(rows[some], key, first + begin, warm))
        return Verdicts.concatenate(parts)

    def _by_native(
        self, rows: "Rows", key: "RunKey", first: int, temperature: "Temperature"
    ) -> Verdicts:
        started = time.perf_counter()
        with self._noting():
            self._program.ready()
        self._waited += time.perf_counter() - started
        result = None
        if not self._why:
            with self._noting():
                if not self._program.approved:
                    self._check(rows, key, first, temperature)
                result = self._program(rows, key, first, temperature)
        self._met = []
        if result is None:
            return self.engine.evaluate(rows, key, first, temperature)
        near = np.any(np.abs(result.rho) <= self._slack, axis=1)
        if not np.any(near):
            return result
        # Rows of a system that draws keep their numbers, and so their random keys.
        size = FIRST if self._program.draws else len(rows)
        for begin in range(0, len(rows), size):
            at = begin + np.flatnonzero(near[begin : begin + size])
            if not len(at):
                continue
            some = slice(begin, begin + size) if self._program.draws else at
            theirs = self._by_xla(rows[some], key, first + begin, _cut(temperature, some))
            here = at - begin if self._program.draws else slice(None)
            for mine, other in zip(jax.tree.leaves(result), jax.tree.leaves(theirs), strict=True):
                mine[at] = other[here]
        return result

    def _check(self, rows: "Rows", key: "RunKey", first: int, temperature: "Temperature") -> None:
        """Compare the native program with XLA's, in the first rows and where verdicts are near."""
        distance = np.abs(self._program(rows, key, first, temperature).rho)
        nearest = np.min(np.where(np.isnan(distance), np.inf, distance), axis=1)
        at = np.sort(np.argsort(nearest)[:FIRST])
        some, begin = at, first
        if self._program.draws:
            # Their random keys are those of their numbers, so they are rows that follow each other.
            begin = int(np.argmin(nearest)) // FIRST * FIRST
            some, begin = slice(begin, begin + FIRST), first + begin
        near = rows[some], key, begin, _cut(temperature, some)
        met = [*self._met, (near, self._by_xla(*near))]
        other = self._program.otherwise_rounded
        ours = Verdicts.concatenate([self._program(*each) for each, _ in met])
        theirs = Verdicts.concatenate([verdicts for _, verdicts in met])
        exact = Verdicts.concatenate([other(*each) for each, _ in met])
        self._program.compare(ours, theirs, exact, self._slack)

    @cached_property
    def _slack(self) -> Float[np.ndarray, " formulas"]:
        """Robustness of each formula below which rounding may decide the verdict."""
        return np.array([SLACK * _greatest(f) for f in self.engine.problem.formulas.values()])


def _greatest(formula: Formula) -> float:
    """Return the greatest of 1, the numbers that a formula compares with, and its finite reach.

    Rounding is relative to what is compared, and adds up over time. It is infinite where samples
    are counted: whether one counts may be decided by rounding.
    """
    if sampled_in(formula):
        return math.inf
    numbers = [node.number or 0.0 for node in postorder(formula) if isinstance(node, Term)]
    reach = filter(math.isfinite, (formula.horizon(), formula.history()))
    return max([1.0, *map(abs, numbers), *reach])


def _cut(temperature: "Temperature", which: slice | np.ndarray) -> "Temperature":
    """Return the temperatures of some rows, or the one of all."""
    return temperature[which] if isinstance(temperature, np.ndarray) else temperature


PROGRAMS: Slot[Engine, "NativeProgram"] = Slot("native programs")
"""Native programs by the engine of XLA that they stand for."""
SMALL: Slot[Engine, Engine] = Slot("engines of few rows")
"""Engines that decide what is near to zero, by the engine of whole batches."""
