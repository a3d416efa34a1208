"""The contract of a training algorithm: hyper-parameters with functions `init / step / policy`.

An algorithm is a frozen dataclass that JAX knows as a pytree: hyper-parameters that change no shape
are its leaves, so one compiled program serves all their values. Hyper-parameters that change a
shape are static fields (`static_field`); each combination of them is compiled once.
"""

import contextlib
import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, ClassVar, NamedTuple, Protocol, TypeAlias, TypeVar, runtime_checkable

from jaxtyping import Array, Float, Int, Key, Num, PyTree

from verifai_jax.addons.rl.policy import ACTIVATIONS, Policy
from verifai_jax.addons.rl.task.task import Task

T = TypeVar("T")
Number = Num[Array, ""] | float | int
"""A hyper-parameter that JAX may trace."""
AlgorithmState: TypeAlias = PyTree
"""The state of a training run: any pytree of arrays, of the same structure after every update."""


class Progress(NamedTuple):
    """The episodes that ended in one update.

    - `mean_return`: mean of their returns, with exploration; NaN if none ended.
    - `episodes`: their number.
    """

    mean_return: Float[Array, ""]
    episodes: Int[Array, ""]


@runtime_checkable
class Algorithm(Protocol):
    """A training algorithm with its hyper-parameters. Its state is any pytree of arrays.

    - `actions`: the kinds of action that it can learn, `Discrete` or `Continuous`.
    - `steps_per_update`: number of environment steps in one `step`.
    """

    actions: ClassVar[tuple[type, ...]]

    @property
    def steps_per_update(self) -> int:
        """Number of environment steps in one update."""
        ...

    def check(self) -> None:
        """Refuse invalid hyper-parameters.

        **Raises:** `ValueError`, naming the hyper-parameter and its value.
        """
        ...

    def init(
        self, task: Task, key: Key[Array, ""], updates: int | Int[Array, ""]
    ) -> AlgorithmState:
        """Make the state before the first update.

        **Arguments:**
        - `task`: the task to learn.
        - `key`: a random key, from which all random numbers of the training are derived.
        - `updates`: the number of updates, after which schedules end.
        """
        ...

    def step(self, task: Task, state: AlgorithmState) -> tuple[AlgorithmState, Progress]:
        """Perform one update: take some steps of the environments and learn from them.

        **Returns:** the state after it, and the episodes that ended in it.
        """
        ...

    def policy(self, task: Task, state: AlgorithmState) -> Policy:
        """Return the policy learnt so far, without exploration."""
        ...


def static_field(default: T) -> T:
    """Make a dataclass field that determines shapes or structure: static under `jit`."""
    return dataclasses.field(default=default, metadata={"static": True})


_CONDITIONS: dict[str, Callable[[Any], bool]] = {
    "positive": lambda value: float(value) > 0,
    "at least 0": lambda value: float(value) >= 0,
    "at least 1": lambda value: float(value) >= 1,
    "between 0 and 1": lambda value: 0 <= float(value) <= 1,
    "above 0 and at most 1": lambda value: 0 < float(value) <= 1,
    "at least 0 and below 1": lambda value: 0 <= float(value) < 1,
}
"""Conditions on hyper-parameters, by the words that follow "must be"."""


def check_values(
    algorithm: object, names: Iterable[str], wanted: str, holds: Callable[[Any], bool] | None = None
) -> None:
    """Refuse the first of the named hyper-parameters for which a condition is false.

    - `wanted`: the condition in words that follow "must be", one of `_CONDITIONS` without `holds`.

    **Raises:** `ValueError`: "PPO's clip must be positive; got -1".
    """
    holds = _CONDITIONS[wanted] if holds is None else holds
    for name in names:
        value, good = getattr(algorithm, name), False
        with contextlib.suppress(TypeError, ValueError):  # A text where a number belongs.
            good = holds(value)
        if not good:
            raise ValueError(f"{type(algorithm).__name__}'s {name} must be {wanted}; got {value}")


class Vectorised:
    """An algorithm whose update takes `horizon` steps of each of its `environments`."""

    environments: int
    horizon: int

    @property
    def steps_per_update(self) -> int:
        """Number of environment steps in one update."""
        return self.environments * self.horizon

    def check_shapes(self, *counts: str) -> None:
        """Refuse numbers below 1 (those named too), minibatches that do not divide, and widths."""
        check_values(self, ("environments", "horizon", *counts), "at least 1")
        steps, rest = self.steps_per_update, [n for n in counts if n == "minibatches"]
        wanted = f"a divisor of environments * horizon = {steps}"
        check_values(self, rest, wanted, lambda value: steps % value == 0)
        widths = [name for name in ("hidden", "value_hidden") if hasattr(self, name)]
        check_values(self, widths, "positive widths", lambda value: all(w >= 1 for w in value))
        named = [name for name in ("activation",) if hasattr(self, name)]
        check_values(self, named, " or ".join(ACTIVATIONS), lambda value: value in ACTIVATIONS)


def check_fit(algorithm: Algorithm, task: Task) -> None:
    """Refuse a task whose kind of action the algorithm cannot learn.

    **Raises:** `ValueError`, naming the algorithm, the task and the kinds that fit.
    """
    if not isinstance(task.action, algorithm.actions):
        kinds = " or ".join(kind.__name__.lower() for kind in algorithm.actions)
        raise ValueError(
            f"{type(algorithm).__name__} learns {kinds} actions; "
            f"{type(task).__name__} has {task.action}"
        )
