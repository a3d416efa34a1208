"""The guide's term, the outcome and the trace of a simulation, for a search.

    guidance = Guidance(guide=True, outcome=True)
    guidance.values(problem, trace, features)           # [size], traced by JAX

These results never decide a verdict. They are computed only for searches that want them.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from verifai_jax.core.values.clauses import OUTCOME, SEGMENTS, SIGNALS
from verifai_jax.core.values.trace import Trace, as_array
from verifai_jax.mtl.deciding import deciding_instant
from verifai_jax.problem.problem import Problem


class Guidance(NamedTuple):
    """The additional results that a search wants.

    - `guide`: whether the value of the guide's term is wanted.
    - `outcome`: whether a description of what happened is wanted, as in `core.values.clauses`.
    - `trace`: whether the monitored signals are wanted, for a system that JAX traces.
    - `signals`: further signals of the trace.
    """

    guide: bool = False
    outcome: bool = False
    trace: bool = False
    signals: tuple[str, ...] = ()

    @property
    def size(self) -> int:
        """Number of results of a simulation, without its trace; 0 if none are wanted."""
        return int(self.guide) + OUTCOME * int(self.outcome)

    def all(
        self, problem: Problem, trace: Trace, features: Mapping[str, PyTree]
    ) -> dict[str, PyTree]:
        """Return all wanted results of one simulation, named as in `Verdicts`; traced by JAX."""
        wanted: dict[str, PyTree] = {}
        if self.size:
            wanted["guidance"] = self.values(problem, trace, features)
        if self.trace:
            trace = trace.hold()
            names = dict.fromkeys((*problem.monitored, *self.signals))
            signals = {name: as_array(trace.signals[name]) for name in names}
            wanted["traces"] = Trace(signals, trace.dt)
        return wanted

    def values(
        self, problem: Problem, trace: Trace, features: Mapping[str, PyTree]
    ) -> Float[Array, " size"]:
        """Return the numbers of one simulation, the guide's value first; traced by JAX."""
        trace = trace.hold()
        parts = []
        if self.guide and problem.guide is not None:
            parts.append(problem.guide.value(trace, features, problem.end)[None])
        if self.outcome:
            parts.append(outcome_of(problem, trace))
        return jnp.concatenate([part.astype(jnp.float32) for part in parts])


NOTHING = Guidance()
"""Nothing but the robustness."""


def outcome_of(problem: Problem, trace: Trace) -> Float[Array, " outcome"]:
    """Return the outcome of one simulation, not differentiated; see `core.values.clauses`."""
    signals = {name: jax.lax.stop_gradient(as_array(trace.signals[name])) for name in trace.signals}
    formulas = tuple(problem.formulas.values())
    predicate, sample = deciding_instant(formulas, trace, problem.end)
    instant = sample / max(trace.length - 1, 1)
    columns = []
    # What formulas speak of comes first; the others tell of what leads there.
    for name in dict.fromkeys((*problem.monitored, *sorted(signals))):
        wide = signals[name].reshape(trace.length, -1)
        columns += list(jnp.nan_to_num(wide[:, : SIGNALS - len(columns)]).T)
    edges = [round(i * trace.length / SEGMENTS) for i in range(SEGMENTS + 1)]
    shape = [
        # Of fewer samples than parts the same one stands for several.
        jnp.mean(column[begin : max(stop, begin + 1)].astype(jnp.float32))
        for column in columns[:SIGNALS]
        for begin, stop in zip(
            [min(edge, trace.length - 1) for edge in edges[:-1]], edges[1:], strict=True
        )
    ]
    own = jnp.stack([predicate, instant, *shape]).astype(jnp.float32)
    return jnp.pad(own, (0, OUTCOME - len(own)))
