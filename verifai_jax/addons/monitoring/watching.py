"""Monitors that follow samples on the host, in double precision, at about a microsecond a sample.

    monitor = watch("always (req > 0 -> eventually[0, 0.5] gnt > 0)", dt=0.1)
    monitor.step({"req": 1.0, "gnt": 0.0})            # the robustness so far
    monitor.interval()                                # whatever may still come
    monitor.finish()                                  # if this was the last sample

The machine's own C compiler compiles the step from the code of `export_c`. Without a compiler,
Python performs the step in some microseconds. `online` is the monitor for JAX.
"""

import ctypes
import hashlib
import operator
import platform
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Generic, TypeAlias, TypeVar, overload

import numpy as np
from jaxtyping import Float

from verifai_jax.addons.monitoring.c_monitor import HEAD, HELPERS, monitor_code
from verifai_jax.addons.monitoring.error_bars import Bounds, ErrorBars, bounded
from verifai_jax.addons.monitoring.margins import ALONE, Margins, margins
from verifai_jax.addons.monitoring.python_machine import PythonMachine
from verifai_jax.addons.monitoring.quantities import completed
from verifai_jax.addons.native.native_code.machine_code import Unavailable, compiler, load_library
from verifai_jax.core.messages.errors import missing_name
from verifai_jax.core.values.gaps import has_truths, with_gaps
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.semantics import Semantics, hard
from verifai_jax.mtl.streams import Plan, streams

R = TypeVar("R")
Numbers: TypeAlias = Sequence[float] | np.ndarray | ctypes.Array[ctypes.c_double]
"""One number a formula."""
FLAGS = ("-x", "c", "-std=c99", "-O2", "-ffp-contract=off")
"""Not contracted: a product and a sum in one operation are rounded once, and NumPy rounds twice."""
LIBRARY = r"""
long size(void) { return (long)sizeof(monitor); }
void start(monitor *m) { monitor_start(m); }
void step(monitor *m, const double *x) { monitor_step(m, x); }
void steps(monitor *m, long n, const double *x, double *out) {
  for (long i = 0; i < n; i++) {
    monitor_step(m, x + i * @columns);
    for (int k = 0; k < @outputs; k++) out[i * @outputs + k] = m->out[k];
  }
}
void ahead(const monitor *m, monitor *scratch, long n, int held, double leaf, double *out) {
  monitor_stream *s = &scratch->now;
  *s = (held || !m->gaps) ? m->now : (leaf < 0.0) ? m->low : m->high;
  if (!held) vj_fill(s->leaf, sizeof(s->leaf) / sizeof(double), leaf);
  for (long i = 0; i <= n; i++) {
    for (int k = 0; k < @outputs; k++) out[i * @outputs + k] = s->out[k];
    monitor_follow(s);
  }
}
"""


class CompiledMachine:
    """The machine of `python_machine` in machine code.

    **Raises:** `Unavailable` if it cannot be compiled.
    """

    def __init__(self, plan: Plan, front: Margins) -> None:
        library = LIBRARY.replace("@columns", str(max(1, len(front.columns))))
        library = library.replace("@outputs", str(len(plan.outputs)))
        source = "".join([HEAD, HELPERS, monitor_code(plan, front, "monitor"), library])
        tool = compiler()
        about = tool.stat()
        which = (str(tool), about.st_size, about.st_mtime_ns, platform.machine(), FLAGS, source)
        name = f"monitor-{hashlib.sha256(repr(which).encode()).hexdigest()[:32]}"
        symbols = ("size", "start", "step", "steps")
        _, self._library = load_library(name, lambda: (source, FLAGS), symbols)
        self._library.size.restype = ctypes.c_long
        size = self._library.size()
        self._state, self._scratch = (ctypes.create_string_buffer(size) for _ in range(2))
        self._library.start(self._state)
        self.sample = (ctypes.c_double * len(front.columns))()
        self.out = (ctypes.c_double * len(plan.outputs)).from_buffer(self._state)
        self._step = self._library.step
        self._pointers = ctypes.byref(self._state), ctypes.byref(self.sample)

    def step(self, sample: Sequence[float]) -> None:
        """Process one sample."""
        self.sample[:] = sample
        self._step(*self._pointers)

    def steps(self, rows: np.ndarray) -> np.ndarray:
        """Process samples `[time, columns]`, and return the results `[time, formulas]`."""
        rows = np.ascontiguousarray(rows, float)
        out = np.empty((len(rows), len(self.out)))
        x, to = (ctypes.c_void_p(array.ctypes.data) for array in (rows, out))
        self._library.steps(self._state, ctypes.c_long(len(rows)), x, to)
        return out

    def ahead(self, steps: int, leaf: float | None) -> np.ndarray:
        """Return the results of now and of further steps; see `PythonMachine.ahead`."""
        out = np.empty((1 + steps, len(self.out)))
        value = ctypes.c_double(0.0 if leaf is None else leaf)
        to = ctypes.c_void_p(out.ctypes.data)
        count, held = ctypes.c_long(steps), ctypes.c_int(leaf is None)
        self._library.ahead(self._state, self._scratch, count, held, value, to)
        return out


class Watch(Generic[R]):
    """A monitor of formulas that compute common parts once; made by `watch`.

    - `delays`: number of samples by which the value of each formula is late, with `every`.
    - `compiled`: whether the step was compiled by the machine's C compiler.
    """

    def __init__(self, plan: Plan, front: Margins, result: Callable[[Numbers], R]) -> None:
        self.delays = tuple(output.delay for output in plan.outputs)
        self._top = plan.top
        self._waits = [output.wait for output in plan.outputs]
        self._columns = front.columns
        self._read = _reader(front.columns)
        self._result = result
        try:
            self._machine: CompiledMachine | PythonMachine = CompiledMachine(plan, front)
        except Unavailable:
            self._machine = PythonMachine(plan, front)
        self.compiled = isinstance(self._machine, CompiledMachine)
        self._step, self._out = self._machine.step, self._machine.out

    def step(self, sample: Mapping[str, Any]) -> R:
        """Process one more sample: numbers (or vectors `[k]`) by signal name.

        **Returns:** the robustness at time 0 if all signals kept their present values. With
        `every`, the robustness at the newest decided instant, `delays` samples ago; NaN until there
        is one.
        **Raises:** `UnknownNameError` for a signal that the sample does not contain.
        """
        try:
            numbers = self._read(sample)
            # A false value may be -1, and Python takes it for 0.
            self._step(self._numbers(sample) if False in numbers else numbers)
        except KeyError:
            raise self._missing(sample) from None
        except (TypeError, ValueError):
            self._step(self._numbers(sample))
        return self._result(self._out)

    def steps(self, signals: Mapping[str, Any]) -> Float[np.ndarray, "time *formulas"]:
        """Process many samples, `[time]` (or `[time, k]`) by signal name.

        **Returns:** the results of `step` for each sample; several formulas have a column each.
        **Raises:** `UnknownNameError` for a missing signal; `ValueError` for different lengths.
        """
        arrays: dict[str, np.ndarray] = {}
        for column, _ in self._columns:
            name = column.removeprefix(ALONE)
            if name not in signals:
                raise self._missing(signals)
            array = np.asarray(with_gaps(name, signals[name])).astype(float)
            alone = column != name and has_truths(signals[name])
            arrays[column] = 2 * array - 1 if alone else array
        lengths = {name: len(array) for name, array in arrays.items()}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"signals have one length; got {lengths}")
        columns = [arrays[n] if i is None else arrays[n][:, i] for n, i in self._columns]
        length = len(next(iter(signals.values()))) if signals else 0
        rows = np.stack(columns, axis=1) if columns else np.zeros((length, 1))
        out = self._machine.steps(rows) if len(rows) else np.empty((0, len(self._out)))
        return self._columns_of(out)

    def interval(self) -> tuple[R, R]:
        """Return the minimum and maximum robustness that further samples, and gaps so far, allow.

        It is the robustness at time 0, or with `every` at the latest sample. What is certain
        despite gaps is known here: a maximum below zero is a violation whatever they hid.
        """
        low, high = (self._end_with(value) for value in (-self._top, self._top))
        return self._result(low), self._result(high)

    def finish(self) -> R:
        """Return the robustness if this was the last sample, which is held, as computed offline.

        It is the robustness at time 0, or with `every` at the last sample. NaN before the first
        sample.
        """
        return self._result(self._end_with(None))

    def rest(self) -> Float[np.ndarray, "time *formulas"]:
        """Return the remaining values if this was the last sample, with `every`.

        Together with the results of `steps` they are the robustness at every sample.
        """
        return self._columns_of(self._machine.ahead(max(self.delays), None)[1:])

    def _columns_of(self, out: np.ndarray) -> np.ndarray:
        return out[:, 0] if isinstance(self._result(self._out), float) else out

    def _end_with(self, leaf: float | None) -> list[float]:
        out = self._machine.ahead(max(self._waits), leaf)
        return [float(out[wait, k]) for k, wait in enumerate(self._waits)]

    def _numbers(self, sample: Mapping[str, Any]) -> list[float]:
        return [_number(name, sample, index) for name, index in self._columns]

    def _missing(self, sample: Mapping[str, Any]) -> Exception:
        names = (name.removeprefix(ALONE) for name, _ in self._columns)
        name = next(name for name in names if name not in sample)
        return missing_name("the sample", "signal", name, sample)


def _reader(
    columns: Sequence[tuple[str, int | None]],
) -> Callable[[Mapping[str, Any]], Sequence[float]]:
    """Return what takes the numbers of a sample, as fast as Python can."""
    sources = [(name.removeprefix(ALONE), index) for name, index in columns]
    names = [name for name, index in sources if index is None]
    if len(names) > 1 and len(names) == len(columns):
        return operator.itemgetter(*names)
    return lambda sample: [sample[n] if i is None else sample[n][i] for n, i in sources]


def _number(column: str, sample: Mapping[str, Any], index: int | None) -> float:
    name = column.removeprefix(ALONE)
    value = sample[name] if index is None else sample[name][index]
    value = with_gaps(name, [None if value is np.ma.masked else value])[0]
    # A truth value that is a formula by itself.
    alone = column != name and value.dtype == bool
    return 2 * float(value) - 1 if alone else float(value)


@overload
def watch(
    formulas: Formula | str, dt: float, *, semantics: Semantics = ..., every: bool = ...,
    sizes: Mapping[str, int] | None = ..., units: Mapping[str, str] | None = ...,
    error_bars: None = ...,
) -> Watch[float]: ...  # fmt: skip
@overload
def watch(
    formulas: Formula | str, dt: float, *, semantics: Semantics = ..., every: bool = ...,
    sizes: Mapping[str, int] | None = ..., units: Mapping[str, str] | None = ...,
    error_bars: ErrorBars,
) -> Watch[Bounds]: ...  # fmt: skip
@overload
def watch(
    formulas: Mapping[str, Formula | str], dt: float, *, semantics: Semantics = ...,
    every: bool = ..., sizes: Mapping[str, int] | None = ...,
    units: Mapping[str, str] | None = ..., error_bars: ErrorBars,
) -> Watch[dict[str, Bounds]]: ...  # fmt: skip
@overload
def watch(
    formulas: Mapping[str, Formula | str], dt: float, *, semantics: Semantics = ...,
    every: bool = ..., sizes: Mapping[str, int] | None = ...,
    units: Mapping[str, str] | None = ...,
) -> Watch[dict[str, float]]: ...  # fmt: skip
def watch(
    formulas: Formula | str | Mapping[str, Formula | str], dt: float, *,
    semantics: Semantics = hard, every: bool = False, sizes: Mapping[str, int] | None = None,
    units: Mapping[str, str] | None = None, error_bars: ErrorBars | None = None,
) -> Watch[Any]:  # fmt: skip
    """Monitor one formula, or several by name, on samples `dt` seconds apart.

    Values are those of `robustness` in double precision, bit for bit, except for the last digit of
    `sin`, `cos`, `exp` and powers.

    **Arguments:**
    - `semantics`: `hard`, or `boolean`: 1 if a formula holds and -1 if not.
    - `every`: whether each formula is evaluated at every instant, not only at time 0. No formula
      may then look ahead without bound.
    - `sizes`: number of components of each signal whose norm, or all of whose elements, the
      formulas use.
    - `units`: units of signals that are compared with quantities such as `130 km/h`.
    - `error_bars`: how uncertain signals are, as in `judge`. Each result is then a pair `low`,
      `high` with its `verdict`: for all values within the bars, for none, or it depends.
    **Returns:** a monitor; its results are numbers, or dictionaries for several formulas.
    **Raises:** `IntervalError` for an interval that is not a multiple of `dt`; `ValueError` for
    smooth semantics, for an unbounded future operator inside another temporal operator, and for a
    norm without a size, and for a signal without a unit that is compared with a quantity.
    """
    wanted = completed(formulas, units, sizes)
    if error_bars is not None:
        wanted = bounded(wanted, error_bars)
    plan = streams(wanted, dt, semantics, every)
    front = margins(plan, sizes or {}, apart=True)
    if not isinstance(formulas, Mapping):
        first = lambda out: out[0]  # noqa: E731
        return Watch(plan, front, first if error_bars is None else lambda out: Bounds(*out))
    names = tuple(formulas)
    if error_bars is not None:
        pairs = [(name, slice(2 * k, 2 * k + 2)) for k, name in enumerate(names)]
        return Watch(plan, front, lambda out: {name: Bounds(*out[k]) for name, k in pairs})
    return Watch(plan, front, lambda out: dict(zip(names, out, strict=True)))
