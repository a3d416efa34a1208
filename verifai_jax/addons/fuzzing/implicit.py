"""Properties that need no formula: a run ends, all signals are finite and within their ranges.

    problem = with_implicit(problem_or_none, space, system, ranges={"speed": (0, 60)})

They are formulas over signals that a wrapper adds to the traces of the system, so that their
counterexamples are rows like any other: replayed, shrunk, counted.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from verifai_jax.core.messages.checks import is_number
from verifai_jax.core.values.trace import Status, Trace
from verifai_jax.features import Domain, FeatureSpace
from verifai_jax.mtl import Formula, always, signal
from verifai_jax.problem.behaviour import Behaviour
from verifai_jax.problem.problem import Problem
from verifai_jax.systems.base import Features, Outcome, Seed, System, as_system, outcome_of
from verifai_jax.systems.blackbox._blackbox import plain_leaves

FINITE = "finite"
"""Name of the signal that is positive if all signals are finite, and of its property."""
COMPLETED = "completed"
"""Name of the signal that is positive if a simulation ended properly, and of its property."""
RANGE = "range_"
"""Beginning of the name of the property that a signal stays in its range."""
HOLDS = 1e6
"""The value of these signals if all is well; it exceeds the robustness of any formula."""
Ranges = Mapping[str, tuple[float, float]]
"""The range within which each signal must stay."""
Cells = Mapping[str, tuple[float, float, int]]
"""For each signal the low and the high end of its cells, and their number."""
CELLS_OF_A_RANGE = 4
"""Default number of cells of a signal with a range."""
MAX_CUT = 4
"""Maximum number of signals with ranges that are divided into cells by default."""


class CheckedSystem(System):
    """A system whose traces also show whether the simulation ended properly, with finite signals.

    **Arguments:**
    - `system`: the system.
    - `ranges`: the ranges of signals. Numbers that are not finite are reported, and replaced by the
      middle of the range.
    - `verdicts`: whether a simulation that raises, hangs or is not finite gets a trace that breaks
      a property; otherwise it has a status and no verdict.
    - `cells`: the cells of signals given to `fuzz`, for the record of the run.
    """

    def __init__(
        self, system: System, ranges: Ranges, verdicts: bool, cells: Cells | None = None
    ) -> None:
        self.system, self.ranges, self.verdicts = system, dict(ranges), verdicts
        self.cells = cells
        self.derived = {
            "verb": "fuzz",
            "ranges": {name: [float(end) for end in ends] for name, ends in ranges.items()},
            "cells": None if cells is None else {n: [*map(float, c)] for n, c in cells.items()},
            "without_formula": verdicts,
        }
        self.__wrapped__ = getattr(system, "__wrapped__", system)
        self.black_box = system.black_box
        self.lanes, self.forward_up_to = system.lanes, system.forward_up_to
        self.reverse_hint, self.exact_step = system.reverse_hint, system.exact_step
        self.traced_factor = system.traced_factor
        self.backends, self.backend, self.likely = system.backends, system.backend, system.likely

    def why_slow_to_compile(self, gradient: bool) -> str:
        return self.system.why_slow_to_compile(gradient)

    @property
    def notes(self) -> tuple[str, ...]:
        """The notes of the system."""
        return self.system.notes

    def __repr__(self) -> str:
        return repr(self.system)

    def _of(self, system: System) -> "CheckedSystem":
        return CheckedSystem(system, self.ranges, self.verdicts, self.cells)

    def __call__(self, features: Features, key: Seed = None) -> Trace:
        if not (self.black_box and self.verdicts):
            return self._checked(self.system(features, key))
        trace = outcome_of(partial(self.system, features, key)).trace
        try:
            return self._failed() if trace is None else self._checked(trace)
        except Exception:
            return self._failed()

    def check(self, features: Features) -> None:
        self.system.check(features)

    def abstract(self, features: Features) -> Trace | None:
        if self.black_box:
            # The signals are those of a simulation, which nothing else can tell.
            return None
        return super().abstract(features)

    @property
    def can_refine(self) -> bool:
        return self.system.can_refine

    def refined(self, factor: Any) -> System:
        return self._of(self.system.refined(factor))

    def renewed(self) -> System:
        renewed = self.system.renewed()
        if renewed is self.system:
            return self
        return self._of(renewed)

    def with_backend(self, name: str) -> System:
        return self._of(self.system.with_backend(name))

    def why_not(self, backend: str) -> str | None:
        return self.system.why_not(backend)

    @property
    def can_simulate_batch(self) -> bool:
        return self.system.can_simulate_batch

    def simulate_batch(self, features: Features, keys: Key[Array, " n"]) -> Trace:
        return self._checked(self.system.simulate_batch(features, keys), batch=1)

    @property
    def can_simulate_each(self) -> bool:
        return self.black_box and not self.can_simulate_batch

    def simulate_each(
        self, features: Sequence[Features], seeds: Sequence[int]
    ) -> Iterator[tuple[int, Outcome]]:
        for i, (trace, status, message) in self._outcomes(features, seeds):
            if trace is None and self.verdicts:
                words = message or f"the simulation ended as {Status(status).name.lower()}"
                yield i, Outcome(self._failed(), Status.OK, words)
            elif isinstance(trace, Trace):
                yield i, Outcome(self._checked(trace), status, message)
            else:
                yield i, Outcome(trace, status, message)

    def _outcomes(
        self, features: Sequence[Features], seeds: Sequence[int]
    ) -> Iterator[tuple[int, Outcome]]:
        if self.system.can_simulate_each:
            yield from self.system.simulate_each(features, seeds)
            return
        for i, (each, seed) in enumerate(zip(features, seeds, strict=True)):
            yield i, outcome_of(partial(self.system, plain_leaves(each), seed))

    def _failed(self) -> Trace:
        """Return the trace of a simulation that did not end properly."""
        signals = {name: np.full(1, (low + high) / 2) for name, (low, high) in self.ranges.items()}
        return Trace({**signals, FINITE: np.full(1, HOLDS), COMPLETED: -np.ones(1)}, dt=1.0)

    def _checked(self, trace: Trace, batch: int = 0) -> Trace:
        # What is traced by JAX stays there; traces of the host are arrays of NumPy.
        xp: Any = np if self.black_box else jnp
        signals = {name: xp.asarray(samples) for name, samples in trace.signals.items()}
        finite: Any = True
        for samples in signals.values():
            known = xp.isfinite(samples)
            rest = tuple(range(1 + batch, known.ndim))
            finite = finite & (xp.all(known, axis=rest) if rest else known)
        status = xp.asarray(Status.OK if trace.status is None else trace.status)
        status = xp.reshape(status, xp.shape(status) + (1,) * (xp.ndim(finite) - xp.ndim(status)))
        if self.verdicts:
            finite = finite & (status != Status.NONFINITE)
            for name, (low, high) in self.ranges.items():
                if name in signals:
                    known = xp.isfinite(signals[name])
                    signals[name] = xp.where(known, signals[name], (low + high) / 2)
            ended = (status != Status.ERROR) & (status != Status.TIMEOUT)
            signals[COMPLETED] = xp.where(ended & xp.ones_like(finite), HOLDS, -1.0)
        signals[FINITE] = xp.where(finite, HOLDS, -1.0)
        own = (FINITE, COMPLETED) if self.verdicts else (*trace.finite, FINITE)
        status = None if self.verdicts else trace.status
        checked = trace if not batch else _unchecked(trace)
        if batch:
            for name, value in (("signals", signals), ("status", status), ("finite", own)):
                object.__setattr__(checked, name, value)
            return checked
        return replace(checked, signals=signals, status=status, finite=own)


def _unchecked(trace: Trace) -> Trace:
    """Return a copy of a batch of traces without the checks of `Trace`, which expects one trace."""
    copy = object.__new__(Trace)
    for name, value in vars(trace).items():
        object.__setattr__(copy, name, value)
    return copy


def with_implicit(
    problem: Problem | None, space: FeatureSpace | Mapping[str, Domain] | None,
    system: Callable[..., Trace] | None, ranges: Ranges, cells: Cells | None, name: str,
) -> Problem:  # fmt: skip
    """Return a problem with the implicit properties added to its own formulas.

    **Raises:** `ValueError` unless either a problem or a space with a system is given, and for
    invalid ranges.
    """
    for key, ends in ranges.items():
        if not (isinstance(ends, tuple | list) and len(ends) == 2 and all(map(is_number, ends))):
            raise ValueError(f"the range of signal {key!r} must be (low, high); got {ends!r}")
        if not ends[0] < ends[1]:
            raise ValueError(f"the range of signal {key!r} needs low < high; got {ends!r}")
        if key in (FINITE, COMPLETED):
            raise ValueError(f"fuzz adds a signal {key!r} of its own; call yours otherwise")
    properties: dict[str, Formula] = {FINITE: always(signal(FINITE) > 0)}
    for key, (low, high) in ranges.items():
        properties[f"{RANGE}{key}"] = always((signal(key) >= low) & (signal(key) <= high))
    own_behaviour = None if problem is None or cells is not None else problem.behaviour
    given = cells
    if cells is None:
        cut = ranges if len(ranges) <= MAX_CUT else {}
        cells = {key: (low, high, CELLS_OF_A_RANGE) for key, (low, high) in cut.items()}
    if problem is not None:
        if space is not None or system is not None:
            raise ValueError("give fuzz a problem, or space= and system=, not both")
        taken = [key for key in properties if key in problem.formulas]
        if taken:
            raise ValueError(f"fuzz has a property {taken[0]!r} of its own; rename that formula")
        own = problem.formulas
        behaviour = own_behaviour or Behaviour(cells, own.values())
        checked = CheckedSystem(problem.system, ranges, verdicts=False, cells=given)
        # A rule without a place in the priority's order cannot be ranked.
        return replace(problem, system=checked, spec={**own, **properties}, behaviour=behaviour)
    if space is None or system is None:
        raise ValueError("fuzz needs a problem, or space= and system=")
    properties = {COMPLETED: always(signal(COMPLETED) > 0), **properties}
    checked = CheckedSystem(as_system(system), ranges, verdicts=True, cells=given)
    behaviour = Behaviour(cells, properties.values())
    return Problem(name, space, checked, properties, behaviour=behaviour)


def as_recorded(problem: Problem, derived: Mapping[str, Any]) -> Problem:
    """Return a problem with the implicit properties recorded by a run of `fuzz`.

    **Arguments:**
    - `problem`: the problem with its own formulas only; if the run had none, its name, space and
      system are used.
    - `derived`: `CheckedSystem.derived` of the run.
    **Raises:** `ValueError`, `TypeError`, `KeyError` for a record that describes no such problem.
    """
    ranges = {name: (low, high) for name, (low, high) in derived["ranges"].items()}
    cells = derived["cells"]
    if cells is not None:
        cells = {name: (low, high, int(count)) for name, (low, high, count) in cells.items()}
    if derived["without_formula"]:
        return with_implicit(None, problem.space, problem.system, ranges, cells, problem.name)
    return with_implicit(problem, None, None, ranges, cells, problem.name)
