"""The native program of an engine: compiled once, and used if it agrees with XLA's.

program = NativeProgram(engine_for(problem, 32768))
program.begin()                                     # compiles in the background
program(rows, key, first, temperature)              # Verdicts, as of an `Engine`
program.compare(ours, theirs, slack)                # sets `approved`, or `refused`
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
from verifai_jax.evaluation.engine import Engine
from verifai_jax.evaluation.verdicts import Verdicts, violations

Rows: TypeAlias = Float[np.ndarray, "n row"]
RunKey: TypeAlias = Key[Array, ""]
Temperature: TypeAlias = Float[np.ndarray, " n"] | float
"""Temperatures of the smooth robustness, or one for all."""
AGREES = 1e-3
"""Relative difference of two robustness values from which on they differ by more than rounding."""


class NativeProgram:
    """The native program of an engine, compiled once for the problem."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self.approved = False
        self.refused = ""
        self._future: Future[tuple[str, Library]] | None = None

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
        return self._future.result()[1]

    def _load(self) -> tuple[str, Library]:
        try:
            program, computes = self.traced
            name = library_name(computes)
            agrees = is_approved(name)
            if agrees is False:
                raise Unavailable("its results differ from those of XLA by more than rounding")
            (form,) = program.out_avals
            with in_precision(self.engine.precision):
                source = lambda: translate(program)  # noqa: E731
                library = load(name, form.shape[0], source, quickly=self.engine.gradient)
            self.approved = bool(agrees)
            return name, library
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

    def compare(self, ours: Verdicts, theirs: Verdicts, slack: np.ndarray) -> None:
        """Compare rows with those of XLA, and store whether they agree."""
        assert self._future is not None
        name, _ = self._future.result()
        mine = ours.rho
        proper = np.repeat((theirs.status == Status.OK)[:, None], mine.shape[1], axis=1)
        clear = proper & (np.abs(theirs.rho) > slack)
        far = np.abs(mine - theirs.rho) > AGREES * (1 + np.abs(theirs.rho))
        pairs = ((ours.gradient, theirs.gradient), (ours.clause_gradients, theirs.clause_gradients))
        agrees = bool(
            np.array_equal(ours.status, theirs.status)
            and all(_alike(a, b) for a, b in pairs if a is not None and b is not None)
            and np.array_equal((mine < 0) & clear, (theirs.rho < 0) & clear)
            # A simulation may be chaotic, and a few of them go their own ways.
            and np.sum(far & proper & (theirs.rho >= 0)) <= 0.02 * max(np.sum(proper), 1)
        )
        approve(name, agrees)
        self.approved = agrees
        if not agrees:
            self.refused = "its results differ from those of XLA by more than rounding"


def _alike(ours: np.ndarray, theirs: np.ndarray) -> bool:
    """Return whether derivatives agree, except in a few chaotic simulations."""
    ours, theirs = ours.reshape(len(ours), -1), theirs.reshape(len(theirs), -1)
    size = np.max(np.abs(theirs), axis=1, keepdims=True) + 1e-6
    same = np.isclose(ours, theirs, rtol=0, atol=10 * AGREES * size, equal_nan=True)
    return bool(np.mean(np.all(same, axis=1)) >= 0.98)


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, "native compiler")
