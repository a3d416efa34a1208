"""Proofs that no action avoids a failure: by sets of numbers, or by trying all sequences."""

import itertools
import math
import time
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from verifai_jax.addons.avoidability.means import Choice, Controls
from verifai_jax.addons.avoidability.search import EscapeSearch
from verifai_jax.addons.verification.enclosure import Enclosure
from verifai_jax.core.messages.text import format_error
from verifai_jax.core.values.trace import Trace
from verifai_jax.features import Array, Box, FeatureSpace
from verifai_jax.problem.problem import Problem

MAX_BATCHES = 16
"""Batches of sequences of whole-number actions that are tried from an instant, at most."""


def first_proved(
    search: EscapeSearch, controls: Controls, low: int, high: int, precision: str, seconds: float
) -> tuple[int | None, str]:
    """Return the earliest instant from `low` to before `high` from which no action helps.

    **Returns:** the instant, None without a proof, and then the reason.
    """
    end, proved, begin = time.perf_counter() + seconds, None, low
    try:
        while begin < high and time.perf_counter() < end:
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
    problem, (steps, entries) = search.programs.problem, controls.shape
    index, forks = start * controls.period, search.forks

    def system(features: Mapping[str, Any], key: Any = None) -> Trace:
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


def _by_trying(search: EscapeSearch, controls: Controls, start: int, precision: str) -> bool:
    """Return whether all sequences of whole-number actions fail; False if there are too many."""
    (steps, entries), left = controls.shape, controls.shape[0] - start
    if math.prod(controls.levels) ** left > MAX_BATCHES * search.lanes:
        return False
    each = [[(k + 0.5) / n for k in range(n)] for n in controls.levels] * left
    plans = np.array(list(itertools.product(*each))).reshape(-1, left, entries)
    plans = np.pad(plans, ((0, 0), (start, 0), (0, 0)))
    count = len(plans)
    return not search.judge(np.full(count, start), plans, np.full(count, steps))[1].any()
