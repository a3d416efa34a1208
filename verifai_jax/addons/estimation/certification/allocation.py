"""Allocation of simulations to policies with an open verdict and to those that may be the safest.

    allocation = Allocation(p=0.01, samples=512, budget=65_536)
    while (blocks := allocation.next(failures, simulations)).any():
        ...                                             # simulate so many blocks of each policy

    race(draw, arms=64)                                 # only the name of the safest

The next allocation is a pure function of the counts so far, so with stored simulations the same
decisions are made again.

**Naming the safest** is best-arm identification with Bernoulli arms. The posterior of each failure
rate, with Jeffreys' prior Beta(1/2, 1/2), gives the chance that the leader (the policy with the
least posterior mean) is the safest up to `tie`. Until that chance is high enough, half of the
simulations go to the leader and half to its likeliest rivals (top-two sampling: Russo, Simple
Bayesian algorithms for best-arm identification, Operations Research 68, 2020). The chance only
decides when to stop; it is not a bound and certifies nothing.

**Verdicts** rely on bounds that hold at any time (`simultaneous_interval.py`), so they are valid
for any allocation. Undecided policies are simulated further if their observed rate
suggests a decision within the budget, those closest to a decision first.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.addons.estimation.simultaneous_interval import (
    evidence_above,
    evidence_below,
    required_evidence,
)

QUANTILES = 24
"""Points of the leader's posterior in the integral over it."""
GROWTH = 8
"""A policy's samples grow by this part of them in one round, at least by a block."""


class Leader(NamedTuple):
    """The policy that is most likely the safest.

    - `number`: the policy with the least posterior mean.
    - `chance`: posterior probability that no other rate is below the leader's by more than `tie`.
    - `rivals`: for each policy, the probability that its rate is below the leader's by more than
      `tie`.
    """

    number: int
    chance: float
    rivals: Float[np.ndarray, " n"]


def find_leader(
    failures: Int[np.ndarray, " n"], simulations: Int[np.ndarray, " n"], tie: float,
    margins: Float[np.ndarray, " n"] | None = None,
) -> Leader:  # fmt: skip
    """Find the policy that is most likely the safest.

    Ties of the mean go to the policy with more samples, then to the one with the larger entry of
    `margins`, such as the least robustness in an attack, then to the first.
    """
    from scipy.special import betainc, betaincinv

    k, n = np.asarray(failures, float), np.asarray(simulations, float)
    mean = (k + 0.5) / (n + 1)
    order = np.zeros(len(k)) if margins is None else -np.nan_to_num(margins, nan=-np.inf)
    leader = int(np.lexsort((np.arange(len(k)), order, -n, mean))[0])
    levels = (np.arange(QUANTILES) + 0.5) / QUANTILES
    rates = betaincinv(k[leader] + 0.5, n[leader] - k[leader] + 0.5, levels)
    below = np.maximum(rates - tie, 0.0)[:, None]
    better = betainc(k + 0.5, n - k + 0.5, below)
    better[:, leader] = 0.0
    chance = float(np.mean(np.prod(1 - better, axis=1)))
    return Leader(leader, chance, np.mean(better, axis=0))


@dataclass(frozen=True)
class Allocation:
    """A rule that says how many blocks of each policy to simulate next.

    - `p`, `confidence`: limit and confidence of the verdicts. The safest policy is named at half
      the error that `confidence` allows, because among near ties its posterior chance is a little
      too high.
    - `samples`: minimum samples of each policy; `block`: samples of one policy in one block.
    - `budget`: maximum number of samples of all policies together.
    - `tie`: rates that differ by less count as equal. For a leader without a failure about `2.5 /
      tie` samples decide.
    - `verdicts`, `safest`: whether to decide the verdicts, and the safest policy. Without the
      safest, samples only look for safe policies: one that is shown to be unsafe by fewer than
      `samples` gets no more, and beyond them each gets its part of the budget at most, while that
      may show it to be safe.
    """

    p: float = 0.01
    confidence: float = 0.95
    samples: int = 512
    budget: int = 65_536
    block: int = 64
    tie: float = 0.001
    verdicts: bool = True
    safest: bool = True

    @property
    def sure(self) -> float:
        """The posterior chance required to name the safest policy."""
        return (1 + self.confidence) / 2

    def next(
        self, failures: Int[np.ndarray, " n"], simulations: Int[np.ndarray, " n"],
        margins: Float[np.ndarray, " n"] | None = None,
    ) -> Int[np.ndarray, " n"]:  # fmt: skip
        """Return the number of blocks to simulate for each policy; all zero if all is decided.

        - `margins`: numbers that decide between equal leaders; see `find_leader`.
        """
        k, n = np.asarray(failures), np.asarray(simulations)
        missing = np.maximum(-(-(self.samples - n) // self.block), 0)
        if not self.safest:
            unsafe = self._is_shown(evidence_above, k, n)
            missing = np.where(unsafe, 0, np.minimum(missing, np.maximum(n // self.block, 1)))
        if missing.any():
            return missing
        left = (self.budget - int(n.sum())) // self.block
        if left <= 0:
            return np.zeros(len(n), np.int64)
        blocks = np.zeros(len(n), np.int64)
        if self.safest and len(n) > 1:
            blocks = self._rivals(k, n, left, margins)
        if self.verdicts:
            blocks = np.maximum(blocks, self._open(k, n, left - int(blocks.sum())))
        return blocks

    def undecided(
        self, failures: Int[np.ndarray, " n"], simulations: Int[np.ndarray, " n"]
    ) -> Bool[np.ndarray, " n"]:
        """Return the policies whose verdict is open, including those without samples."""
        known = [self._is_shown(e, failures, simulations) for e in (evidence_below, evidence_above)]
        return ~(known[0] | known[1])

    def _is_shown(
        self, evidence: Callable[..., np.ndarray], failures: Int[np.ndarray, " n"],
        simulations: Int[np.ndarray, " n"],
    ) -> Bool[np.ndarray, " n"]:  # fmt: skip
        limit = required_evidence(self.confidence, len(failures))
        p = np.full(len(failures), self.p)
        return evidence(failures, np.maximum(simulations, 1), p) > limit

    def _grown(self, n: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
        """Return the blocks of a round for policies with `n` samples."""
        return np.maximum(n // (GROWTH * self.block), 1)

    def _rivals(
        self, k: Int[np.ndarray, " n"], n: Int[np.ndarray, " n"], left: int, margins: Any
    ) -> Int[np.ndarray, " n"]:
        """Return the blocks of the leader and of its likeliest rivals."""
        blocks = np.zeros(len(n), np.int64)
        now = find_leader(k, n, self.tie, margins)
        if now.chance >= self.sure:
            return blocks
        rivals = np.flatnonzero(now.rivals >= 0.5 * now.rivals.max())
        if k[now.number] == 0:
            # Nothing sets two without a failure apart: the leader alone is played until it fails,
            # or is known to be as good as any.
            rivals = rivals[k[rivals] > 0]
        # Few at a time, the likeliest first: what they show may settle it.
        rivals = rivals[np.argsort(-now.rivals[rivals], kind="stable")][:4]
        each = self._grown(n)
        if n[now.number] <= n[rivals].sum() or not len(rivals):
            blocks[now.number] = each[now.number]
        if not blocks.any() or (len(rivals) and n[now.number] >= n[rivals].max()):
            blocks[rivals] = each[rivals]
        return _within(blocks, left)

    def _open(
        self, k: Int[np.ndarray, " n"], n: Int[np.ndarray, " n"], left: int
    ) -> Int[np.ndarray, " n"]:
        """Return the blocks of policies whose verdict is open and within reach."""
        blocks = np.zeros(len(n), np.int64)
        where = np.flatnonzero(self.undecided(k, n))
        if not len(where):
            return blocks
        more = self._missing(k[where], n[where], len(n))
        reach = math.inf if self.safest else self.budget / len(n)
        for index in np.argsort(more, kind="stable"):
            i, missing = where[index], more[index]
            if not math.isfinite(missing) or missing > min(left * self.block, reach):
                break
            # What it shows on the way may change what is missing.
            wanted = math.ceil(missing / self.block)
            blocks[i] = min(wanted, int(self._grown(n[i : i + 1])[0]))
            left -= wanted
        return blocks

    def _missing(
        self, failures: Int[np.ndarray, " n"], simulations: Int[np.ndarray, " n"], among: int
    ) -> Float[np.ndarray, " n"]:
        """Estimate how many more samples decide; infinite where the budget is too small.

        If the rate is the lower quartile of its posterior, or the upper one, whichever is sooner.
        """
        from scipy.special import betaincinv

        limit = required_evidence(self.confidence, among)
        maximum = max(self.budget, 2 * self.block)
        steps = np.geomspace(self.block, maximum, 32)
        smallest = np.full(len(failures), np.inf)
        k, n = failures[:, None].astype(float), simulations[:, None] + steps
        sides = ((evidence_below, 0.25), (evidence_above, 0.75))
        for evidence, level in sides if self.safest else sides[:1]:
            rates = betaincinv(k + 0.5, simulations[:, None] - k + 0.5, level)
            found = evidence(k + rates * steps, n, np.full(n.shape, self.p)) > limit
            first = np.where(found.any(axis=1), steps[np.argmax(found, axis=1)], np.inf)
            smallest = np.minimum(smallest, first)
        return smallest


def _within(blocks: Int[np.ndarray, " n"], left: int) -> Int[np.ndarray, " n"]:
    """Return the first of these blocks, as many as are left."""
    before = np.concatenate([[0], np.cumsum(blocks)[:-1]])
    return np.clip(left - before, 0, blocks)


class RaceResult(NamedTuple):
    """The safest arm, its chance of being the safest, and the counts of all arms."""

    arm: int
    chance: float
    failures: Int[np.ndarray, " arms"]
    simulations: Int[np.ndarray, " arms"]


def race(
    draw: Callable[[int, int], int], arms: int, *, confidence: float = 0.95, tie: float = 0.001,
    first: int = 16, block: int = 16, budget: int = 1_000_000,
) -> RaceResult:  # fmt: skip
    """Find the arm that fails least often.

    - `draw(arm, n)`: a function that returns the number of failures in the next `n` samples of an
      arm.
    - `first`: samples of each arm at the start; later ones come in blocks of `block`.
    - `budget`: maximum number of samples.
    """
    allocation = Allocation(
        p=1.0, confidence=confidence, samples=first, budget=budget, block=block, tie=tie,
        verdicts=False,
    )  # fmt: skip
    failures, simulations = np.zeros(arms, np.int64), np.zeros(arms, np.int64)
    while (blocks := allocation.next(failures, simulations)).any():
        for arm in np.flatnonzero(blocks):
            count = int(blocks[arm]) * block
            failures[arm] += draw(int(arm), count)
            simulations[arm] += count
    now = find_leader(failures, simulations, tie)
    return RaceResult(now.number, now.chance, failures, simulations)
