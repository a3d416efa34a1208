"""Evaluation of a black box: the same batches as the engine's, simulated one by one on the host.

A simulation that raises becomes a row with status ERROR and its message; the others go on.
"""

from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, Key

from verifai_jax.engine import Evaluation, judge, simulation_key, verdict
from verifai_jax.problem import Problem
from verifai_jax.trace import Status, Trace


class HostEngine:
    """Evaluates batches of a black-box problem; the counterpart of `engine.Engine`."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.compile_seconds = 0.0
        self._unflatten = jax.jit(jax.vmap(problem.space.unflatten))
        self._judge = jax.jit(lambda trace: judge(problem, trace))
        self._verdict = jax.jit(lambda trace: verdict(problem, trace))

    def compile(self) -> None:
        """Nothing to do: monitors compile when the first trace shows its length."""

    def evaluate(
        self,
        u: Float[Array, "n d"],
        key: Key[Array, ""],
        first: int,
        temperature: Float[Array, ""] | float = 1.0,
    ) -> Evaluation:
        """Simulate and judge `n` points of the unit cube, in order; see `engine.Engine`."""
        features = jax.tree.map(np.asarray, self._unflatten(u))
        n = len(u)
        rho = np.full((n, len(self.problem.formulas)), np.nan, np.float32)
        status = np.full(n, Status.ERROR, np.int32)
        holds = np.ones(rho.shape, bool)
        messages = [""] * n
        for i in range(n):
            try:
                trace = pad_trace(self._simulate(features, i, simulation_key(key, first + i)))
                values, code = jax.device_get(self._judge(trace))
                if np.any(values == 0):
                    # Now, while the trace is here: simulating again may be dear.
                    holds[i] = np.asarray(self._verdict(trace))
                rho[i], status[i] = values, code
            except Exception as error:
                messages[i] = f"{type(error).__name__}: {error}"
        return Evaluation(rho, status, features, messages=messages, holds=holds)

    def _simulate(self, features: Any, i: int, key: Key[Array, ""]) -> Trace:
        trace = self.problem.system(jax.tree.map(lambda leaf: leaf[i], features), key)
        if not isinstance(trace, Trace):
            raise TypeError(f"the system must return a Trace; it returned {type(trace).__name__}")
        return trace


def pad_trace(trace: Trace) -> Trace:
    """The same trace, held to a length that is a power of two.

    Holding the last sample changes no verdict, and traces of all lengths share a few compiled
    monitors.
    """
    trace = trace.hold()
    length = 1 << (trace.length - 1).bit_length()
    extra = length - trace.length
    signals = {
        name: np.concatenate([signal, np.repeat(np.asarray(signal)[-1:], extra, axis=0)])
        for name, signal in trace.signals.items()
    }
    times = trace.times
    if times is not None:
        step = times[-1] - times[-2] if len(times) > 1 else 1.0
        times = np.concatenate([times, times[-1] + step * np.arange(1, extra + 1)])
    return Trace(signals, trace.dt, times, trace.length, trace.status, held=True)
