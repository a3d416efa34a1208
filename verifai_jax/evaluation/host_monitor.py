"""Monitors of traces that came from the host, compiled once for all traces of a shape."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from verifai_jax.core.compute.compilation import Slot, pad_rows
from verifai_jax.core.values.trace import Trace, without_wrapping
from verifai_jax.evaluation.guidance import NOTHING, Guidance
from verifai_jax.evaluation.verdicts import boolean_semantics, trace_coverage_ids, trace_verdict
from verifai_jax.problem.problem import Problem


class HostMonitor:
    """The compiled monitor of a problem for batches of traces from the host."""

    def __init__(self, problem: Problem, guidance: Guidance = NOTHING) -> None:
        self.guidance = guidance

        def decided(trace: Trace, features: PyTree) -> tuple[Array, Array, Array, Array]:
            extra = jnp.zeros(0, jnp.float32)
            if guidance.size:
                extra = guidance.values(problem, trace, features)
            return *trace_verdict(problem, trace), trace_coverage_ids(problem, trace), extra

        self._decide = jax.jit(jax.vmap(decided))
        self._holds = jax.jit(jax.vmap(lambda trace: boolean_semantics(problem, trace)))

    def __call__(
        self, traces: Trace, count: int, features: PyTree = None
    ) -> tuple[
        Float[np.ndarray, "n k"],
        Int[np.ndarray, " n"],
        Bool[np.ndarray, "n k"],
        Int[np.ndarray, "n ids"],
        Float[np.ndarray, "n guidance"],
    ]:
        """Return robustness, status, Boolean semantics, coverage ids and what steers a search.

        In one shape for many `count`. `features` are needed only where something steers.
        """
        signals = {name: without_wrapping(signal) for name, signal in traces.signals.items()}
        padded = jax.tree.map(pad_rows, _with_signals(traces, signals))
        own = jax.tree.map(pad_rows, features) if self.guidance.size else {}
        decided = self._decide(padded, own)
        rho, status, coverage_ids, guidance = (np.asarray(leaf)[:count] for leaf in decided)
        holds = np.ones(rho.shape, bool)
        if np.any(rho == 0):
            # Now, while the traces are here: simulating again may be dear.
            holds = np.asarray(self._holds(padded))[:count]
        return rho, status, holds, coverage_ids, guidance


MONITORS: Slot[str, HostMonitor] = Slot("monitors of host systems")
"""The monitor of a problem whose simulations steer no search."""


def _with_signals(trace: Trace, signals: dict[str, Any]) -> Trace:
    """Return a batch of traces with other signals, which a `Trace` would check as one."""
    batch = jax.tree.map(lambda leaf: leaf, trace)
    object.__setattr__(batch, "signals", signals)
    return batch
