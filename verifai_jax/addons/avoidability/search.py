"""The search for escapes by thousands of forks in a batch, and proofs that there are none."""

import itertools
import math
import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.addons.avoidability.means import Choice, Controls, Means
from verifai_jax.addons.verification.enclosure import Enclosure
from verifai_jax.core.display.progress import count_done
from verifai_jax.core.messages.text import format_error
from verifai_jax.core.values.trace import Status, Trace
from verifai_jax.evaluation.verdicts import violations
from verifai_jax.features import Array, Box, FeatureSpace
from verifai_jax.problem.problem import Problem
from verifai_jax.systems.forks import Fork

INSTANTS, FURTHER = 16, (0, 1, 3, 7)
"""Instants searched at once; and those after the bracket, from its end, searched once more."""
ELITES, CLIMBED = 24, 4
"""Best choices that are kept for an instant, and those of them that gradients improve."""
PIECES, SPREAD = 6, 0.03
"""Most pieces of a drawn choice, and the least deviation with which cross-entropy draws."""
STEPS = (0.5, 0.15, 0.05, 0.015, 0.005)
"""Lengths of a step along a gradient, as shares of the range of an action."""
MAX_BATCHES = 16
"""Batches of sequences of whole-number actions that are tried from an instant, at most."""
Plans = tuple[Float[np.ndarray, "n steps entries"], Int[np.ndarray, " n"]]
"""Numbers of choices, and where they stop."""


class Proposals:
    """The choices of one instant: the best first, and those that wait to be tried.

    Best responses are often extreme and change seldom (bang-bang): half of the numbers are ends of
    their range, and hold for a while.
    """

    def __init__(self, means: Means, start: int, rng: np.random.Generator) -> None:
        self.means, self.start, self.rng = means, start, rng
        self.first = min(start, means.shape[0] - 1)
        self.waiting: list[Plans] = []
        self.numbers, self.stops = np.zeros((0, *means.shape)), np.zeros(0, int)
        self.rho = np.zeros(0)

    def learn(self, plans: Plans, rho: Float[np.ndarray, " n"]) -> None:
        """Keep the best of the known and these."""
        rho = np.concatenate([self.rho, rho])
        best = np.argsort(-rho, kind="stable")[:ELITES]
        self.rho, self.stops = rho[best], np.concatenate([self.stops, plans[1]])[best]
        self.numbers = np.concatenate([self.numbers, plans[0]])[best]

    def next(self, count: int) -> Plans:
        """Return choices to try: those that wait, new ones, and changes of the best."""
        parts, self.waiting = self.waiting, []
        left = max(count - sum(len(stops) for _, stops in parts), 0)
        changed = 2 * left // 3 if len(self.rho) else 0
        parts.append(self._few_pieces(left - changed))
        parts += [self._changed(changed)] if changed else []
        numbers, stops = (np.concatenate(both)[:count] for both in zip(*parts, strict=True))
        return numbers, stops

    def _few_pieces(self, count: int) -> Plans:
        (steps, entries), rng = self.means.shape, self.rng
        # Changes are more likely soon after the start, where they matter most.
        changes = self.first + (steps - self.first) * rng.random((count, PIECES - 1)) ** 2
        few = rng.integers(0, PIECES, (count, 1)) <= np.arange(PIECES - 1)
        pieces = np.arange(steps)[:, None] >= np.where(few, steps, changes)[:, None]
        levels = rng.random((count, PIECES, entries))
        levels = np.where(rng.random(levels.shape) < 0.5, levels.round(), levels)
        early = self.means.ends & (rng.random(count) < 0.5)
        stops = np.where(early, rng.integers(self.first + 1, steps + 1, count), steps)
        return np.take_along_axis(levels, pieces.sum(2)[:, :, None], axis=1), stops

    def _changed(self, count: int) -> Plans:
        """Return good choices with a segment that is new, near the best, or of another one.

        What is near is drawn by cross-entropy: with the deviations of the best choices.
        """
        (steps, entries), rng, size = self.means.shape, self.rng, len(self.rho)
        parents = (size * rng.random(count) ** 2).astype(int)
        length = np.maximum(1, ((steps - self.first) * rng.random(count) ** 3).astype(int))
        begin = rng.integers(self.first, np.maximum(steps - length, self.first) + 1)
        since = np.arange(steps) - begin[:, None]
        chosen = rng.random((count, entries)) < max(0.5, 1.5 / entries)
        inside = ((since >= 0) & (since < length[:, None]))[:, :, None] & chosen[:, None]
        old, (new, stops) = self.numbers[parents], self._few_pieces(count)
        noise = rng.standard_normal((count, 1, entries)) * (self.numbers.std(0) + SPREAD)
        lent = self.numbers[rng.integers(0, size, (count, steps)), np.arange(steps)]
        kinds = rng.integers(0, 3, (count, 1, 1))
        made = np.choose(kinds, [new, np.clip(old + noise, 0, 1), lent])
        kept = np.where(rng.random(count) < 0.8, self.stops[parents], stops)
        return np.where(inside, made, old), kept


class EscapeSearch:
    """The search along a failing simulation with some decisions, in batches of `lanes` forks."""

    def __init__(
        self, means: Means, forks: Fork, decisions: int, lanes: int, rounds: int, seed: int
    ) -> None:
        self.means, self.forks, self.count = means, forks, decisions
        self.lanes, self.rounds, self.rng = lanes, rounds, np.random.default_rng(seed)
        self.tried: dict[int, Proposals] = {}
        self.found: dict[int, Choice] = {}
        self.alone: dict[int, tuple[Trace, float]] = {}
        self.simulations, self.notes, self.lost = 0, list[str](), list[int]()
        self.climbs = means.shape[1] > 0 and not all(means.levels)

    def bracket(self) -> tuple[int, int]:
        """Return the last instant with an escape, -1 without one, and the next one tried."""
        low, high, entries = -1, self.count, self.means.shape[1]
        while True:
            while high - low > 1:
                spread = min(INSTANTS if entries else self.count, high - low - 1)
                tried = np.linspace(low + 1, high - 1, spread).round().astype(int)
                low = max([low, *self.explore(np.unique(tried).tolist())])
                high = min((i for i in tried.tolist() if i > low), default=high)
            # No escape at one instant says nothing of later ones: search some again, longer.
            later = [high + by for by in FURTHER if high + by < self.count]
            if not entries or not self.explore(later, 2):
                return low, high
            low = max(self.alone)
            high = min((i for i in self.tried if i > low), default=self.count)

    def explore(self, instants: Sequence[int], effort: int = 1) -> list[int]:
        """Return the instants with an escape that a simulation alone confirms."""
        for instant in instants:
            self._begin(instant, effort)
        for number in range(self.rounds * effort if self.means.shape[1] else 1):
            # An escape from a later instant is one from all before it.
            latest = max((i for i in instants if i in self.found), default=-1)
            left = [i for i in instants if i > latest]
            if not left:
                break
            share = max(self.lanes // len(left), 1)
            drawn = [self.tried[i].next(share) for i in left]
            rho, escaped = self.judge(
                np.repeat(left, share), *map(np.concatenate, zip(*drawn, strict=True))
            )
            for n, (instant, plans) in enumerate(zip(left, drawn, strict=True)):
                mine = slice(n * share, (n + 1) * share)
                self.tried[instant].learn(plans, rho[mine])
                if escaped[mine].any():
                    i = int(np.argmax(np.where(escaped[mine], rho[mine], -np.inf)))
                    self.found[instant] = _choice(instant, plans[0][i], plans[1][i])
            if self.climbs and number % 2:
                self._climb([self.tried[i] for i in left if i not in self.found])
        return [i for i in instants if i in self.found and self._confirmed(i)]

    def judge(
        self, starts: Int[np.ndarray, " n"], *plans: Any
    ) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """Return the least robustness of each fork, and whether it escapes."""
        rho, escaped = np.zeros(len(starts)), np.zeros(len(starts), bool)
        for begin in range(0, len(starts), self.lanes):
            some = slice(begin, begin + self.lanes)
            packed = self._packed(self.lanes, starts[some], *(part[some] for part in plans))
            judged = escaping(*map(np.asarray, self.means.judge(self.forks, *packed)))
            rho[some], escaped[some] = (part[: len(starts) - begin] for part in judged)
        self.simulations += len(starts)
        count_done(len(starts))
        if self.means.constraint is not None and len(starts):
            escaped &= np.asarray(self.means.constraint(np.float32(plans[0][:, 0])))
        return rho, escaped

    def _packed(self, lanes: int, *parts: np.ndarray) -> tuple[Any, Choice]:
        full = (np.resize(part, (lanes, *part.shape[1:])) for part in parts)
        return np.int32(parts[0].min() * self.means.period), _choice(*full)

    def _begin(self, instant: int, effort: int) -> None:
        """Let the best choices of the nearest instants wait, as they are and shifted."""
        order = lambda other: (other.start not in self.found, abs(other.start - instant))  # noqa: E731
        near, steps = sorted(self.tried.values(), key=order)[:8], self.means.shape[0]
        mine = self.tried.setdefault(instant, Proposals(self.means, instant, self.rng))
        for other in near:
            for by in dict.fromkeys((0, (instant - other.start) * (steps > 1))):
                moved = other.numbers[:8, np.clip(np.arange(steps) - by, 0, steps - 1)]
                stops = np.clip(other.stops[:8] + by, min(instant + 1, steps), steps)
                mine.waiting.append((moved, stops))
        if effort > 1 and all(self.means.levels) and isinstance(self.means, Controls):
            mine.waiting.append(self._distinct(instant, self.means))

    def _distinct(self, instant: int, controls: Controls) -> Plans:
        """Return plans of whole-number actions to distinct states, a beam of the best so far."""
        each = np.meshgrid(*[(np.arange(n) + 0.5) / n for n in controls.levels])
        each = np.stack(each, -1).reshape(-1, controls.shape[1])
        plans, width = np.zeros((1, *controls.shape)), max(self.lanes // len(each), 1)
        index = np.full(1, instant * controls.period)
        now = jax.tree.map(lambda leaf: np.asarray(leaf)[index], self.forks.samples)
        states = jax.tree.map(np.asarray, (self.forks.at(index).state, now, now))
        for decision in range(instant, controls.shape[0]):
            plans = np.repeat(plans, len(each), axis=0)
            plans[:, decision] = np.tile(each, (len(plans) // len(each), 1))
            lanes = np.resize(np.arange(len(plans)), width * len(each))
            before = jax.tree.map(partial(np.take, indices=lanes // len(each), axis=0), states)
            given = np.int32(decision), before, plans[lanes, decision]
            after, rho = jax.tree.map(np.asarray, controls.advance(self.forks, *given))
            # The first link remembers the last action alone.
            seen = jax.tree.leaves((after[0]._replace(links=after[0].links[1:]), *after[1:]))
            rows = np.concatenate([np.reshape(leaf, (len(lanes), -1)) for leaf in seen], axis=1)
            kept = np.unique(rows[: len(plans)], axis=0, return_index=True)[1]
            kept = self.rng.permutation(kept)
            kept = kept[np.argsort(-rho[kept], kind="stable")][:width]
            plans, states = plans[kept], jax.tree.map(partial(np.take, indices=kept, axis=0), after)
        return plans, np.full(len(plans), controls.shape[0])

    def _climb(self, proposals: Sequence[Proposals]) -> None:
        """Let steps along gradients wait, from the best choices of each instant."""
        chosen = [(p, k) for p in proposals for k in np.flatnonzero(np.isfinite(p.rho[:CLIMBED]))]
        if not chosen:
            return
        starts, stops, rho = np.array([(p.start, p.stops[k], p.rho[k]) for p, k in chosen]).T
        numbers = np.stack([p.numbers[k] for p, k in chosen])
        packed = self._packed(INSTANTS * CLIMBED, starts, numbers, stops)
        try:
            temperature = max(0.05 * float(np.median(np.abs(rho))), 1e-6)
            slopes = self.means.climb(self.forks, *packed, temperature).numbers
        except Exception as error:
            self.climbs = False
            self.notes.append(f"searched without gradients: {format_error(error)}")
            return
        self.simulations += len(chosen)
        for (mine, k), slope in zip(chosen, np.nan_to_num(np.asarray(slopes)), strict=False):
            if (size := np.abs(slope).max()) > 0:
                steps = [s * move for move in (slope / size, np.sign(slope)) for s in STEPS]
                tried = np.clip(mine.numbers[k] + np.stack(steps), 0, 1)
                mine.waiting.append((tried, np.full(len(tried), mine.stops[k])))

    def _confirmed(self, instant: int) -> bool:
        """Simulate an escape alone, with the earliest stop after which the policy may go on."""
        found, tried = self.found.pop(instant), []
        stops = np.arange(instant + 1, int(found.stop) if self.means.ends else 0)
        numbers = np.repeat(np.asarray(found.numbers)[None], len(stops), axis=0)
        escaped = self.judge(np.full(len(stops), instant), numbers, stops)[1]
        if escaped.any():
            tried = [found._replace(stop=np.int32(stops[np.argmax(escaped)]))]
        for choice in (*tried, found):
            verdict, trace = self.means.alone(self.forks, choice)
            rho, kept = escaping(*(np.asarray(part)[None] for part in verdict))
            if kept[0]:
                self.found[instant] = choice
                self.alone[instant] = jax.tree.map(np.asarray, trace), float(rho[0])
                return True
        self.lost.append(instant)
        return False


def _choice(start: Any, numbers: Any, stop: Any) -> Choice:
    return Choice(np.int32(start), jnp.asarray(numbers, float), np.int32(stop))  # pyright: ignore


def escaping(
    rho: Float[np.ndarray, "n formulas"], status: Int[np.ndarray, " n"],
    holds: Bool[np.ndarray, "n formulas"],
) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:  # fmt: skip
    """Return the least robustness, minus infinity without one, and which keep all formulas."""
    lowest = np.nan_to_num(rho.min(1), nan=-np.inf)
    kept = (status == Status.OK) & ~violations(rho, status, lambda: holds)
    return lowest, kept & (lowest > -np.inf)


def first_proved(
    search: EscapeSearch, controls: Controls, begin: int, precision: str, seconds: float
) -> tuple[int | None, str]:
    """Return the earliest decision from which no action helps, None and why without a proof."""
    end, proved, high = time.process_time() + seconds, None, search.count
    try:
        while begin < high and time.process_time() < end:
            # What is certain from an instant is certain from all later ones.
            middle = (begin + high) // 2
            prove = _by_trying if controls.levels[0] else _by_sets
            if prove(search, controls, middle, precision):
                proved = high = middle
            else:
                begin = middle + 1
    except Exception as error:
        return proved, f"without a proof: {format_error(error)}" * (proved is None)
    return proved, "no proof: sets are too wide, or sequences too many" * (proved is None)


def _by_sets(search: EscapeSearch, controls: Controls, start: int, precision: str) -> bool:
    """Return whether all actions from a decision on certainly break a formula."""
    problem, (steps, entries) = controls.problem, controls.shape
    index, forks = start * controls.period, search.forks

    def system(features: Any, key: Any = None) -> Trace:
        later = features["actions"].reshape(steps - start, entries)
        numbers = jnp.concatenate([jnp.zeros((start, entries), later.dtype), later])
        choice = Choice(jnp.int32(start), numbers, jnp.int32(steps))
        fork = controls.fork(forks.at(index), choice)
        rollout = controls.system.rollout(fork.features, fork.key)
        rest = lambda state, k: rollout.sample(state, k + index)  # noqa: E731
        last, samples = rollout.scan(rest, fork.state, rollout.length - index)
        whole = {n: jnp.concatenate([forks.samples[n][:index], s]) for n, s in samples.items()}
        return rollout.ended(last, whole)

    unit = Box(0, 1) if entries == 1 else Box([0] * entries, [1] * entries)
    space = FeatureSpace({"actions": Array(unit, steps - start)})
    rest = Problem(problem.name, space, system, dict(problem.formulas), end=problem.end)
    bounds = Enclosure(rest, precision)(np.zeros((1, space.dim)), np.ones((1, space.dim)))
    return bool(bounds.high[0] < 0)


def _by_trying(search: EscapeSearch, controls: Controls, start: int, _: str) -> bool:
    """Return whether all sequences of whole-number actions fail; False if there are too many."""
    (steps, entries), left = controls.shape, controls.shape[0] - start
    if math.prod(controls.levels) ** left > MAX_BATCHES * search.lanes:
        return False
    each = [[(k + 0.5) / n for k in range(n)] for n in controls.levels] * left
    plans = np.array(list(itertools.product(*each))).reshape(-1, left, entries)
    plans = np.pad(plans, ((0, 0), (start, 0), (0, 0)))
    count = len(plans)
    return not search.judge(np.full(count, start), plans, np.full(count, steps))[1].any()
