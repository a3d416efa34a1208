"""The laws of a search."""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from verifai_jax.core.values.clauses import ABSENT, CLAUSES, OUTCOME
from verifai_jax.core.values.cube import Cube
from verifai_jax.search import Observations, Search
from verifai_jax.testing.laws import same, same_type

State = TypeVar("State")


def check_search(
    search: Search, cube: Cube, *, batch: int = 16, rounds: int = 4, seed: int = 0
) -> None:
    """Check the contract of a search on one cube, on a quadratic robustness with failures.

    **Arguments:**
    - `search`: the search to check.
    - `cube`: the cube that it searches.
    - `batch`: number of points in a round.
    - `rounds`: number of rounds.
    - `seed`: the seed of its random key.
    **Raises:** `AssertionError` naming the broken law.
    """
    search.check(cube)
    hash(search)
    total = search.total(cube)
    assert total is None or (isinstance(total, int) and total >= 1), (
        f"total must be None or a positive integer; got {total!r}"
    )
    init = jax.jit(search.init, static_argnums=(1, 2))
    ask = jax.jit(search.ask, static_argnums=(1, 2))
    tell = jax.jit(search.tell, static_argnums=1)
    # One that is inherited is `tell`, which need not be compiled twice.
    inherited = type(search).warm_start is Search.warm_start
    warm = tell if inherited else jax.jit(search.warm_start, static_argnums=1)
    key = jax.random.key(seed)
    odd = np.arange(batch) % 3 == 1

    def run(
        state: PyTree, first: int, last: int, spoil: float | None = None
    ) -> tuple[PyTree, list[np.ndarray]]:
        points = []
        for _ in range(first, last):
            u, pending = ask(state, cube, batch)
            assert u.shape == (batch, cube.dim), (
                f"ask must give shape {[batch, cube.dim]}; got {list(u.shape)}"
            )
            assert u.dtype == jnp.float32, f"ask must give float32; got {u.dtype}"
            assert bool(jnp.all((u >= 0) & (u <= 1))), "points must stay in [0, 1]"
            if search.wants.gradient:
                tau = search.temperature(pending)
                assert tau.shape == (), f"temperature must be a scalar; got shape {tau.shape}"
                assert bool(tau > 0), f"temperature must be positive; got {tau}"
            observations = _evaluate(u, search, pending, cube)
            if spoil is not None:
                observations = _spoiled(observations, odd, spoil)
            state = tell(pending, cube, observations)
            same_type(pending, state)
            points.append(np.asarray(u))
        return state, points

    state = init(key, cube, batch)
    middle, before = run(state, 0, rounds // 2)
    _, after = run(middle, rounds // 2, rounds)
    whole = before + after
    _, again = run(init(key, cube, batch), 0, rounds)
    same(whole, again, "the same key must give the same points", exact=True)
    _, resumed = run(_saved(middle), rounds // 2, rounds)
    same(after, resumed, "a resumed state must go on as the saved one", exact=True)
    spoiled = [run(state, 0, rounds, value)[1] for value in (-1e9, np.nan)]
    law = "rows that are not valid must not influence the search"
    same(spoiled[0], spoiled[1], law, exact=True)
    for points in spoiled[0]:
        assert np.all(np.isfinite(points)), "points must be finite"
    # What a constraint does: some rows are those of the second proposals, some stay refused.
    first, pending = ask(state, cube, batch)
    second, pending = ask(pending, cube, batch)
    mixed = _evaluate(jnp.where(odd[:, None], second, first), search, pending, cube)
    refused = mixed._replace(valid=mixed.valid & (np.arange(batch) % 4 != 0))
    after = tell(pending, cube, refused)
    same_type(pending, after)
    earlier = jax.random.uniform(jax.random.key(seed + 1), (batch, cube.dim), jnp.float32)
    rho = _evaluate(earlier, search, pending, cube).rho
    warmed = warm(state, cube, Observations(earlier, rho, jnp.ones(batch, bool)))
    same_type(state, warmed, "warm_start")
    for beginning in (after, warmed):
        for points in run(beginning, 0, 2)[1]:
            assert np.all(np.isfinite(points)), "points must be finite"


def check_batch_independence(search: Search, cube: Cube, *, points: int = 48) -> None:
    """Check that a passive search gives the same points whatever the batch size is.

    **Arguments:**
    - `search`: the search to check.
    - `cube`: the cube that it searches.
    - `points`: number of points to compare.
    **Raises:** `AssertionError` if it does not.
    """
    sequences = []
    for batch in (points, points // 3, 5):
        state, parts = search.init(jax.random.key(1), cube, batch), []
        while sum(map(len, parts)) < points:
            u, state = search.ask(state, cube, batch)
            state = search.tell(state, cube, _evaluate(u, search, state, cube))
            parts.append(np.asarray(u))
        sequences.append(np.concatenate(parts)[:points])
    for other in sequences[1:]:
        same(sequences[0], other, "points must not depend on the batch size", exact=True)


def _evaluate(u: Array, search: Search, pending: PyTree, cube: Cube) -> Observations:
    """Evaluate a quadratic with its minimum and failures off the centre, as the search wants."""
    offset = u - 0.3
    rho, gradient = jnp.sum(offset**2, axis=1) - 0.01, 2 * offset
    valid = jnp.ones(len(u), bool)
    observations = Observations(u, rho, valid, gradient if search.wants.gradient else None)
    if search.wants.coverage_ids:
        # What is covered depends on the first coordinate, and some rows cover less.
        first = (u[:, :1] * 5).astype(jnp.int32) if cube.dim else jnp.zeros((len(u), 1), jnp.int32)
        coverage_ids = jnp.concatenate([first, jnp.where(rho[:, None] < 0, 7, -1)], axis=1)
        observations = observations._replace(coverage_ids=coverage_ids)
    if search.wants.outcomes:
        # One of two predicates decides, and the shape follows the first coordinate.
        first = u[:, :1] if cube.dim else jnp.zeros((len(u), 1), jnp.float32)
        shape = jnp.broadcast_to(first, (len(u), OUTCOME - 2))
        outcomes = jnp.concatenate([jnp.round(first), 0.5 * first, shape], axis=1)
        observations = observations._replace(outcomes=outcomes)
    if not search.wants.clauses:
        return observations
    plan = search.plan(pending, cube, len(u))
    assert plan.temperature.shape == (len(u),), (
        f"the plan must have a temperature for each row; got shape {plan.temperature.shape}"
    )
    assert 1 <= int(plan.rows) <= len(u), (
        f"the plan must be for 1 to {len(u)} rows; got {plan.rows}"
    )
    assert search.wants.clause_gradients or not bool(plan.differentiate), (
        "a plan may differentiate only where the search wants clause_gradients"
    )
    clauses = jnp.full((len(u), CLAUSES), ABSENT).at[:, 0].set(rho)
    gradients = jnp.zeros((len(u), CLAUSES, cube.dim)).at[:, 0].set(gradient)
    return observations._replace(
        valid=jnp.arange(len(u)) < plan.rows,
        clauses=clauses,
        clause_gradients=jnp.where(plan.differentiate, gradients, 0.0),
    )


def _spoiled(observations: Observations, rows: np.ndarray, value: float) -> Observations:
    def spoil(leaf: Array | None) -> Any:
        if leaf is None:
            return None
        return jnp.where(rows.reshape(-1, *(1,) * (leaf.ndim - 1)), value, leaf)

    return observations._replace(
        rho=spoil(observations.rho),
        valid=observations.valid & ~rows,
        gradient=spoil(observations.gradient),
        clauses=spoil(observations.clauses),
        clause_gradients=spoil(observations.clause_gradients),
    )


def _saved(state: State) -> State:
    """Return the state after a detour through plain NumPy arrays."""

    def detour(leaf: Array) -> Array:
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            data = np.array(jax.random.key_data(leaf))
            return jax.random.wrap_key_data(jnp.asarray(data), impl=jax.random.key_impl(leaf))
        return jnp.asarray(np.array(leaf))

    return jax.tree.map(detour, state)
