"""Many seeds of a search that plans its rounds, side by side: for `trials.repeat`.

Such a search asks for slopes in some rounds only, each seed in its own. A program of whole rounds
would have to differentiate every simulation; here the points of all seeds that want the same go
together, and the loop is on the host.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from verifai_jax.core.clauses import CLAUSES
from verifai_jax.core.devices import enable_compile_cache, spread_over_devices
from verifai_jax.core.keys import run_keys, simulation_key
from verifai_jax.core.trace import Status
from verifai_jax.evaluation.engine import Engine
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Observations, Search

VALUES_AT_ONCE, SLOPES_AT_ONCE = 256, 64


def lockstep(
    problem: Problem,
    search: Search,
    seeds: Any,
    budget: int,
    batch: int,
    precision: str,
    stop_early: bool,
) -> tuple[
    Float[np.ndarray, "seeds simulations"],
    Bool[np.ndarray, "seeds simulations"],
    Float[np.ndarray, "seeds d"],
]:
    """Robustness of each seed's simulations, which were differentiated, and the first failures.

    NaN where there was no simulation, or no failure.
    A seed that has found a failure makes no further simulation if `stop_early`.
    """
    cube, n = problem.space.cube, len(seeds)
    keys = [run_keys(int(seed)) for seed in seeds]
    simulation_keys = jnp.stack([key for _, key in keys])
    start, ask, tell = _search_program(problem, search, batch)
    state = start(jnp.stack([key for key, _ in keys]))
    evaluate = {
        slopes: _simulations(problem, slopes, min(n * batch, most), precision)
        for slopes, most in ((False, VALUES_AT_ONCE), (True, SLOPES_AT_ONCE))
    }
    found: list[list[float]] = [[] for _ in range(n)]
    flags: list[list[bool]] = [[] for _ in range(n)]
    failed = np.zeros(n, bool)
    points = np.full((n, cube.dim), np.nan, np.float32)
    while True:
        u, plan, state = ask(state)
        u, rows, slopes, temperature = map(
            np.asarray, (u, plan.rows, plan.differentiate, plan.temperature)
        )
        left = np.array([budget - len(each) for each in found])
        left[failed] *= not stop_early
        rows = np.minimum(rows, left)
        if not rows.any():
            break
        told = Observations(
            u=u,  # pyright: ignore[reportArgumentType]
            rho=np.full((n, batch), np.nan, np.float32),  # pyright: ignore[reportArgumentType]
            valid=np.zeros((n, batch), bool),  # pyright: ignore[reportArgumentType]
            clauses=np.zeros((n, batch, CLAUSES), np.float32),  # pyright: ignore[reportArgumentType]
            clause_gradients=np.zeros((n, batch, CLAUSES, cube.dim), np.float32),  # pyright: ignore[reportArgumentType]
        )
        asked = np.arange(batch) < rows[:, None]
        for kind in (False, True):
            who, row = np.nonzero(asked & (slopes == kind)[:, None])
            if not len(who):
                continue
            numbers = np.array([len(found[seed]) for seed in who]) + row
            result = evaluate[kind](
                u[who, row], simulation_keys, who, numbers, temperature[who, row]
            )
            told.rho[who, row] = result["rho"]  # pyright: ignore[reportIndexIssue]
            told.valid[who, row] = result["status"] == Status.OK  # pyright: ignore[reportIndexIssue]
            told.clauses[who, row] = result["clauses"]  # pyright: ignore[reportOptionalSubscript]
            if kind:
                told.clause_gradients[who, row] = result["slopes"]  # pyright: ignore[reportOptionalSubscript]
        for seed in range(n):
            found[seed].extend(told.rho[seed, : rows[seed]].tolist())
            flags[seed].extend([bool(slopes[seed])] * int(rows[seed]))
            below = np.flatnonzero(np.asarray(told.rho[seed, : rows[seed]]) < 0)
            if len(below) and not failed[seed]:
                failed[seed], points[seed] = True, u[seed, below[0]]
        state = tell(state, told)
    longest = max(map(len, found))
    rho = np.full((n, longest), np.nan, np.float32)
    differentiated = np.zeros((n, longest), bool)
    for seed in range(n):
        rho[seed, : len(found[seed])] = found[seed]
        differentiated[seed, : len(flags[seed])] = flags[seed]
    return rho, differentiated, points


def _search_program(problem: Problem, search: Search, batch: int) -> Any:
    kind = ("lockstep", search, batch)
    if kind not in problem.engines:
        cube = problem.space.cube

        def ask(state: Any) -> Any:
            u, state = search.ask(state, cube, batch)
            return u, search.plan(state, cube, batch), state

        problem.engines[kind] = (
            jax.jit(jax.vmap(lambda key: search.init(key, cube, batch))),
            jax.jit(jax.vmap(ask)),
            jax.jit(jax.vmap(lambda state, told: search.tell(state, cube, told))),
        )
    return problem.engines[kind]


def _simulations(problem: Problem, slopes: bool, most: int, precision: str) -> Any:
    """A function that simulates any number of points, each with the key of its seed and number."""
    kind = ("lockstep simulations", slopes, most, precision)
    if kind in problem.engines:
        return problem.engines[kind]
    engine = Engine(problem, most, slopes, precision=precision, clauses=True)
    devices = jax.local_devices()[: max(1, min(len(jax.local_devices()), most))]
    size = -(-most // len(devices)) * len(devices)

    def one(u: Any, key: Any, number: Any, temperature: Any) -> Any:
        row = engine.told_row(u, simulation_key(key, number), temperature)._asdict()
        return {name: value for name, value in row.items() if value is not None}

    program = spread_over_devices(jax.vmap(one), (True,) * 4, devices)
    compiled: list[Any] = []

    def simulate(u: Any, keys: Any, who: Any, numbers: Any, temperature: Any) -> Any:
        parts = []
        for first in range(0, len(u), size):
            rows = np.minimum(np.arange(first, first + size), len(u) - 1)
            arguments = (
                u[rows],
                keys[who[rows]],
                numbers[rows].astype(np.int32),
                temperature[rows],
            )
            if not compiled:
                enable_compile_cache()
                lowered = engine.differentiable(
                    lambda a=arguments: jax.jit(partial(program)).lower(*a)
                )
                compiled.append(lowered.compile())
            parts.append(jax.tree.map(np.asarray, compiled[0](*arguments)))
        return {name: np.concatenate([part[name] for part in parts])[: len(u)] for name in parts[0]}

    problem.engines[kind] = simulate
    return simulate
