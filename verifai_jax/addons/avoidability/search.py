"""The search for escapes: thousands of forks of one simulation in a batch, from many instants.

    search = EscapeSearch(Programs(problem, means), forks, lanes=2048, rounds=12, seed=0)
    search.explore([10, 20, 30])                        # instants at which an escape was found
    search.found[20]                                    # the best of them

One program judges forks from all instants, and one differentiates them.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from verifai_jax.addons.avoidability.means import Choice, Controls, Means
from verifai_jax.addons.avoidability.proposals import Numbers, Proposals, Stops
from verifai_jax.core.display.progress import count_done
from verifai_jax.core.messages.text import format_error
from verifai_jax.core.values.trace import Status, Trace
from verifai_jax.evaluation.verdicts import boolean_semantics, trace_verdict, violations
from verifai_jax.mtl import smooth
from verifai_jax.problem.problem import Problem
from verifai_jax.systems.forks import Fork

CLIMBED = 4
"""Choices of an instant that are improved by their gradients in a round."""
STEPS = (0.5, 0.15, 0.05, 0.015, 0.005)
"""Lengths of a step along a gradient, as shares of the range of an action."""


class Programs:
    """The compiled programs of a problem and some means, for all simulations of the problem."""

    def __init__(self, problem: Problem, means: Means) -> None:
        self.problem, self.means = problem, means
        self.course = jax.jit(means.course)
        self.judge = jax.jit(jax.vmap(self._judged, in_axes=(None, None, 0)))
        slope = jax.grad(self._objective, argnums=2, allow_int=True)
        self.climb = jax.jit(jax.vmap(slope, in_axes=(None, None, 0, None)))
        self.alone = jax.jit(self._alone)
        self.advance = jax.jit(jax.vmap(self._advanced, in_axes=(None, None, 0, 0)))

    def _trace(self, forks: Fork, first: Int[Array, ""], choice: Choice) -> Trace:
        fork = self.means.fork(forks.at(choice.start * self.means.period), choice)
        return self.means.system.go_on(fork, first)

    def _verdict(self, trace: Trace) -> Any:
        return *trace_verdict(self.problem, trace), boolean_semantics(self.problem, trace)

    def _judged(self, forks: Fork, first: Int[Array, ""], choice: Choice) -> Any:
        return self._verdict(self._trace(forks, first, choice))

    def _objective(self, forks: Fork, first: Any, choice: Choice, temperature: Any) -> Any:
        trace = self._trace(forks, first, choice)
        return jnp.min(trace_verdict(self.problem, trace, smooth(temperature))[0])

    def _alone(self, forks: Fork, choice: Choice) -> Any:
        trace = self.means.replayed(forks, choice)
        return self._verdict(trace), trace

    def _advanced(self, forks: Fork, decision: Any, state: Any, numbers: Any) -> Any:
        """Return the state one decision later, and the extremes of all signals so far."""
        plan = Choice(jnp.int32(0), jnp.broadcast_to(numbers, self.means.shape), decision + 1)
        fork = self.means.fork(forks, plan)
        rollout = self.means.system.rollout(fork.features, forks.key)
        loop, low, high = state
        for k in range(self.means.period):
            loop, signals = rollout.sample(loop, decision * self.means.period + k)
            low = jax.tree.map(jnp.minimum, low, signals)
            high = jax.tree.map(jnp.maximum, high, signals)
        return loop, low, high


class EscapeSearch:
    """The search along one failing simulation; see the module's docstring.

    **Arguments:**
    - `forks`: all forks of the simulation.
    - `lanes`: forks in a batch; `rounds`: batches for some instants.

    `simulations` counts the forks that went on; `notes` has sentences for the user.
    """

    def __init__(self, programs: Programs, forks: Fork, lanes: int, rounds: int, seed: int) -> None:
        self.programs, self.means, self.forks = programs, programs.means, forks
        self.lanes, self.rounds, self.rng = lanes, rounds, np.random.default_rng(seed)
        self.found: dict[int, Choice] = {}
        self.proposals: dict[int, Proposals] = {}
        self.simulations, self.notes = 0, list[str]()
        self.climbs = self.means.shape[1] > 0 and not all(self.means.levels)

    def judge(
        self, starts: Int[np.ndarray, " n"], numbers: Numbers, stops: Stops
    ) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """Return the least robustness of each fork, and whether it escapes."""
        parts = []
        for begin in range(0, len(starts), self.lanes):
            some = slice(begin, begin + self.lanes)
            packed = self._packed(starts[some], numbers[some], stops[some], self.lanes)
            parts.append(escaping(*map(np.asarray, self.programs.judge(self.forks, *packed))))
        rho, escaped = (np.concatenate(both)[: len(starts)] for both in zip(*parts, strict=True))
        self.simulations += len(starts)
        count_done(len(starts))
        if self.means.constraint is not None:
            escaped &= np.asarray(self.means.constraint(np.float32(numbers[:, 0])))
        return rho, escaped

    def _packed(self, starts: Any, numbers: Any, stops: Any, lanes: int) -> tuple[Any, Choice]:
        full = [np.resize(each, (lanes, *each.shape[1:])) for each in (starts, numbers, stops)]
        return np.int32(starts.min() * self.means.period), _choice(*full)

    def explore(self, instants: Sequence[int], effort: int = 1) -> list[int]:
        """Search for escapes from some instants, and return those from which one was found.

        **Arguments:**
        - `effort`: multiplies the number of rounds.
        """
        for instant in instants:
            self._begin(instant)
            if effort > 1 and all(self.means.levels) and isinstance(self.means, Controls):
                self.proposals[instant].waiting.append(self._distinct(instant, self.means))
        for number in range(self.rounds * effort if self.means.shape[1] else 1):
            # An escape from a later instant is one from all before it.
            latest = max((i for i in instants if i in self.found), default=-1)
            left = [i for i in instants if i > latest]
            if not left:
                break
            share = max(self.lanes // len(left), 1)
            drawn = [self.proposals[i].next(share) for i in left]
            numbers, stops = (np.concatenate(both) for both in zip(*drawn, strict=True))
            rho, escaped = self.judge(np.repeat(left, share), numbers, stops)
            for n, instant in enumerate(left):
                mine = slice(n * share, (n + 1) * share)
                self.proposals[instant].learn(numbers[mine], stops[mine], rho[mine])
                if escaped[mine].any():
                    i = n * share + int(np.argmax(np.where(escaped[mine], rho[mine], -np.inf)))
                    self.found[instant] = _choice(instant, numbers[i], stops[i])
            if self.climbs and number % 2:
                self._climb([self.proposals[i] for i in left if i not in self.found])
        return [i for i in instants if i in self.found]

    def _begin(self, instant: int) -> None:
        """Let the best choices of the nearest instants wait, as they are and shifted."""
        order = lambda other: (other.start not in self.found, abs(other.start - instant))  # noqa: E731
        near, steps = sorted(self.proposals.values(), key=order)[:8], self.means.shape[0]
        mine = self.proposals.setdefault(instant, Proposals(self.means, instant, self.rng))
        for other in near:
            by, numbers, stops = instant - other.start, other.numbers[:8], other.stops[:8]
            mine.waiting.append((numbers, np.clip(stops, min(instant + 1, steps), steps)))
            if steps > 1 and by:
                shifted = numbers[:, np.clip(np.arange(steps) - by, 0, steps - 1)]
                mine.waiting.append((shifted, np.clip(stops + by, instant + 1, steps)))

    def _distinct(self, instant: int, controls: Controls) -> tuple[Numbers, Stops]:
        """Return sequences of whole-number actions that lead to distinct states, breadth first."""
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
            after = jax.tree.map(np.asarray, self.programs.advance(self.forks, *given))
            # The first link remembers the last action alone.
            seen = jax.tree.leaves((after[0]._replace(links=after[0].links[1:]), *after[1:]))
            rows = np.concatenate([np.reshape(leaf, (len(lanes), -1)) for leaf in seen], axis=1)
            kept = np.unique(rows[: len(plans)], axis=0, return_index=True)[1]
            kept = self.rng.permutation(kept)[:width]
            plans, states = plans[kept], jax.tree.map(partial(np.take, indices=kept, axis=0), after)
        return plans, np.full(len(plans), controls.shape[0])

    def _climb(self, proposals: Sequence[Proposals]) -> None:
        """Let steps along gradients wait, from the best choices of each instant."""
        lanes = 16 * CLIMBED
        chosen = [(p, k) for p in proposals for k in range(CLIMBED) if k < len(p.rho)]
        chosen = [(p, k) for p, k in chosen if np.isfinite(p.rho[k])]
        for begin in range(0, len(chosen), lanes):
            some = chosen[begin : begin + lanes]
            starts, stops = np.array([(p.start, p.stops[k]) for p, k in some]).T
            numbers = np.stack([p.numbers[k] for p, k in some])
            temperature = max(0.05 * float(np.median([abs(p.rho[k]) for p, k in some])), 1e-6)
            packed = self._packed(starts, numbers, stops, lanes)
            try:
                slopes = self.programs.climb(self.forks, *packed, temperature).numbers
            except Exception as error:
                self.climbs = False
                self.notes.append(f"searched without gradients: {format_error(error)}")
                return
            slopes = np.nan_to_num(np.asarray(slopes)[: len(some)])
            self.simulations += len(some)
            for (mine, _), here, slope, stop in zip(some, numbers, slopes, stops, strict=True):
                if (size := np.abs(slope).max()) > 0:
                    steps = [s * move for move in (slope / size, np.sign(slope)) for s in STEPS]
                    tried = np.clip(here + np.stack(steps), 0, 1)
                    mine.waiting.append((tried, np.full(len(tried), stop)))


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
