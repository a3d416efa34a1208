"""Running the cases of a fuzzer, one after the other, and counting what came of them."""

import random
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field


class Broken(AssertionError):
    """A promise of the package that a case has broken."""


@dataclass
class Tally:
    """The outcomes of a fuzzer's cases, and what was broken, by the number of its case."""

    outcomes: Counter[str] = field(default_factory=Counter)
    broken: dict[int, str] = field(default_factory=dict)
    slowest: tuple[float, int] = (0.0, -1)
    seconds: float = 0.0

    @property
    def cases(self) -> int:
        """How many cases there were."""
        return self.outcomes.total() + len(self.broken)

    def __str__(self) -> str:
        counts = ", ".join(f"{n:,} {word}" for word, n in sorted(self.outcomes.items()))
        lines = [
            f"{self.cases:,} cases in {self.seconds:.0f} s: {counts or 'none right'}; "
            f"the slowest took {self.slowest[0]:.2f} s of CPU (case {self.slowest[1]})"
        ]
        lines += [f"  BROKEN by case {case}: {why}" for case, why in self.broken.items()]
        return "\n".join(lines)


def tally(
    case: Callable[[int], str],
    first: int,
    cases: int | None = None,
    seconds: float = float("inf"),
) -> Tally:
    """Run cases from the number `first` on, so many or so long, whichever ends first."""
    found, begun = Tally(), time.monotonic()
    number = first
    while (cases is None or number < first + cases) and time.monotonic() - begun < seconds:
        spent = time.process_time()
        try:
            found.outcomes[case(number)] += 1
        except Exception as error:  # Anything that is not foreseen is broken, too.
            found.broken[number] = f"{type(error).__name__}: {str(error)[:500]}"
        found.slowest = max(found.slowest, (time.process_time() - spent, number))
        number += 1
    found.seconds = time.monotonic() - begun
    return found


def chance(number: int, purpose: str) -> random.Random:
    """Return the random numbers of one case."""
    return random.Random(f"{purpose} {number}")
