"""The region of uncertainty, in which the error of a perception can decide whether the loop fails.

    loop = AbstractLoop(problem, abstraction, error, seed=0)
    region = sample_region(loop, samples=4096)          # a row for each sample: kind, severity
    loop.uncertain(features), loop.decisive(features)   # traced by JAX

No image is rendered here: the perception is replaced by the truth with an error of a severity from
0 (none) to 1 (the worst that is allowed).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, Bool, Float, Int

from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.values.trace import Status, Trace
from verifai_jax.evaluation.verdicts import boolean_semantics, trace_verdict
from verifai_jax.mtl import Formula, boolean, robustness_signal
from verifai_jax.problem import Problem
from verifai_jax.systems.base import as_system

Features = Any
Abstraction = Callable[[Any], Any]
"""Severity -> system."""
BISECTIONS = 10
"""Halvings of the severity, which is found to a thousandth."""
AT_ONCE = 256
"""Abstract simulations that are worked on together."""
UNCERTAIN, SAFE, FAILS_ANYWAY, NO_VERDICT = "uncertain", "safe", "fails anyway", "no verdict"
"""Kinds of samples: the loop fails with the worst perception only, with neither, with the best."""


class Outcome(NamedTuple):
    """The verdict of one abstract simulation.

    - `rho`: the least robustness over the formulas; NaN without a verdict.
    - `fails`: whether the simulation ended properly and breaks a formula.
    - `proper`: whether it has a verdict.
    """

    rho: Float[Array, ""]
    fails: Bool[Array, ""]
    proper: Bool[Array, ""]


class Decisive(NamedTuple):
    """The instant at which the perception decides.

    - `severity`: the smallest error with which the loop fails.
    - `sample`: the signals at the last instant of that loop at which the perception errs.
    - `instant`: the index of that instant.
    - `erring`: number of instants at which the perception errs.
    """

    severity: Float[Array, ""]
    sample: dict[str, Array]
    instant: Int[Array, ""]
    erring: Int[Array, ""]


class AbstractLoop:
    """A loop whose perception is the truth with an error of a given severity.

    **Arguments:**
    - `problem`: the loop with the network, whose formulas decide.
    - `abstraction`: `severity -> system`, without images.
    - `error`: a condition that the perception errs, on the signals of one instant.
    - `seed`: the seed of the random key of all abstract simulations.
    """

    def __init__(
        self, problem: Problem, abstraction: Abstraction, error: Formula, seed: int
    ) -> None:
        self.problem, self.abstraction, self.error = problem, abstraction, error
        self.key = run_keys(seed)[1]

    def trace(self, features: Features, severity: Float[Array, ""] | float) -> Trace:
        """Return the trace of the loop with an error of this severity."""
        return as_system(self.abstraction(severity))(features, self.key)

    def outcome(self, features: Features, severity: Float[Array, ""] | float) -> Outcome:
        """Return the verdict of the loop with an error of this severity."""
        trace = self.trace(features, severity)
        rho, status = trace_verdict(self.problem, trace)
        proper = status == Status.OK
        holds = jnp.all(boolean_semantics(self.problem, trace))
        return Outcome(jnp.min(rho), proper & ~holds, proper)

    def uncertain(self, features: Features) -> Bool[Array, ""]:
        """Return whether the loop fails with the worst perception, but not with the best."""
        best, worst = self.outcome(features, 0.0), self.outcome(features, 1.0)
        return best.proper & ~best.fails & worst.fails

    def severity(self, features: Features) -> Float[Array, ""]:
        """Return the smallest severity at which the loop fails, by bisection between 0 and 1.

        If failing is not monotone in the severity, the loop fails at the result and not just below.
        """

        def halve(_: Any, ends: tuple[Array, Array]) -> tuple[Array, Array]:
            low, high = ends
            middle = (low + high) / 2
            fails = self.outcome(features, middle).fails
            return jnp.where(fails, low, middle), jnp.where(fails, middle, high)

        ends = (jnp.asarray(0.0), jnp.asarray(1.0))
        return jax.lax.fori_loop(0, BISECTIONS, halve, ends)[1]

    def decisive(self, features: Features) -> Decisive:
        """Return the last instant at which the perception must err for the loop to fail."""
        severity = self.severity(features)
        trace = self.trace(features, severity).hold()
        errs = robustness_signal(self.error, trace, boolean, end=self.problem.end) > 0
        last = trace.length if trace.valid is None else trace.valid
        errs &= jnp.arange(trace.length) < last
        # Without any, the instant at which it comes nearest to it.
        margin = robustness_signal(self.error, trace, end=self.problem.end)
        instant = jnp.where(
            jnp.any(errs), trace.length - 1 - jnp.argmax(errs[::-1]), jnp.argmax(margin)
        )
        sample = {name: jnp.asarray(values)[instant] for name, values in trace.signals.items()}
        return Decisive(severity, sample, instant, jnp.sum(errs))


def sample_region(loop: AbstractLoop, samples: int, seed: int) -> pd.DataFrame:
    """Simulate samples of the prior with the best and the worst perception.

    **Returns:** a row for each: the features; `kind`; `best` and `worst`, the robustness with
    either perception; `severity`, the smallest with which it fails, and `erring`, the number of
    instants at which the perception then errs, both NaN unless it is uncertain.
    """

    def judge(features: Features) -> dict[str, Array]:
        best, worst = loop.outcome(features, 0.0), loop.outcome(features, 1.0)
        proper = best.proper & worst.proper
        uncertain = proper & ~best.fails & worst.fails
        kind = jnp.where(uncertain, 0, jnp.where(best.fails, 2, jnp.where(proper, 1, 3)))
        decisive = loop.decisive(features)
        return {
            "kind": kind,
            "best": best.rho,
            "worst": worst.rho,
            "severity": jnp.where(uncertain, decisive.severity, jnp.nan),
            "erring": jnp.where(uncertain, decisive.erring, jnp.nan),
        }

    space = loop.problem.space
    features = space.sample(jax.random.key(seed), samples)
    at_once = min(AT_ONCE, samples)
    columns = jax.device_get(jax.jit(lambda f: jax.lax.map(judge, f, batch_size=at_once))(features))
    names = np.array([UNCERTAIN, SAFE, FAILS_ANYWAY, NO_VERDICT])
    columns["kind"] = names[columns["kind"]]
    return pd.DataFrame({**space.rows(jax.device_get(features)), **columns})
