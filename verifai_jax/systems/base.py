"""The contract between a system under test and everything that simulates it.

    class Pendulum(System):
        def __call__(self, features, key=None): ...     # all that a system must have

    as_system(lambda features, key: Trace(...))         # any function is a system, too

All else has a default here: a system offers more by overriding it.
"""

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
from verifai_jax.systems.channels import Link, Passing

KnownSignals: TypeAlias = tuple[str, ...] | Mapping[str, int] | None
"""Names of signals, or names with their numbers of components, 1 for a scalar; None if unknown."""
Features: TypeAlias = PyTree
"""The features of one simulation, as `FeatureSpace.unflatten` gives them; or of a batch."""
Seed: TypeAlias = Key[Array, ""] | int | None
"""A random key of JAX; for a system on the host, an integer seed will also do."""
Carry = TypeVar("Carry")


class Outcome(NamedTuple):
    """The end of one simulation: a trace, or a status other than OK and a message."""

    trace: Trace | None
    status: Status = Status.OK
    message: str = ""


def outcome_of(simulate: Callable[[], Any]) -> Outcome:
    """Simulate once in this process, and return what came of it.

    Whatever a simulator raises is the end of its own row, as it is in a worker: `sys.exit()` and
    exceptions that are no `Exception` too. Only Ctrl-C ends the run.

    **Arguments:**
    - `simulate`: calls the system.
    """
    try:
        with returning_once():
            return Outcome(simulate())
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        return Outcome(None, Status.ERROR, format_user_error(error))


class System(ForUsers):
    """A system under test: a callable `(features, key) -> Trace`, and what else it may offer.

    - `black_box`: True for a system that runs on the host; JAX must be able to trace any other.
    - `lanes`: simulations that a device works on together.
    - `effort`: how much XLA does to make programs that simulate it fast; one for all numbers of
      rows, since a row's last digits may depend on it.
    - `forward_up_to`: features up to which forward mode is no slower than reverse mode.
    - `notes`: sentences for the notes of a run, on what the system changed in what it was given.
    - `reverse_hint`: a sentence for users, on what makes reverse mode work where it does not.
    - `dt`: the sampling period in seconds of what `fold` simulates.
    - `workers`: simulations of a black box that run side by side.
    - `exact_step`: True where the step is part of what the system is, as in an environment that its
      authors define by a difference equation: no finer step simulates the same system.
    - `traced_factor`: True where JAX may trace the factor that `refined` takes.
    - `backends`: names of the engines that can simulate this system, for one with several.
    - `backend`: the engine in use, or `"auto"` until a run decides; None without `backends`.
    - `likely`: the engine that is likely the fastest on a CPU.
    - `derived`: how a verb made this system of the one that it was given, as plain data for the
      record of a run; None for a system of a person's own.
    - `constants`: numbers and texts of the model by name, by which two models can be compared.
    """

    _internal = frozenset((
        "abstract", "backend", "backends", "black_box", "can_fold", "can_refine",
        "can_simulate_batch", "can_simulate_each", "constants", "derived", "effort", "exact_step",
        "fold", "forward_up_to", "known_signals", "lanes", "likely", "links", "may_draw", "passing",
        "refined", "renewed", "reverse_hint", "simulate_batch", "simulate_each", "switches",
        "traced_factor", "unroll", "why_error", "why_not", "with_backend", "with_links", "workers",
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
        raise NotImplementedError(f"{type(self).__name__} has no __call__(features, key)")

    def check(self, features: Features) -> None:
        """Refuse features that the system does not fit, before anything compiles.

        **Arguments:**
        - `features`: `jax.ShapeDtypeStruct`s.
        **Raises:** `ValueError` that says what does not fit.
        """

    def abstract(self, features: Features) -> Trace | None:
        """Return the form of the trace, its signals as `jax.ShapeDtypeStruct`s.

        None if nothing but a simulation can tell.

        **Arguments:**
        - `features`: `jax.ShapeDtypeStruct`s.
        """
        if self.black_box:
            return None
        return jax.eval_shape(self, features, jax.eval_shape(lambda: jax.random.key(0)))

    @property
    def known_signals(self) -> KnownSignals:
        """Signals of a trace, of a system without `abstract`: names, with components where known.

        None if nothing but a simulation can tell.
        """
        return None

    @property
    def can_fold(self) -> bool:
        """True for a system that can simulate without storing its samples."""
        return type(self).fold is not System.fold

    def fold(
        self,
        features: Features,
        key: Seed,
        carry: Carry,
        update: Callable[[Carry, dict[str, Array]], Carry],
    ) -> tuple[Carry, Int[Array, ""]]:
        """Simulate, and let `carry = update(carry, sample)` take in each sample; none is stored.

        After an early end the last valid sample repeats until the last step.

        **Returns:** the last carry, and the status of the simulation.
        """
        raise NotImplementedError(f"{self!r} has no fold(features, key, carry, update)")

    @property
    def can_refine(self) -> bool:
        """True for a system that has finer steps; never where `exact_step`."""
        return type(self).refined is not System.refined and not self.exact_step

    def refined(self, factor: int | Int[Array, ""]) -> "System":
        """Return the same system, sampled and decided as before, at a smaller step.

        **Arguments:**
        - `factor`: the step is divided by it; a traced integer where `traced_factor` allows it.
        **Raises:** `ValueError` for a factor that is not a positive integer.
        """
        raise NotImplementedError(f"{self!r} has no refined(factor)")

    def renewed(self) -> "System":
        """Return the same system without the state that its simulations left in it.

        That is the system itself where it has nothing that could be made anew.
        """
        return self

    def with_backend(self, name: str) -> "System":
        """Return the same system on one of its `backends`, or on `"auto"`.

        **Raises:** `ValueError` for an engine that cannot simulate it.
        """
        raise ValueError(f"{self!r} has no backends to choose from; got backend {name!r}")

    def why_not(self, backend: str) -> str | None:
        """Return the reason why an engine cannot simulate this system, None if it can."""
        return None if backend in self.backends else "the system has no such backend"

    def why_slow_to_compile(self, gradient: bool) -> str:
        """Say why compiling this system takes minutes, and what is cheaper; empty if it is quick.

        **Arguments:**
        - `gradient`: whether derivatives are compiled too.
        """
        return ""

    def why_error(self, features: Features) -> str | None:
        """Return the reason why a traced simulation ended with the status `ERROR`, None if unknown.

        **Arguments:**
        - `features`: numbers by the names of the table's columns.
        """
        return None

    def passing(self, features: Features) -> Passing:
        """Return what passes between the system and its policy, where faults can be.

        **Arguments:**
        - `features`: `jax.ShapeDtypeStruct`s.
        **Raises:** `ValueError` for a system that has no policy or controller that is known here.
        """
        raise ValueError(
            f"{self!r} has no loop of which observations and actions are known, so that no fault "
            "can be put in it: make the system by vj.ode, mujoco, brax, gymnax, gymnasium or "
            "playground, or apply the faults in the simulator and say with_faults(..., "
            "by_simulator=True)"
        )

    def with_links(self, links: tuple[Link, ...]) -> "System":
        """Return the same system with faults between it and its policy; see `passing`."""
        raise NotImplementedError(f"{self!r} has no with_links(links)")

    def may_draw(self, features: Features) -> bool:
        """Return whether a simulation of a host system may depend on its random key.

        JAX tells of any other system. What nobody knows may.

        **Arguments:**
        - `features`: `jax.ShapeDtypeStruct`s.
        """
        return True

    @property
    def can_simulate_batch(self) -> bool:
        """True for a host system that simulates many rows in lock-step."""
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
        """True for a host system that simulates rows on their own, in any order."""
        return type(self).simulate_each is not System.simulate_each

    def simulate_each(
        self, features: Sequence[Features], seeds: Sequence[int]
    ) -> Iterator[tuple[int, Outcome]]:
        """Simulate rows on the host, each on its own: in processes, or on other machines.

        **Returns:** the index and the outcome of each row exactly once, in any order, as soon as
        its simulation has ended.
        """
        raise NotImplementedError(f"{self!r} has no simulate_each(features, seeds)")


_VALUES = (
    *("black_box", "lanes", "effort", "forward_up_to", "reverse_hint", "dt", "exact_step"),
    *("traced_factor", "backends", "backend", "likely"),
)


class FunctionSystem(System):
    """A function `(features, key) -> Trace` as a system; made by `as_system`.

    An object that can be called, and that has some attributes and methods of a `System`, offers
    them here. Two of one function are equal, so that JAX does not trace it twice.
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

    def check(self, features: Features) -> None:
        if self._offers("check"):
            self._method("check")(features)

    def abstract(self, features: Features) -> Trace | None:
        if self._offers("abstract"):
            return self._method("abstract")(features)
        return super().abstract(features)

    @property
    def can_fold(self) -> bool:
        return self._offers("fold")

    def fold(
        self,
        features: Features,
        key: Seed,
        carry: Carry,
        update: Callable[[Carry, dict[str, Array]], Carry],
    ) -> tuple[Carry, Int[Array, ""]]:
        return self._method("fold")(features, key, carry, update)

    @property
    def can_refine(self) -> bool:
        return self._offers("refined") and not self.exact_step

    def refined(self, factor: int | Int[Array, ""]) -> System:
        return as_system(self._method("refined")(factor))

    def renewed(self) -> System:
        return as_system(self._method("renewed")()) if self._offers("renewed") else self

    def with_backend(self, name: str) -> System:
        return as_system(self._method("with_backend")(name))

    def why_not(self, backend: str) -> str | None:
        if self._offers("why_not"):
            return self._method("why_not")(backend)
        return super().why_not(backend)

    def passing(self, features: Features) -> Passing:
        return self._method("passing")(features)

    def with_links(self, links: tuple[Link, ...]) -> System:
        return as_system(self._method("with_links")(links))

    def may_draw(self, features: Features) -> bool:
        return self._method("may_draw")(features)

    @property
    def can_simulate_batch(self) -> bool:
        return self._offers("simulate_batch")

    def simulate_batch(self, features: Features, keys: Key[Array, " n"]) -> Trace:
        return self._method("simulate_batch")(features, keys)

    @property
    def can_simulate_each(self) -> bool:
        return self._offers("simulate_each")

    def simulate_each(
        self, features: Sequence[Features], seeds: Sequence[int]
    ) -> Iterator[tuple[int, Outcome]]:
        return self._method("simulate_each")(features, seeds)

    def _offers(self, name: str) -> bool:
        return callable(getattr(self.function, name, None))

    def _method(self, name: str) -> Callable[..., Any]:
        """Return a method of the function's object, or of `System`, which says what is missing."""
        offered = getattr(self.function, name, None)
        return offered if callable(offered) else getattr(super(), name)


def as_system(thing: object) -> System:
    """Return a system as it is, and anything else that can be called as a system.

    This is the only place that asks an object what it offers.

    **Raises:** `ValueError` for what cannot be called.
    """
    if isinstance(thing, System):
        return thing
    if not callable(thing):
        raise ValueError(f"system must be a function (features, key) -> Trace; got {thing!r}")
    return FunctionSystem(thing)
