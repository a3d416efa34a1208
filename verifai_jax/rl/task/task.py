"""What an environment must offer to be trained on: a task, and the kinds of action.

    class Reach:
        action = Continuous(low=-1.0, high=1.0)
        time_limit = 200
        def reset(self, key): ...
        def step(self, key, state, action): ...             # state, reward, terminated
        def observe(self, state): ...

There is nothing to inherit from: whatever has these members is a task.
"""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Array, Bool, Float, Key


@dataclass(frozen=True)
class Discrete:
    """One of `n` actions, an integer from 0 on."""

    n: int

    def __post_init__(self) -> None:
        if self.n < 2:
            raise ValueError(f"a discrete action needs at least 2 choices; got (n={self.n})")


@dataclass(frozen=True)
class Continuous:
    """A vector `[size]`, each entry between `low` and `high`."""

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
    """An episodic task, pure and traceable by JAX, for one environment at a time.

    `time_limit` is in steps; reaching it cuts an episode off without ending it: the state goes on
    to have a value. `terminated` ends it: nothing comes after. The object must be hashable.
    """

    @property
    def action(self) -> Action:
        """The kind of action that `step` takes."""
        ...

    @property
    def time_limit(self) -> int:
        """Steps after which an episode is cut off."""
        ...

    def reset(self, key: Key[Array, ""]) -> Any:
        """A first state."""
        ...

    def step(
        self, key: Key[Array, ""], state: Any, action: Any
    ) -> tuple[Any, Float[Array, ""], Bool[Array, ""]]:
        """The next state, the reward, and whether the episode is over for good."""
        ...

    def observe(self, state: Any) -> Float[Array, " k"]:
        """What the policy sees of a state."""
        ...
