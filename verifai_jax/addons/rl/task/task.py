"""The contract of an environment to train on, and the kinds of action.

    class Reach:
        action = Continuous(low=-1.0, high=1.0)
        time_limit = 200
        def reset(self, key): ...
        def step(self, key, state, action): ...             # state, reward, terminated
        def observe(self, state): ...

There is no base class: any object with these members is a task.
"""

from dataclasses import dataclass
from typing import Protocol, TypeAlias, runtime_checkable

from jaxtyping import Array, Bool, Float, Key, PyTree, Shaped

State: TypeAlias = PyTree
"""The state of one environment: any pytree of arrays, of the same structure at every step."""


@dataclass(frozen=True)
class Discrete:
    """One of `n` actions, an integer from 0 on.

    **Raises:** `ValueError` for fewer than two choices.
    """

    n: int

    def __post_init__(self) -> None:
        if self.n < 2:
            raise ValueError(f"a discrete action needs at least 2 choices; got (n={self.n})")


@dataclass(frozen=True)
class Continuous:
    """A vector `[size]` of actions, each entry between `low` and `high`.

    **Raises:** `ValueError` unless `low < high` and `size >= 1`.
    """

    low: float
    high: float
    size: int = 1

    def __post_init__(self) -> None:
        if not self.low < self.high or self.size < 1:
            raise ValueError(
                "a continuous action needs low < high and a size of at least 1; "
                f"got (low={self.low}, high={self.high}, size={self.size})"
            )


Action = Discrete | Continuous


@runtime_checkable
class Task(Protocol):
    """An episodic task: pure functions that JAX can trace, for one environment.

    - `action`: the kind of action that `step` takes.
    - `time_limit`: number of steps after which an episode is truncated. Truncation does not end it:
      the last state still has a value. Only `terminated`, returned by `step`, ends an episode for
      good.
    - `reset(key) -> state`: returns a first state, drawn with the random key.
    - `step(key, state, action) -> (state, reward, terminated)`: takes one step of the environment.
    - `observe(state) -> [k]`: returns the policy's observation.

    A task may also define `start(key, features) -> state`, the first state of an episode with given
    features of a problem, which `vj.harden` uses to train on counterexamples.

    The object is a static argument of compiled programs, so it must be hashable. It may also be a
    pytree: its numbers are then arguments of the program, and other values need no compilation.
    """

    @property
    def action(self) -> Action:
        """The kind of action that `step` takes."""
        ...

    @property
    def time_limit(self) -> int:
        """Number of steps after which an episode is truncated."""
        ...

    def reset(self, key: Key[Array, ""]) -> State:
        """Draw a first state.

        **Arguments:**
        - `key`: a random key for this episode's start only.
        **Returns:** a state with the structure, shapes and dtypes that `step` returns.
        """
        ...

    def step(
        self, key: Key[Array, ""], state: State, action: Shaped[Array, "..."]
    ) -> tuple[State, Float[Array, ""], Bool[Array, ""]]:
        """Take one step.

        **Arguments:**
        - `key`: a random key for this step only.
        - `state`: a state returned by `reset` or `step`.
        - `action`: an int32 scalar for a `Discrete` task, a float32 vector `[size]` for a
          `Continuous` one.
        **Returns:** the next state; the reward; whether the episode is over for good.
        """
        ...

    def observe(self, state: State) -> Float[Array, " k"]:
        """Return the policy's observation `[k]` of a state."""
        ...
