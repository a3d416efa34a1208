"""Any Python function as a system: a simulator that JAX cannot trace.

    blackbox(simulate)                               # simulate(features) -> Trace, in this process
    blackbox(simulate, seeded=True)                  # simulate(features, seed) -> Trace
    blackbox(simulate, workers=4, timeout=10.0)      # in four processes, 10 s each at most
    blackbox(simulate, vectorised=True)              # many at a time: every array is [n, ...]

A simulation that raises, hangs or kills its process becomes a row with a message and does not end
the run.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import jax
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Key

from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.core.user_code.forks import returning_once
from verifai_jax.core.user_code.user_files import declared_files
from verifai_jax.core.values.gaps import has_truths, with_gaps
from verifai_jax.core.values.trace import Status, Trace, check_code
from verifai_jax.features.domain import Domain
from verifai_jax.systems.base import (
    Features,
    FunctionSystem,
    KnownSignals,
    Outcome,
    Seed,
    System,
    as_system,
)
from verifai_jax.systems.blackbox.trace_form import SignalNames, TraceForm
from verifai_jax.systems.blackbox.workers import Pool
from verifai_jax.systems.channels import Link, Passing


@dataclass(frozen=True, eq=False)
class Simulation:
    """A user's function that simulates once, with checked traces; sent to worker processes."""

    function: Callable[..., Trace]
    seeded: bool
    declared: TraceForm

    def __call__(self, features: Features, seed: int) -> Trace:
        arguments = (features, seed) if self.seeded else (features,)
        with returning_once():
            trace = self.function(*arguments)
        return self.declared.accept(trace)

    @property
    def known_signals(self) -> KnownSignals:
        """The signals of a trace; see `System.known_signals`."""
        if self.declared.signals is not None:
            return self.declared.widths
        return getattr(self.function, "known_signals", None)

    def __setstate__(self, state: dict[str, Any]) -> None:
        # After `simulate = blackbox(simulate, workers=2)` a worker finds the system by this name.
        function = state["function"]
        inner = function.simulation.function if isinstance(function, PooledBlackBox) else function
        for name, value in {**state, "function": inner}.items():
            object.__setattr__(self, name, value)


@dataclass(frozen=True, eq=False)
class _RowByRow(System):
    """A simulator on the host that simulates one row at a time."""

    black_box: ClassVar[bool] = True
    simulation: Simulation

    def abstract(self, features: Features) -> Trace | None:
        return self.simulation.declared.abstract()

    @property
    def known_signals(self) -> KnownSignals:
        return self.simulation.known_signals

    def may_draw(self, features: Features) -> bool:
        """Return whether the simulator is given a seed."""
        return self.simulation.seeded

    def check(self, features: Features) -> None:
        """Refuse features that do not fit, if the simulator has a `check` of its own."""
        as_system(self.simulation.function).check(features)

    def with_domains(self, domains: Mapping[str, Domain]) -> System:
        made = _bare(as_system(self.simulation.function).with_domains(domains))
        if made is self.simulation.function:
            return self
        return self._with(replace(self.simulation, function=made))

    @property
    def notes(self) -> tuple[str, ...]:
        """The notes of the simulator."""
        return as_system(self.simulation.function).notes

    @property
    def exact_step(self) -> bool:
        """True if the simulator declares its step a part of the system."""
        return as_system(self.simulation.function).exact_step

    def filmed(self, replay: Any) -> Any:
        return as_system(self.simulation.function).filmed(replay)

    def passing(self, features: Features) -> Passing:
        """Return what passes in the loop of the simulator, if it has one that is known."""
        return as_system(self.simulation.function).passing(features)

    def with_links(self, links: tuple[Link, ...]) -> System:
        simulation = replace(
            self.simulation, function=_bare(as_system(self.simulation.function).with_links(links))
        )
        return self._with(simulation)

    def _with(self, simulation: Simulation) -> System:
        """Return the same system with another simulation."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class BlackBox(_RowByRow):
    """A system on the host, simulated row by row and never traced by JAX; made by `blackbox`."""

    def __call__(self, features: Features, key: Seed = None) -> Trace:
        """Simulate once, with features as plain Python and NumPy values.

        **Arguments:**
        - `key`: a JAX random key, or an integer seed.
        """
        return self.simulation(plain_leaves(features), seed_of(key))

    def _with(self, simulation: Simulation) -> System:
        return BlackBox(simulation)

    @property
    def can_refine(self) -> bool:
        return as_system(self.simulation.function).can_refine

    def refined(self, factor: int) -> "BlackBox":
        """Return the same simulator with a step divided by `factor`, if it has one."""
        return BlackBox(replace(self.simulation, function=_finer(self.simulation.function, factor)))

    def renewed(self) -> "BlackBox":
        """Return a fresh copy of the simulator, if it defines `renewed()`."""
        made = _renewed(self.simulation.function)
        if made is self.simulation.function:
            return self
        return BlackBox(replace(self.simulation, function=made))


@dataclass(frozen=True, eq=False)
class PooledBlackBox(_RowByRow):
    """A system on the host in its own processes; made by `blackbox(..., workers=n)`."""

    pool: Pool

    @property
    def workers(self) -> int:
        """Number of simulations that run in parallel."""
        return self.pool.workers

    def __call__(self, features: Features, key: Seed = None) -> Trace:
        """Simulate once, in a worker.

        **Raises:** `RuntimeError`, `TimeoutError`: what went wrong there.
        """
        return single_trace(self.simulate_each([plain_leaves(features)], [seed_of(key)]))

    def simulate_each(
        self, features: Sequence[Features], seeds: Sequence[int]
    ) -> Iterator[tuple[int, Outcome]]:
        return self.pool.outcomes(features, seeds)

    def _with(self, simulation: Simulation) -> System:
        pool = self.pool
        options = (pool.workers, pool.timeout, pool.retries)
        return PooledBlackBox(simulation, Pool(simulation, simulation.function, *options))

    def renewed(self) -> "PooledBlackBox":
        """Return the same simulator with new worker processes."""
        return PooledBlackBox(self.simulation, self.pool.renewed())

    def close(self) -> None:
        """End the workers; the next simulation starts new ones."""
        self.pool.close()


@dataclass(frozen=True, eq=False)
class VectorisedBlackBox(System):
    """A system on the host that simulates many rows at a time; made by `blackbox`."""

    black_box: ClassVar[bool] = True
    function: Callable[..., Trace]
    seeded: bool
    declared: TraceForm

    def __call__(self, features: Features, key: Seed = None) -> Trace:
        """Simulate once, as a batch of one."""
        batch = jax.tree.map(lambda leaf: np.asarray(leaf)[None], features)
        trace = self._simulate(batch, np.array([seed_of(key)], np.uint32), 1)
        return jax.tree.map(lambda leaf: leaf[0], trace)

    @property
    def known_signals(self) -> KnownSignals:
        return None if self.declared.signals is None else self.declared.widths

    @property
    def exact_step(self) -> bool:
        """True if the simulator declares its step to be part of the system."""
        return as_system(self.function).exact_step

    @property
    def can_refine(self) -> bool:
        return as_system(self.function).can_refine

    def refined(self, factor: int) -> "VectorisedBlackBox":
        """Return the same simulator with a step divided by `factor`, if it has one."""
        return replace(self, function=_finer(self.function, factor))

    def renewed(self) -> "VectorisedBlackBox":
        """Return a fresh copy of the simulator, if it defines `renewed()`."""
        made = _renewed(self.function)
        return self if made is self.function else replace(self, function=made)

    def simulate_batch(self, features: Features, keys: Key[Array, " n"]) -> Trace:
        seeds = np.zeros(len(keys), np.uint32)
        if self.seeded:
            seeds = np.asarray(jax.vmap(jax.random.bits)(keys))
        return self._simulate(features, seeds, len(keys))

    def may_draw(self, features: Features) -> bool:
        """Return whether the simulator receives seeds."""
        return self.seeded

    def abstract(self, features: Features) -> Trace | None:
        return self.declared.abstract()

    def _simulate(self, features: Features, seeds: np.ndarray, n: int) -> Trace:
        arguments = (features, seeds) if self.seeded else (features,)
        with returning_once():
            trace = self.function(*arguments)
        if not isinstance(trace, Trace):
            raise TypeError(f"the system must return a Trace; it returned {type(trace).__name__}")
        return self._checked(trace, n)

    def _checked(self, trace: Trace, n: int) -> Trace:
        for name, signal in trace.signals.items():
            shape = np.shape(signal)
            if len(shape) not in (2, 3) or shape[0] != n:
                raise ValueError(
                    f"signal {name!r} of a vectorised black box must have shape [{n}, time] or "
                    f"[{n}, time, k], a row for each simulation; got {list(shape)}"
                )
        lengths = {np.shape(signal)[1] for signal in trace.signals.values()}
        if len(lengths) > 1:
            raise ValueError(f"signals must have one length; got {sorted(lengths)}")
        rows = {"valid": (n,), "status": (n,), "times": (n, *lengths)}
        whole = {}
        for name, shape in rows.items():
            value = getattr(trace, name)
            if value is None:
                continue
            if np.shape(value) not in (shape, shape[1:]):
                raise ValueError(
                    f"{name} of a vectorised black box must have shape {list(shape)}; "
                    f"got {list(np.shape(value))}"
                )
            whole[name] = np.broadcast_to(np.asarray(value), shape)
        signals = {n: np.asarray(with_gaps(n, signal)) for n, signal in trace.signals.items()}
        trace = stack_traces(signals, trace.dt, held=trace.held, finite=trace.finite, **whole)
        # Its signals and clock alone: a wrong `valid` or status is an error of its own row.
        times = None if trace.times is None else trace.times[0]
        self.declared.accept(Trace({n: s[0] for n, s in signals.items()}, trace.dt, times))
        return trace


@suggests_options
def blackbox(
    function: Callable[..., Trace],
    *,
    seeded: bool = False,
    workers: int | None = None,
    timeout: float | None = None,
    retries: int = 1,
    vectorised: bool = False,
    signals: SignalNames | None = None,
    dt: float | None = None,
    length: int | None = None,
    files: Iterable[str | Path] = (),
) -> BlackBox | PooledBlackBox | VectorisedBlackBox:
    """Mark a Python function as a system that runs on the host.

    **Arguments:**
    - `function(features) -> Trace`: numbers arrive as `float` and `int`, arrays as NumPy. It may
      have a method `refined(factor)` that returns the same function with a smaller step, which is
      used to confirm failures (not in workers).
    - `seeded`: whether to call `function(features, seed)`, with an integer seed in `[0, 2^32)` that
      is the same on every replay.
    - `workers`: number of processes, which start with the first simulation and stay; `function`
      must then be at the top level of a module. When left out, simulations run one after the other
      in this process. A worker has one core for JAX, no GPU, and no standard output.
    - `timeout`: wall-clock seconds for one simulation, after which it becomes a row with status
      `timeout`; needs `workers`. Compiling and loading in a worker's first simulation count.
    - `retries`: how often a simulation is repeated in a new process after its process died.
    - `vectorised`: whether `function` simulates many rows at a time: arrays of features are `[n,
      ...]`, `seeds` is `[n]`, and all arrays of the trace have the same leading axis; see
      `stack_traces`.
    - `signals`, `dt`, `length`: the form of every trace; see `TraceForm`. A trace of another form
      becomes a row with status `error`.
    - `files`: files of data that the simulator reads. Their hashes are recorded with the modules of
      the model, and `resume` refuses to continue if one has changed.
    **Returns:** a `VectorisedBlackBox` if `vectorised`, a `PooledBlackBox` if `workers` are given,
    otherwise a `BlackBox`.
    **Raises:** `ValueError` for an object that cannot be called, or that workers cannot import, and
    for incompatible options; `FileNotFoundError` for a missing file.
    """
    if not callable(function):
        raise ValueError(f"blackbox needs a function (features) -> Trace; got {function!r}")
    declared = TraceForm(signals, dt, length, declared_files(files))
    if vectorised and workers is not None:
        raise ValueError(
            f"blackbox runs either vectorised or in workers; got (vectorised=True, {workers=})"
        )
    if timeout is not None and workers is None:
        raise ValueError(
            "blackbox can end a simulation only in a process of its own: give workers=1, or more, "
            f"with timeout={timeout}"
        )
    if vectorised:
        return VectorisedBlackBox(function, seeded, declared)
    simulation = Simulation(function, seeded, declared)
    if workers is None:
        return BlackBox(simulation)
    return PooledBlackBox(simulation, Pool(simulation, function, workers, timeout, retries))


def stack_traces(
    signals: Mapping[str, np.ndarray | Array],
    dt: float | None = None,
    times: ArrayLike | None = None,
    valid: ArrayLike | None = None,
    status: ArrayLike | None = None,
    held: bool = False,
    finite: tuple[str, ...] = (),
) -> Trace:
    """Stack many traces into one, like the result of `jax.vmap` over a system.

    **Arguments:** those of `Trace`, each array with a leading axis: `signals` are `[n, time]` or
    `[n, time, k]`, `times` `[n, time]`, `valid` and `status` `[n]`.
    **Returns:** a `Trace` whose leaves have a leading axis `[n]`.
    **Raises:** the errors of `Trace` for the first invalid one.
    """
    truths = frozenset(name for name, signal in signals.items() if has_truths(signal))
    signals = {name: with_gaps(name, signal) for name, signal in signals.items()}
    first = None if times is None else np.asarray(times)[0]
    for name, value in (("valid", valid), ("status", status)):
        known = None if value is None else np.asarray(value)
        check_code(name, known, "a whole number for each row")
    Trace({name: np.asarray(signal)[0] for name, signal in signals.items()}, dt, first)
    # A Trace is checked as one; unflattening is how JAX makes a batch of them.
    zeros = {name: np.zeros(1) for name in signals}
    whole = Trace(zeros, 1.0, held=held, finite=finite, truths=truths)
    trace = jax.tree.unflatten(jax.tree.structure(whole), list(signals.values()))
    for name, value in (("dt", dt), ("times", times), ("valid", valid), ("status", status)):
        object.__setattr__(trace, name, value)
    return trace


def single_trace(outcomes: Iterator[tuple[int, Outcome]]) -> Trace:
    """Return the trace of the only outcome.

    **Raises:** `TimeoutError` or `RuntimeError` with its message if it has no trace.
    """
    ((_, outcome),) = outcomes
    if outcome.trace is None:
        kind = TimeoutError if outcome.status == Status.TIMEOUT else RuntimeError
        raise kind(outcome.message)
    return outcome.trace


def seed_of(key: Seed) -> int:
    """Return the integer seed of a simulation: computed from its JAX key, or the number itself."""
    if isinstance(key, int | np.integer):
        return int(key)
    if key is None:
        return 0
    return int(jax.random.bits(key))


def plain_leaves(features: Features) -> Any:
    """Return the same features with plain Python numbers and NumPy arrays."""
    return jax.tree.map(_plain, features)


def _plain(leaf: object) -> Any:
    if not isinstance(leaf, jax.Array | np.ndarray | np.generic):
        return leaf
    return np.asarray(leaf).item() if np.ndim(leaf) == 0 else np.asarray(leaf)


def _finer(function: Callable[..., Trace], factor: int) -> Callable[..., Trace]:
    return _bare(as_system(function).refined(factor))


def _renewed(function: Callable[..., Trace]) -> Callable[..., Trace]:
    return _bare(as_system(function).renewed())


def _bare(system: System) -> Callable[..., Trace]:
    """Return the function of a system that was made of one, which errors speak of."""
    return system.function if isinstance(system, FunctionSystem) else system
