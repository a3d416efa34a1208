"""A trace that distinguishes two formulas: one holds on it, and the other does not.

found = distinguish("always[0, 5] a > 1", "always[0, 6] a > 1")       # over free signals
found = distinguish(one, other, problem, budget=2000)                 # by search
print(found)
found.plot("apart.png")
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from verifai_jax.addons.monitoring.free_traces import GENERATIONS, LANES, FreeTraces
from verifai_jax.addons.monitoring.recorded import Recordings, Simulated, named_traces
from verifai_jax.core.display.figure import Drawn
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.display.notebook import InNotebook, picture_html
from verifai_jax.core.messages.text import counted
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl.evaluate import End
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.host_values import HostValues, Values
from verifai_jax.mtl.setting import as_formula

APART = 1e12
"""Score of a trace that tells formulas apart, in addition to how clearly it does."""


@dataclass(frozen=True)
class Distinction(Drawn, InNotebook):
    """A trace on which one of two formulas holds and the other does not, if one was found.

    - `trace`: None if none was found.
    - `source`: the origin of the trace.
    - `holds`, `robustness`: verdict and robustness of the first and the second formula on it.
    - `tried`: number of traces that were tried.
    """

    one: Formula
    other: Formula
    trace: Trace | None = field(repr=False)
    source: str
    holds: tuple[bool, bool] | None
    robustness: tuple[float, float] | None
    tried: int
    _picture = "verifai_jax.addons.monitoring.pictures", "plot_distinction"

    def __bool__(self) -> bool:
        return self.trace is not None

    def summary(self) -> str:
        """Write which formula holds on the trace and which does not."""
        if self.holds is None or self.robustness is None:
            return (
                f"no trace was found that tells  {self.one}  and  {self.other}  apart, among "
                f"{counted(self.tried, 'trace')} ({self.source}): that is no proof that they are "
                "the same"
            )
        lines = [f"{self.source} tells the formulas apart ({counted(self.tried, 'trace')} tried):"]
        parts = zip((self.one, self.other), self.holds, self.robustness, strict=True)
        lines += [f"  {'holds' if h else 'fails'} ({r:+z.4g})  {f}" for f, h, r in parts]
        return "\n".join(lines)

    __str__ = summary

    def _notebook_parts(self) -> Iterable[str]:
        if self.trace is not None:
            yield picture_html(self.plot())


def distinguish(
    one: Formula | str,
    other: Formula | str,
    signals: Recordings | None = None,
    *,
    end: End = "hold",
    dt: float | None = None,
    duration: float | None = None,
    budget: int = 2000,
    seed: int = 0,
) -> Distinction:
    """Find a trace that distinguishes two formulas: one holds on it, the other does not.

    **Arguments:**
    - `one`, `other`: formulas, or their texts.
    - `signals`: a problem, in which a search looks for such a trace; or recordings, of which the
      first that distinguishes them is taken; when left out, signals may take any values.
    - `end`: how a trace continues after the last sample, `"hold"` or `"truncate"`; a problem has
      its own.
    - `dt`, `duration`: those of a free trace, in seconds; by default they follow from the windows.
    - `budget`, `seed`: number of simulations of the search, and the seed of all random draws.
    **Returns:** the trace, if one was found; otherwise nothing is proved.
    **Raises:** `FormulaSyntaxError`; `ValueError` for recordings without the signals, and for
    windows that need too many samples; the errors of `falsify`.
    """
    one, other = as_formula(one), as_formula(other)
    if isinstance(signals, Simulated):
        search = lazy_import("verifai_jax.addons.monitoring.mined_bounds", "distinguish_by_search")
        return search(one, other, signals, budget, seed)
    if signals is None:
        found = free_difference(one, other, (), end, dt, duration, seed)
        traces = () if found is None else (found,)
        return distinction(one, other, traces, "a free trace", end, GENERATIONS * LANES)
    traces = named_traces(signals)
    for name, trace in traces.items():
        if found := distinction(one, other, (trace,), name, end, len(traces)):
            return found
    return distinction(one, other, (), "of the recordings", end, len(traces))


def distinction(
    one: Formula, other: Formula, traces: Sequence[Trace], source: str, end: End, tried: int
) -> Distinction:
    """Return the first of some traces that distinguishes two formulas, or a result without one."""
    for trace in traces:
        values = HostValues.of(trace, end)
        holds = values.holds(one), values.holds(other)
        if holds[0] != holds[1]:
            robustness = float(values(one)[0]), float(values(other)[0])
            return Distinction(one, other, trace, source, holds, robustness, tried)
    return Distinction(one, other, None, source, None, None, tried)


def free_difference(
    one: Formula, other: Formula, like: Sequence[Trace] = (), end: End = "hold",
    dt: float | None = None, duration: float | None = None, seed: int = 0,
) -> Trace | None:  # fmt: skip
    """Return a trace of free signals that distinguishes two formulas; None if none was found.

    **Arguments:**
    - `like`: recordings whose values the signals may have too.
    """
    free = FreeTraces.of([one, other], like, dt, duration, end)

    def apart(values: HostValues) -> Values:
        a, b = values(one)[0], values(other)[0]
        differ = (values.truth(one)[0] > 0) != (values.truth(other)[0] > 0)
        clear = np.clip(np.maximum(np.minimum(a, -b), np.minimum(-a, b)), -1e9, 1e9)
        # Of those that tell them apart the one that changes least often is easiest to read.
        return clear + differ * (APART - 1e10 * _changes(values.signals.values()))

    signals, score = free.search(apart, np.random.default_rng(seed), APART / 2)
    return free.trace(signals) if score > APART / 2 else None


def _changes(signals: Iterable[Values]) -> Values:
    """Return how often the signals of each lane change."""
    steps = (np.diff(s.reshape(*s.shape[:2], -1), axis=0) for s in signals)
    return sum((np.count_nonzero(step, axis=(0, 2)) for step in steps), np.zeros(1))
