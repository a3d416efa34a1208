"""Many seeds of a search that plans its rounds, run together for `repeat`.

Such a search needs derivatives only in some rounds, which differ between seeds. One program for
whole rounds would have to differentiate every simulation. So the loop runs on the host, and points
of all seeds with the same needs are simulated together.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.core.compute.compilation import Slot, options_of
from verifai_jax.core.compute.keys import run_keys, simulation_key
from verifai_jax.core.display.progress import count_done
from verifai_jax.core.values.clauses import CLAUSES
from verifai_jax.evaluation.engine import Engine
from verifai_jax.evaluation.raising import Raising
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.falsification.confirm_seeds import SeedConfirmer
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Observations, Search
from verifai_jax.search.repetition import Repetition
from verifai_jax.search.search_program import optimization_of

VALUES_AT_ONCE = 256
"""Simulations of one call without derivatives."""
DERIVATIVES_AT_ONCE = 64
"""Simulations of one call with derivatives, which need more memory each."""


class SeedHistories(NamedTuple):
    """The simulations of each seed, padded after its last one.

    - `rho`: the least robustness; NaN without a simulation or a verdict.
    - `violated`: whether the simulation violates the property.
    - `differentiated`: whether derivatives were taken.
    - `failures`: the first failing point of each seed in the unit cube; the first claimed one if
      closer replays were made; NaN without one.
    - `not_claimed`: whether closer replays reject a violating simulation.
    """

    rho: Float[np.ndarray, "seeds simulations"]
    violated: Bool[np.ndarray, "seeds simulations"]
    differentiated: Bool[np.ndarray, "seeds simulations"]
    failures: Float[np.ndarray, "seeds d"]
    not_claimed: Bool[np.ndarray, "seeds simulations"]


def lockstep(
    problem: Problem,
    search: Search,
    seeds: Int[np.ndarray, " seeds"],
    budget: int,
    batch: int,
    precision: str,
    stop_early: bool,
    claims: SeedConfirmer | None = None,
) -> SeedHistories:
    """Run the search from every seed and return the histories.

    With `stop_early` a seed that has found a failure makes no further simulation. With `claims`
    only claimed violations are failures, and the search observes all others as safe, as in
    `falsify`.

    **Raises:** `AlwaysRaises` if all of the first simulations raise the same error.
    """
    cube, n = problem.space.cube, len(seeds)
    keys = [run_keys(int(seed)) for seed in seeds]
    run_key = jnp.stack([key for _, key in keys])
    start, ask, tell = _search_programs(problem, search, batch)
    state = start(jnp.stack([key for key, _ in keys]))
    repetitions = [Repetition(cube, key) for key, _ in keys] if cube.dim else []
    engines = {
        kind: _engine(problem, kind, min(n * batch, maximum), precision)
        for kind, maximum in ((False, VALUES_AT_ONCE), (True, DERIVATIVES_AT_ONCE))
    }
    number_keys = jax.jit(jax.vmap(simulation_key))
    rho: list[list[float]] = [[] for _ in range(n)]
    violated: list[list[bool]] = [[] for _ in range(n)]
    refused: list[list[bool]] = [[] for _ in range(n)]
    differentiated: list[list[bool]] = [[] for _ in range(n)]
    failures = np.full((n, cube.dim), np.nan, np.float32)
    failed = np.zeros(n, bool)
    proposed, raising = np.zeros(n, int), Raising()
    while True:
        u, plan, state = ask(state)
        u, rows, wanted, temperature = map(
            np.asarray, (u, plan.rows, plan.differentiate, plan.temperature)
        )
        planned = rows
        left = np.array([budget - len(each) for each in rho])
        left[failed] *= not stop_early
        rows = np.minimum(rows, left)
        if not rows.any():
            break
        u, learned = u.copy(), u.copy()
        proposed += planned
        for seed, repetition in enumerate(repetitions):
            chosen = np.arange(batch) < planned[seed]
            number = int(proposed[seed])
            u[seed], learned[seed] = repetition.avoid(
                learned[seed], chosen, not wanted[seed], number
            )
            repetition.add(u[seed, : rows[seed]])
        values = np.full((n, batch), np.nan, np.float32)
        valid, broken = np.zeros((n, batch), bool), np.zeros((n, batch), bool)
        clauses = np.zeros((n, batch, CLAUSES), np.float32)
        clause_gradients = np.zeros((n, batch, CLAUSES, cube.dim), np.float32)
        simulates = np.arange(batch) < rows[:, None]
        for kind, engine in engines.items():
            seed, row = np.nonzero(simulates & (wanted == kind)[:, None])
            if not len(seed):
                continue
            numbers = np.array([len(rho[each]) for each in seed]) + row
            parts = []
            for first in range(0, len(seed), engine.batch):
                block = slice(first, first + engine.batch)
                # Always as many, so that one program makes the keys.
                index = np.minimum(np.arange(first, first + engine.padded), len(seed) - 1)
                own = number_keys(run_key[seed[index]], numbers[index].astype(np.int32))
                some = seed[block], row[block]
                parts.append(engine.evaluate(u[some], own, temperature=temperature[some]))
            count_done(len(seed))
            verdicts = Verdicts.concatenate(parts)
            raising.add(verdicts.status, verdicts.messages)
            raising.check(problem.name)
            values[seed, row], valid[seed, row] = verdicts.lowest, verdicts.proper
            broken[seed, row], clauses[seed, row] = verdicts.violated, verdicts.clauses
            if kind:
                clause_gradients[seed, row] = verdicts.clause_gradients
        simulated, unclaimed = values.copy(), np.zeros((n, batch), bool)
        if claims is not None:
            some = broken & ~(failed[:, None] & stop_early)
            seed, row = np.nonzero(some)
            numbers = np.array([len(each) for each in rho])[seed] + row
            found, greatest = claims(seed, numbers, u[some], values[some])
            unclaimed[some] = found
            values[some] = np.where(found, greatest, values[some])
            # Clauses that are broken no more, as `falsify` tells them.
            lift = np.where(found, 1e-6 - np.max(clauses[some], axis=-1), 0.0)
            clauses[some] += lift[:, None].astype(np.float32)
        for seed in range(n):
            count = int(rows[seed])
            rho[seed].extend(simulated[seed, :count].tolist())
            violated[seed].extend(broken[seed, :count].tolist())
            refused[seed].extend(unclaimed[seed, :count].tolist())
            differentiated[seed].extend([bool(wanted[seed])] * count)
            first = np.flatnonzero((broken & ~unclaimed)[seed, :count])
            if len(first) and not failed[seed]:
                failed[seed], failures[seed] = True, u[seed, first[0]]
        observations = Observations(
            u=jnp.asarray(learned),
            rho=jnp.asarray(values),
            valid=jnp.asarray(valid),
            clauses=jnp.asarray(clauses),
            clause_gradients=jnp.asarray(clause_gradients),
        )
        state = tell(state, observations)
    longest = max(map(len, rho))
    return SeedHistories(
        _filled(rho, longest, np.nan).astype(np.float32),
        _filled(violated, longest, False).astype(bool),
        _filled(differentiated, longest, False).astype(bool),
        failures,
        _filled(refused, longest, False).astype(bool),
    )


def _filled(rows: list[list[float]] | list[list[bool]], length: int, fill: float) -> np.ndarray:
    return np.array([[*row, *[fill] * (length - len(row))] for row in rows])


SEARCHES: Slot[tuple[Search, int], tuple[jax.stages.Wrapped, ...]] = Slot("searches of seeds")
"""Compiled `init`, `ask` with `plan`, and `tell` of all seeds, by (search, batch)."""
DERIVING: Slot[tuple[bool, int, str], Engine] = Slot("engines of seeds")
"""Engines whose rows have keys of their own, by (with derivatives, batch, precision)."""


def _search_programs(
    problem: Problem, search: Search, batch: int
) -> tuple[jax.stages.Wrapped, ...]:
    cube = problem.space.cube

    def ask(state):
        u, state = search.ask(state, cube, batch)
        return u, search.plan(state, cube, batch), state

    def make() -> tuple[jax.stages.Wrapped, ...]:
        # As for `falsify`: what is rounded otherwise may end up elsewhere.
        options = options_of(optimization_of(search, batch))
        compiled = partial(jax.jit, compiler_options=options)
        return (
            compiled(jax.vmap(lambda key: search.init(key, cube, batch))),
            compiled(jax.vmap(ask)),
            compiled(jax.vmap(lambda state, observations: search.tell(state, cube, observations))),
        )

    return problem.programs.get(SEARCHES, (search, batch), make)


def _engine(problem: Problem, derivatives: bool, batch: int, precision: str) -> Engine:
    make = partial(
        Engine, problem, batch, derivatives, precision=precision, clauses=True, own_keys=True
    )
    return problem.programs.get(DERIVING, (derivatives, batch, precision), make)
