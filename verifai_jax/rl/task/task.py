"""The contract of an environment to train on, and the kinds of action.

    class Reach:
        action = Continuous(low=-1.0, high=1.0)
        time_limit = 200
        def reset(self, key): ...
        def step(self, key, state, action): ...             # state, reward, terminated
        def observe(self, state): ...

There is nothing to inherit from: whatever has these members is a task.
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
    """An episodic task: pure functions that JAX can trace, for one environment at a time.

    - `action`: the kind of action that `step` takes.
    - `time_limit`: steps after which an episode is cut off. That does not end it: the state goes on
      to have a value. Only `terminated`, which `step` returns, ends an episode for good.
    - `reset(key) -> state`: a first state, drawn with the random key.
    - `step(key, state, action) -> (state, reward, terminated)`: one step of the environment.
    - `observe(state) -> [k]`: the numbers that the policy is given.

    A task may also have `start(key, features) -> state`, the first state of an episode with given
    features of a problem; `vj.harden` trains on counterexamples by it.

    The object is a static argument of compiled programs, so it must be hashable; or it is a pytree,
    whose numbers are then arguments of the program, so that other values compile nothing.
    """

    @property
    def action(self) -> Action:
        """The kind of action that `step` takes."""
        ...

    @property
    def time_limit(self) -> int:
        """Steps after which an episode is cut off."""
        ...

    def reset(self, key: Key[Array, ""]) -> State:
        """Draw a first state.

        **Arguments:**
        - `key`: a random key, of this episode's start alone.
        **Returns:** a state with the structure, shapes and dtypes that `step` returns.
        """
        ...

    def step(
        self, key: Key[Array, ""], state: State, action: Shaped[Array, "..."]
    ) -> tuple[State, Float[Array, ""], Bool[Array, ""]]:
        """Take one step.

        **Arguments:**
        - `key`: a random key, of this step alone.
        - `state`: as `reset` or `step` returned it.
        - `action`: an int32 scalar of a `Discrete` task, a float32 vector `[size]` of a
          `Continuous` one.
        **Returns:** the next state; the reward; whether the episode is over for good.
        """
        ...

    def observe(self, state: State) -> Float[Array, " k"]:
        """Return the observation `[k]` of a state, which is what the policy is given."""
        ...
