"""What the host asks of a simulator that JAX cannot see into, beside calling it once.

A host system has `black_box = True` and may offer one of two ways to simulate many at a time:

    simulate_batch(features, keys) -> Trace              # in lock-step: every leaf `[n, ...]`
    simulate_each(features, seeds) -> (index, Outcome)s  # one by one, in any order, as they finish

One that has neither is called row by row.
"""

from collections.abc import Iterator, Sequence
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

from jaxtyping import Array, Key

from verifai_jax.core.trace import Status, Trace


class Outcome(NamedTuple):
    """What came of one simulation: a trace, or a status other than OK and a message."""

    trace: Trace | None
    status: Status = Status.OK
    message: str = ""


@runtime_checkable
class Batched(Protocol):
    """A host system that simulates a batch in lock-step."""

    black_box: ClassVar[bool]

    def simulate_batch(self, features: Any, keys: Key[Array, " n"]) -> Trace:
        """A trace whose leaves have a leading axis `[n]`, as those of `features` have."""
        ...


@runtime_checkable
class Each(Protocol):
    """A host system that simulates rows on their own: in processes, on other machines."""

    black_box: ClassVar[bool]

    def simulate_each(
        self, features: Sequence[Any], seeds: Sequence[int]
    ) -> Iterator[tuple[int, Outcome]]:
        """Each index exactly once, in any order, as soon as its simulation has ended."""
        ...
