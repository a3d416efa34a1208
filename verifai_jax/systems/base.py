"""The contract between a system under test and the code that simulates it.

    class Pendulum(System):
        def __call__(self, features, key=None): ...     # all that a system must have

    as_system(lambda features, key: Trace(...))         # any function is a system, too

Only the call is required; every other member has a default that a system may override.
"""

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Int, Key, PyTree

from verifai_jax.core.compute.compilation import XlaOptimization
from verifai_jax.core.display.notebook import ForUsers
from verifai_jax.core.user_code.forks import returning_once
from verifai_jax.core.user_code.user_errors import format_user_error
from verifai_jax.core.values.trace import Status, Trace
from verifai_jax.features.domain import Domain
from verifai_jax.systems.channels import Link, Passing
from verifai_jax.systems.forks import Fork, Rollout

KnownSignals: TypeAlias = tuple[str, ...] | Mapping[str, int] | None
"""Names of signals, or names with their numbers of components, 1 for a scalar; None if unknown."""
Features: TypeAlias = PyTree
"""The features of one simulation, as `FeatureSpace.unflatten` gives them; or of a batch."""
Seed: TypeAlias = Key[Array, ""] | int | None
"""A random key of JAX; for a system on the host, an integer seed will also do."""
Carry = TypeVar("Carry")


class Outcome(NamedTuple):
    """The result of one simulation: a trace, or a status other than OK with a message."""

    trace: Trace | None
    status: Status = Status.OK
    message: str = ""


def outcome_of(simulate: Callable[[], Any]) -> Outcome:
    """Simulate once in this process, and return the outcome.

    Whatever a simulator raises ends only its own row, as in a worker process: this includes
    `sys.exit()` and exceptions that are not an `Exception`. Only Ctrl-C ends the run.

    **Arguments:**
    - `simulate`: a function that calls the system.
    """
    try:
        with returning_once():
            return Outcome(simulate())
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        return Outcome(None, Status.ERROR, format_user_error(error))


class System(ForUsers):
    """A system under test: a callable `(features, key) -> Trace`, with optional capabilities.

    - `black_box`: True for a system that runs on the host; JAX must be able to trace any other.
    - `lanes`: number of simulations that a device processes together.
    - `effort`: XLA's optimisation effort for programs that simulate it. It is the same for all
      numbers of rows, since a row's last digits may depend on it.
    - `forward_up_to`: number of features up to which forward mode is no slower than reverse mode.
    - `notes`: sentences for the notes of a run, on changes that the system made to its inputs.
    - `reverse_hint`: a sentence for users on how to make reverse mode work if it does not.
    - `dt`: the sampling period of `fold` in seconds.
    - `workers`: number of simulations of a black box that run in parallel.
    - `exact_step`: True if the step is part of the system, as in an environment that is defined by
      a difference equation: no finer step simulates the same system.
    - `traced_factor`: True if JAX may trace the factor of `refined`.
    - `backends`: names of the engines that can simulate this system, if there are several.
    - `backend`: the engine in use, or `"auto"` until a run decides; None without `backends`.
    - `likely`: the engine that is probably the fastest on a CPU.
    - `derived`: the derivation of this system from the user's, as plain data for the record of a
      run; None for a user's own system.
    - `constants`: numbers and texts of the model by name, for comparisons of two models.
    """

    _internal = frozenset((
        "abstract", "backend", "backends", "black_box", "can_fold", "can_fork", "can_refine",
        "can_simulate_batch", "can_simulate_each", "constants", "derived", "effort", "exact_step",
        "filmed", "fold", "forks", "forward_up_to", "go_on", "known_signals", "lanes", "likely",
        "links", "may_draw", "passing", "refined", "renewed", "reverse_hint", "rollout",
        "simulate_batch", "simulate_each", "switches", "traced_factor", "unroll", "why_error",
        "why_not", "with_backend", "with_domains", "with_links", "workers",
    ))  # fmt: skip
    black_box: bool = False
    # About 1 MB of a trace with 200 samples and two signals.
    lanes: int = 512
    effort: XlaOptimization = "most"
    forward_up_to: int = 1
    notes: tuple[str, ...] = ()
    reverse_hint: str = ""
    dt: float | None = None
    workers: int = 1
    exact_step: bool = False
    traced_factor: bool = False
    backends: tuple[str, ...] = ()
    backend: str | None = None
    likely: str | None = None
    derived: Mapping[str, Any] | None = None
    constants: Mapping[str, str | np.ndarray] = MappingProxyType({})

    def __call__(self, features: Features, key: Seed = None) -> Trace:
        """Simulate once, the same trace for the same features and key."""
        if not self.can_fork:
            raise NotImplementedError(f"{type(self).__name__} has no __call__(features, key)")
        return self.rollout(features, key).trace()

    def check(self, features: Features) -> None:
        """Refuse features that do not fit the system, before anything compiles.

        **Arguments:**
        - `features`: `jax.ShapeDtypeStruct`s.
        **Raises:** `ValueError` that names what does not fit.
        """

    def with_domains(self, domains: Mapping[str, Domain]) -> "System":
        """Return the system for features of these domains; for one that needs their choices."""
        return self

    def abstract(self, features: Features) -> Trace | None:
        """Return the shapes of the trace, its signals as `jax.ShapeDtypeStruct`s.

        None if only a simulation can show them.

        **Arguments:**
        - `features`: `jax.ShapeDtypeStruct`s.
        """
        if self.black_box:
            return None
        return jax.eval_shape(self, features, jax.eval_shape(lambda: jax.random.key(0)))

    @property
    def known_signals(self) -> KnownSignals:
        """The signals of a system without `abstract`: names, with components if known.

        None if only a simulation can show them.
        """
        return None

    @property
    def can_fold(self) -> bool:
        """True if the system can simulate without storing its samples."""
        return type(self).fold is not System.fold or self.can_fork

    def fold(
        self, features: Features, key: Seed, carry: Carry,
        update: Callable[[Carry, dict[str, Array]], Carry],
    ) -> tuple[Carry, Int[Array, ""]]:  # fmt: skip
        """Simulate with `carry = update(carry, sample)` for each sample, without storing samples.

        After an early end the last valid sample repeats until the last step.

        **Returns:** the last carry, and the status of the simulation.
        """
        if not self.can_fork:
            raise NotImplementedError(f"{self!r} has no fold(features, key, carry, update)")
        return self.rollout(features, key).fold(carry, update)

    @property
    def can_fork(self) -> bool:
        """True if a simulation may stop before any sample, and go on from there."""
        return type(self).rollout is not System.rollout

    def rollout(self, features: Features, key: Seed = None) -> Rollout:
        """Return one simulation as a loop over its samples, for a system that can fork."""
        raise NotImplementedError(f"{self!r} has no rollout(features, key), so it cannot fork")

    def forks(self, features: Features, key: Seed = None) -> Fork:
        """Simulate once, and return the forks before all samples; `at(k)` selects one."""
        return self.rollout(features, key).forks(features, key)

    def go_on(self, fork: Fork, first: Int[Array, ""] | int = 0) -> Trace:
        """Return the whole trace of a fork that goes on.

        **Arguments:**
        - `first`: an index, common to a batch, before which none of its forks begins; the samples
          before it take no time.
        """
        return self.rollout(fork.features, fork.key).go_on(fork, first)

    @property
    def can_refine(self) -> bool:
        """True if the system has finer steps; never with `exact_step`."""
        return type(self).refined is not System.refined and not self.exact_step

    def refined(self, factor: int | Int[Array, ""]) -> "System":
        """Return the same system with a smaller step; samples and decisions keep their times.

        **Arguments:**
        - `factor`: the divisor of the step; a traced integer if `traced_factor` allows it.
        **Raises:** `ValueError` for a factor that is not a positive integer.
        """
        raise NotImplementedError(f"{self!r} has no refined(factor)")

    def filmed(self, replay: Any) -> Any:
        """Return the `pictures.film.Film` of a replay that the simulator draws; None without one.

        **Arguments:**
        - `replay`: the `Replay` of one simulation.
        """
        return None

    def renewed(self) -> "System":
        """Return the same system without any state left over from its simulations.

        Returns the system itself if it has no such state.
        """
        return self

    def with_backend(self, name: str) -> "System":
        """Return the same system on one of its `backends`, or on `"auto"`.

        **Raises:** `ValueError` for an engine that cannot simulate it.
        """
        raise ValueError(f"{self!r} has no backends to choose from; got backend {name!r}")

    def why_not(self, backend: str) -> str | None:
        """Return the reason why an engine cannot simulate this system; None if it can."""
        return None if backend in self.backends else "the system has no such backend"

    def why_slow_to_compile(self, gradient: bool) -> str:
        """Explain why compiling this system takes minutes, with a remedy; empty if it is quick.

        **Arguments:**
        - `gradient`: whether derivatives are compiled as well.
        """
        return ""

    def why_error(self, features: Features) -> str | None:
        """Return the reason why a traced simulation ended with status `ERROR`; None if unknown.

        **Arguments:**
        - `features`: numbers by column name of the table.
        """
        return None

    def passing(self, features: Features) -> Passing:
        """Return the values that pass between the system and its policy, where faults can act.

        **Arguments:**
        - `features`: `jax.ShapeDtypeStruct`s.
        **Raises:** `ValueError` for a system without a known policy or controller.
        """
        raise ValueError(
            f"{self!r} has no loop with known observations and actions, so faults cannot act in "
            "it: make the system by vj.ode, mujoco, brax, gymnax, gymnasium or "
            "playground, or apply the faults in the simulator and use with_faults(..., "
            "by_simulator=True)"
        )

    def with_links(self, links: tuple[Link, ...]) -> "System":
        """Return the same system with faults between it and its policy; see `passing`."""
        raise NotImplementedError(f"{self!r} has no with_links(links)")

    def may_draw(self, features: Features) -> bool:
        """Return whether a simulation of a host system may depend on its random key.

        For any other system JAX finds out. If nothing is known, the answer is True.

        **Arguments:**
        - `features`: `jax.ShapeDtypeStruct`s.
        """
        return True

    @property
    def can_simulate_batch(self) -> bool:
        """True if a host system simulates many rows in lock-step."""
        return type(self).simulate_batch is not System.simulate_batch

    def simulate_batch(self, features: Features, keys: Key[Array, " n"]) -> Trace:
        """Simulate `n` rows on the host, in lock-step.

        **Arguments:**
        - `features`: each leaf with a leading axis `[n]`.
        **Returns:** a trace, each leaf with a leading axis `[n]`.
        """
        raise NotImplementedError(f"{self!r} has no simulate_batch(features, keys)")

    @property
    def can_simulate_each(self) -> bool:
        """True if a host system simulates rows separately, in any order."""
        return type(self).simulate_each is not System.simulate_each

    def simulate_each(
        self, features: Sequence[Features], seeds: Sequence[int]
    ) -> Iterator[tuple[int, Outcome]]:
        """Simulate rows on the host separately: in processes, or on other machines.

        **Returns:** the index and the outcome of each row exactly once, in any order, as soon as
        its simulation has ended.
        """
        raise NotImplementedError(f"{self!r} has no simulate_each(features, seeds)")


_VALUES = (
    *("black_box", "lanes", "effort", "forward_up_to", "reverse_hint", "dt", "exact_step"),
    *("traced_factor", "backends", "backend", "likely", "notes"),
)


def _delegated(name: str, *, makes_system: bool = False) -> Any:
    """Return a method that the function's object answers; `System` where that has none."""
    default = getattr(System, name)

    @functools.wraps(default)
    def method(self: "FunctionSystem", *arguments: Any, **options: Any) -> Any:
        if not self._offers(name):
            return default(self, *arguments, **options)
        found = getattr(self.function, name)(*arguments, **options)
        return as_system(found) if makes_system else found

    return method


class FunctionSystem(System):
    """A function `(features, key) -> Trace` as a system; made by `as_system`.

    If the callable object has attributes and methods of a `System`, they are available here. Two
    systems of one function are equal, so that JAX does not trace it twice.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        # JAX names the function and its file in its errors by these.
        self.__wrapped__ = function
        self.__name__ = getattr(function, "__name__", type(function).__name__)
        for name in _VALUES:
            if (value := getattr(function, name, None)) is not None:
                setattr(self, name, value)

    def __repr__(self) -> str:
        return repr(self.function)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FunctionSystem) and other.function is self.function

    def __hash__(self) -> int:
        return id(self.function)

    # A function may return anything; what simulates it refuses anything but a Trace.
    def __call__(self, features: Features, key: Seed = None) -> Any:
        return self.function(features, key)

    check = _delegated("check")
    with_domains = _delegated("with_domains", makes_system=True)
    abstract = _delegated("abstract")
    fold = _delegated("fold")
    rollout = _delegated("rollout")
    refined = _delegated("refined", makes_system=True)
    filmed = _delegated("filmed")
    renewed = _delegated("renewed", makes_system=True)
    with_backend = _delegated("with_backend", makes_system=True)
    why_not = _delegated("why_not")
    passing = _delegated("passing")
    with_links = _delegated("with_links", makes_system=True)
    may_draw = _delegated("may_draw")
    simulate_batch = _delegated("simulate_batch")
    simulate_each = _delegated("simulate_each")
    can_fold = property(lambda self: self._offers("fold"))
    can_fork = property(lambda self: self._offers("rollout"))
    can_refine = property(lambda self: self._offers("refined") and not self.exact_step)
    can_simulate_batch = property(lambda self: self._offers("simulate_batch"))
    can_simulate_each = property(lambda self: self._offers("simulate_each"))

    def _offers(self, name: str) -> bool:
        return callable(getattr(self.function, name, None))


def as_system(thing: object) -> System:
    """Return a system unchanged, and any other callable as a system.

    Only this function examines which capabilities an object has.

    **Raises:** `ValueError` for an object that cannot be called.
    """
    if isinstance(thing, System):
        return thing
    if not callable(thing):
        raise ValueError(f"system must be a function (features, key) -> Trace; got {thing!r}")
    return FunctionSystem(thing)
