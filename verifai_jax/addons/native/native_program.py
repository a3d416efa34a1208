"""The native program of an engine: compiled once, and used if it agrees with XLA's.

program = NativeProgram(engine_for(problem, 32768))
program.begin()                                     # compiles in the background
program(rows, key, first, temperature)              # Verdicts, as of an `Engine`
program.compare(ours, theirs, exact, slack)         # sets `approved`, or raises `Unavailable`
"""

from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache, cached_property
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from verifai_jax.addons.native.native_code.library import (
    Library,
    approve,
    is_approved,
    library_name,
    load,
)
from verifai_jax.addons.native.native_code.machine_code import Unavailable
from verifai_jax.addons.native.native_code.source import translate
from verifai_jax.addons.native.native_code.values import Untranslatable
from verifai_jax.core.compute.keys import IMPLEMENTATION, simulation_key
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.core.values.trace import Status
from verifai_jax.evaluation.engine import FIRST, Engine, engine_for
from verifai_jax.evaluation.verdicts import Verdicts, violations

Rows: TypeAlias = Float[np.ndarray, "n row"]
RunKey: TypeAlias = Key[Array, ""]
Temperature: TypeAlias = Float[np.ndarray, " n"] | float
"""Temperatures of the smooth robustness, or one for all."""
ALIKE = 1e-2
"""Relative difference of two derivatives from which on they differ by more than rounding."""
ROUNDINGS = 4
"""How far native code may be from XLA, in differences of XLA's own results in two roundings."""
FLOOR = 2e-6
"""What native code may differ by where XLA rounds nothing, relative to 1 or the robustness: the 16
units in the last place that an elementary function may be off."""
SHARES = (0.5, 0.75, 0.9, 0.97)
"""Shares of simulations that are compared; a few chaotic ones go their own ways."""
DIFFERS = "its results differ from those of XLA by more than rounding"


class NativeProgram:
    """The native program of an engine, compiled once for the problem."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self.approved = False
        self.refused = ""
        self._future: Future[Library] | None = None

    @cached_property
    def draws(self) -> bool:
        """True if the system uses its random key, or may use it."""
        return self.engine.gradient or self.engine.program.draws()

    @cached_property
    def traced(self) -> tuple[Any, str | None]:
        """The program of a row with its random key given by number, and the program's identity."""
        function = self.engine.program.traced_row()
        *_, numbers = self.engine.program.forms

        def of_row(
            row: Array, words: Array, number: Array, temperature: Array, numbers: Array
        ) -> Array:
            key = simulation_key(jax.random.wrap_key_data(words, impl=IMPLEMENTATION), number)
            packed = function(row, key, temperature, (), numbers)
            if set(packed) != {"uint32"}:
                raise Unavailable("it returns numbers of eight bytes")
            return packed["uint32"]

        with in_precision(self.engine.precision):
            forms = (
                self.engine.inputs.row_form,
                jax.ShapeDtypeStruct((2,), jnp.uint32),
                jax.ShapeDtypeStruct((), jnp.int32),
                jax.ShapeDtypeStruct((), jnp.float32),
                numbers,
            )
            program = self.engine.program.differentiable(lambda: jax.make_jaxpr(of_row)(*forms))
            return program, self.engine.program.identity

    def begin(self) -> None:
        """Start compiling, unless that has started."""
        if self._future is None:
            self._future = _pool().submit(self._load)

    def ready(self) -> Library:
        """Wait until the library is compiled, and return it.

        **Raises:** `Unavailable` if it cannot be made.
        """
        if self.refused:
            raise Unavailable(self.refused)
        self.begin()
        assert self._future is not None
        return self._future.result()

    def _load(self) -> Library:
        try:
            program, computes = self.traced
            name = library_name(computes)
            (form,) = program.out_avals
            with in_precision(self.engine.precision):
                source = lambda: translate(program)  # noqa: E731
                library = load(name, form.shape[0], source, quickly=self.engine.gradient)
            agrees = is_approved(library.path)
            if agrees is False:
                raise Unavailable(DIFFERS)
            self.approved = bool(agrees)
            return library
        except Untranslatable as error:
            raise Unavailable(f"it has {error}, which is not translated") from error

    def __call__(self, rows: Rows, key: RunKey, first: int, temperature: Temperature) -> Verdicts:
        """Simulate rows."""
        library = self.ready()
        temperatures = np.broadcast_to(np.asarray(temperature, np.float32), (len(rows),))
        words = np.asarray(jax.random.key_data(key))
        threads = len(self.engine.layout.devices)
        packed = library(rows, words, first, temperatures, self.engine.program.numbers(), threads)
        unpacked: Any = self.engine.program.unpack("evaluate", {"uint32": packed}, len(rows))
        rho, status, features, more = unpacked
        # What is exactly zero is decided by XLA.
        broken = violations(rho, status, lambda: np.ones(rho.shape, bool))
        return Verdicts(rho, status, broken, features, **more)

    def otherwise_rounded(
        self, rows: Rows, key: RunKey, first: int, temperature: Temperature
    ) -> Verdicts:
        """Simulate rows by XLA with other roundings: in double precision, or nudged.

        A system that draws would draw other numbers in double precision; the nudge moves its rows
        by a unit in the last place.
        """
        if self.draws:
            rows = np.nextafter(rows, np.float32(0.5), dtype=np.float32)
            engine: Engine = self.engine
        else:
            engine = engine_for(
                self.engine.problem, FIRST, precision="float64",
                given=getattr(self.engine.inputs, "given", False),
            )  # fmt: skip
        size, dtype = min(engine.batch, FIRST), engine.inputs.row_form.dtype
        parts = [slice(begin, begin + size) for begin in range(0, len(rows), size)]
        return Verdicts.concatenate([
            engine.evaluate(rows[each].astype(dtype), key, first + each.start) for each in parts
        ])  # fmt: skip

    def compare(self, ours: Verdicts, theirs: Verdicts, exact: Verdicts, slack: np.ndarray) -> None:
        """Compare rows with those of XLA, and store whether they differ by rounding only.

        **Arguments:**
        - `exact`: the same rows by XLA with other roundings, whose differences are the measure.
        - `slack`: robustness of each formula below which rounding may decide.
        **Raises:** `Unavailable` if they differ by more.
        """
        pairs = ((ours.gradient, theirs.gradient), (ours.clause_gradients, theirs.clause_gradients))
        agrees = bool(
            np.array_equal(ours.status, theirs.status)
            and all(_alike(a, b) for a, b in pairs if a is not None and b is not None)
            and _differ_by_rounding(ours, theirs, exact, slack)
        )
        approve(self.ready().path, agrees)
        self.approved = agrees
        if not agrees:
            self.refused = DIFFERS
            raise Unavailable(DIFFERS)


def _differ_by_rounding(
    ours: Verdicts, theirs: Verdicts, exact: Verdicts, slack: np.ndarray
) -> bool:
    """Return whether robustness differs from XLA's as XLA's own differs between roundings."""
    proper = (theirs.status == Status.OK) & (exact.status == Status.OK)
    if not np.any(proper):
        return True
    mine, rho = ours.rho[proper].astype(float), theirs.rho[proper].astype(float)
    off, rounding = _distance(mine, rho), _distance(exact.rho[proper], rho)
    size = np.max(np.abs(rho), axis=0, where=np.isfinite(rho), initial=1.0)
    floor = np.maximum(FLOOR * size, np.where(np.isfinite(slack), slack, 0.0))
    allowed = ROUNDINGS * _quantiles(rounding) + floor
    within = _quantiles(off) <= allowed
    # Signs may differ where a verdict is nearer to zero than any rounding, of this row or of most.
    near = np.maximum(np.maximum(ROUNDINGS * rounding, allowed[-1]), slack)
    return bool(np.all(within) and np.all(((mine < 0) == (rho < 0)) | (np.abs(rho) <= near)))


def _quantiles(distances: np.ndarray) -> np.ndarray:
    return np.quantile(distances, SHARES, axis=0, method="higher")


def _distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return how far numbers are apart: 0 for equal infinities and NaNs, infinity for others."""
    with np.errstate(invalid="ignore"):
        apart = np.abs(a - b)
    same = (a == b) | (np.isnan(a) & np.isnan(b))
    return np.where(same, 0.0, np.where(np.isfinite(apart), apart, np.inf))


def _alike(ours: np.ndarray, theirs: np.ndarray) -> bool:
    """Return whether derivatives agree, except in a few chaotic simulations."""
    ours, theirs = ours.reshape(len(ours), -1), theirs.reshape(len(theirs), -1)
    size = np.max(np.abs(theirs), axis=1, keepdims=True) + 1e-6
    same = np.isclose(ours, theirs, rtol=0, atol=ALIKE * size, equal_nan=True)
    return bool(np.mean(np.all(same, axis=1)) >= 0.98)


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, "native compiler")
