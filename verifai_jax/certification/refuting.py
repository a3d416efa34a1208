"""The attack: an active search against every policy, which may only refute.

    attacks = refute(pieces, policies=8, search=CrossEntropy(), rounds=4)
    attacks[3].worst                                    # the least robustness that it met

Each policy has a search of its own; their simulations go through one program. What a search finds
says that a policy can fail, never how likely it is: points that it chose are no samples.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from verifai_jax import search as searches
from verifai_jax.certification.pieces import Pieces
from verifai_jax.options import check_search
from verifai_jax.problem import Problem
from verifai_jax.proposals import Proposals
from verifai_jax.search import Search


@dataclass(eq=False)
class Seen:
    """Simulations of one policy: points of the unit cube, robustness, and whether they fail."""

    points: list[Float[np.ndarray, "n d"]]
    rho: list[Float[np.ndarray, " n"]]
    failing: list[Bool[np.ndarray, " n"]]
    proper: list[Bool[np.ndarray, " n"]]

    @classmethod
    def nothing(cls) -> "Seen":
        """Before the first simulation."""
        return cls([], [], [], [])

    def add(self, points: Any, outcome: Any) -> None:
        """Take in one block."""
        self.points.append(points)
        self.rho.append(outcome.rho)
        self.failing.append(outcome.failing)
        self.proper.append(outcome.proper)

    @property
    def simulations(self) -> int:
        """Simulations so far."""
        return sum(map(len, self.rho))

    @property
    def failures(self) -> int:
        """Those that ended properly and break a formula."""
        return int(sum(map(np.sum, self.failing)))

    @property
    def not_finite(self) -> int:
        """Those without a verdict."""
        return int(sum(np.sum(~proper) for proper in self.proper))


def usable_search(problem: Problem, search: str | Search) -> Search:
    """The search, if it can attack many policies.

    **Raises:** `ValueError` for an unknown name, one that the space does not suit, or one that
    follows slopes; `TypeError` for what is no search.
    """
    found = searches.named(search) if isinstance(search, str) else search
    if isinstance(found, Search) and (found.wants_gradient or found.wants_clauses):
        known = (name for name in searches.names() if not _slopes(name))
        raise ValueError(
            f"search {search!r} follows slopes, which the attack on many policies does without; "
            f"use one of {', '.join(known)}"
        )
    return check_search(problem, found)


def _slopes(name: str) -> bool:
    found = searches.named(name)
    return found.wants_gradient or found.wants_clauses


def refute(
    pieces: Pieces, seen: list[Seen], search: Search, rounds: int, told: Callable[[int], None]
) -> None:
    """Attack every policy in so many rounds of one block each; what is met goes into `seen`.

    - `told(simulations)`: called after each block, for the progress.
    """
    attackers = [Proposals(search, pieces.space, pieces.lanes, pieces.attack_key) for _ in seen]
    for round_ in range(rounds):
        asked = []
        for number, attacker in enumerate(attackers):
            if attacker.exhausted:
                continue
            points = np.asarray(attacker.next(pieces.lanes), np.float32)
            if len(points):
                asked.append((number, points))
            else:
                attacker.tell_refused()
        for place, outcome in pieces.attack(asked, round_, _name(search)):
            number, points = asked[place]
            seen[number].add(points, outcome)
            attackers[number].tell(outcome.rho, outcome.proper, None)
            told(len(points))


def _name(search: Search) -> str:
    return repr(search)
