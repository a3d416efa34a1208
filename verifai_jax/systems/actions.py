"""The kinds of action of a controller."""

from dataclasses import dataclass


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
