"""Contract suites: run them on domains, searches and systems of your own.

    check_domain(MyDomain(...))                          # round trips, shapes, table columns
    check_search(MySearch(...), Cube((0, 0, 4)))         # init / ask / tell
    check_system(my_simulator, space)                    # one clock, same alone and in batches

Each raises `AssertionError` that says which law is broken.

    @given(strategy(space))                             # features for tests of Hypothesis
    def test_keeps_lane(features): ...
"""

import operator
from collections.abc import Mapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from verifai_jax.core.clauses import CLAUSES
from verifai_jax.core.cube import Cube
from verifai_jax.core.outcomes import OUTCOME
from verifai_jax.core.trace import Status, Trace
from verifai_jax.features import Domain, FeatureSpace
from verifai_jax.mtl.clauses import ABSENT
from verifai_jax.search import Observations, Search
from verifai_jax.systems.base import System, as_system
from verifai_jax.systems.blackbox._blackbox import plain_leaves

State = TypeVar("State")


def check_domain(domain: Domain, *, samples: int = 64, seed: int = 0) -> None:
    """Check the laws of a domain on random points and on the corners of its cube.

    **Arguments:**

    - `domain`: to check.
    - `samples`: number of random points.
    - `seed`: of the points.

    **Raises:** `AssertionError` naming the broken law.
    """
    size, levels = domain.size, np.array(domain.levels, int)
    assert size == len(levels), "size must be the number of levels"
    assert np.all(levels >= 0), f"levels must not be negative; got {levels.tolist()}"
    for name in ("weights", "ordered"):
        entries = getattr(domain, name)
        assert len(entries) == size, f"{name} must have {size} entries; got {len(entries)}"
    labels = domain.coordinates("value")
    assert len(set(labels)) == size, f"coordinates must be {size} different names; got {labels}"
    # Refuses weights that do not go with the levels, and lengths that are not discrete.
    cube = Cube(domain.levels, domain.weights, domain.ordered, labels, domain.lengths)
    u = jax.random.uniform(jax.random.key(seed), (samples, size), jnp.float32)
    u = jnp.concatenate([u, jnp.zeros((1, size)), jnp.ones((1, size))])

    def round_trip(u: Array) -> tuple[PyTree, Array, PyTree]:
        value = domain.from_unit(u)
        back = domain.to_unit(value)
        return value, back, domain.from_unit(back)

    both = jax.jit(jax.vmap(round_trip))
    values, back, again = both(u)
    assert back.shape == u.shape, f"to_unit must give shape [{size}]; got {list(back.shape[1:])}"
    assert bool(jnp.all((back >= 0) & (back <= 1))), "to_unit must stay in [0, 1]"
    _same(values, again, "from_unit(to_unit(value)) must be the value")
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(values)), (
        "values must be finite, at the corners of the cube too"
    )
    alone = jax.jit(domain.from_unit)
    for i in (0, 1, -1):
        value = jax.tree.map(operator.itemgetter(i), values)
        _same(value, alone(u[i]), "from_unit must give the same alone and under vmap")
    # With all lengths at their most, every coordinate matters.
    longest = u.at[:, list(domain.lengths)].set(1.0)
    np.testing.assert_allclose(
        np.asarray(both(longest)[1])[:, cube.discrete],
        cube.centres(cube.cells(longest)),
        atol=1e-6,
        err_msg="to_unit(from_unit(u)) must be the middle of the cell of u",
    )

    columns = domain.columns("value")
    rows = domain.to_columns(jax.tree.map(np.asarray, values), "value")
    assert tuple(rows) == columns, f"to_columns must give {columns}; got {tuple(rows)}"
    one = domain.to_columns(jax.tree.map(lambda leaf: np.asarray(leaf)[:1], values), "value")
    for name, column in rows.items():
        assert column.shape == (len(u),), f"column {name} must have shape [{len(u)}]"
        assert column.dtype == one[name].dtype, f"column {name} must have one dtype in all batches"
    for i in (0, 1, -2, -1):
        value = jax.tree.map(operator.itemgetter(i), values)
        row = {name: column[i] for name, column in rows.items()}
        stored = domain.from_columns(row, "value")
        _same(
            value, stored, "from_columns must give back exactly what to_columns stored", exact=True
        )
        domain.check(value, "value")
        _same(value, domain.coerce(value), "coerce must keep what from_unit gives", exact=True)


def check_search(
    search: Search, cube: Cube, *, batch: int = 16, rounds: int = 4, seed: int = 0
) -> None:
    """Check the contract of a search on one cube, on a quadratic robustness with failures.

    **Arguments:**

    - `search`: to check.
    - `cube`: that it searches.
    - `batch`: points in a round.
    - `rounds`: number of rounds.
    - `seed`: of its random key.

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
            _same_type(pending, state)
            points.append(np.asarray(u))
        return state, points

    state = init(key, cube, batch)
    middle, before = run(state, 0, rounds // 2)
    _, after = run(middle, rounds // 2, rounds)
    whole = before + after

    _, again = run(init(key, cube, batch), 0, rounds)
    _same(whole, again, "the same key must give the same points", exact=True)
    _, resumed = run(_saved(middle), rounds // 2, rounds)
    _same(after, resumed, "a resumed state must go on as the saved one", exact=True)

    spoiled = [run(state, 0, rounds, value)[1] for value in (-1e9, np.nan)]
    law = "rows that are not valid must not influence the search"
    _same(spoiled[0], spoiled[1], law, exact=True)
    for points in spoiled[0]:
        assert np.all(np.isfinite(points)), "points must be finite"

    # What a constraint does: some rows are those of the second proposals, some stay refused.
    first, pending = ask(state, cube, batch)
    second, pending = ask(pending, cube, batch)
    mixed = _evaluate(jnp.where(odd[:, None], second, first), search, pending, cube)
    refused = mixed._replace(valid=mixed.valid & (np.arange(batch) % 4 != 0))
    after = tell(pending, cube, refused)
    _same_type(pending, after)

    earlier = jax.random.uniform(jax.random.key(seed + 1), (batch, cube.dim), jnp.float32)
    rho = _evaluate(earlier, search, pending, cube).rho
    warmed = warm(state, cube, Observations(earlier, rho, jnp.ones(batch, bool)))
    _same_type(state, warmed, "warm_start")
    for beginning in (after, warmed):
        for points in run(beginning, 0, 2)[1]:
            assert np.all(np.isfinite(points)), "points must be finite"


def check_batch_independence(search: Search, cube: Cube, *, points: int = 48) -> None:
    """Check that a passive search gives the same points whatever the batch size is.

    **Arguments:**

    - `search`: to check.
    - `cube`: that it searches.
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
        _same(sequences[0], other, "points must not depend on the batch size", exact=True)


def check_system(
    system: Any, space: FeatureSpace, *, samples: int = 4, seed: int = 0, tolerance: float = 1e-5
) -> None:
    """Check the contract of a system on random features: pure, one clock, all its ways agree.

    **Arguments:**

    - `system`: to check, as `Problem` takes it.
    - `space`: of the features that it takes.
    - `samples`: number of random features.
    - `seed`: of features and keys.
    - `tolerance`: difference of signals between the ways to simulate, relative to their largest
      value.

    **Raises:** `AssertionError` naming the broken law.
    """
    points = jax.random.uniform(jax.random.key(seed), (samples, space.dim), jnp.float32)
    features = space.features_at(points)
    keys = jax.random.split(jax.random.key(seed), samples)
    each = [jax.tree.map(lambda leaf, i=i: np.asarray(leaf)[i], features) for i in range(samples)]
    system, forms = as_system(system), jax.eval_shape(space.unflatten, jnp.zeros(space.dim))
    system.check(forms)
    alone = [system(f, key) for f, key in zip(each, keys, strict=True)]
    for trace in alone:
        _check_trace(trace)
    for trace, f, key in zip(alone, each, keys, strict=True):
        _agree(trace, system(f, key), 0.0, "a system must give the same trace for the same key")
    if not system.black_box:
        batch: Any = jax.jit(jax.vmap(system))(features, keys)
        _agree_all(alone, batch, tolerance, "compiled under vmap, and called alone")
        if system.can_fold:
            _check_fold(system, features, keys, alone, tolerance)
    if system.can_simulate_batch and system.black_box:
        batch = system.simulate_batch(jax.tree.map(np.asarray, features), keys)
        _agree_all(alone, batch, tolerance, "in a batch, and called alone")
    if system.can_simulate_each:
        seeds = [int(seed) for seed in jax.vmap(jax.random.bits)(keys)]
        found = list(system.simulate_each([plain_leaves(f) for f in each], seeds))
        numbers = sorted(i for i, _ in found)
        assert numbers == list(range(samples)), (
            f"simulate_each must give each of {samples} indices once; got {numbers}"
        )
        for i, outcome in found:
            message = f"simulation {i} failed only in a batch: {outcome.message}"
            assert outcome.trace is not None, message
            _agree(alone[i], outcome.trace, tolerance, "one by one, and called alone")
    form = system.abstract(forms)
    if form is not None:
        shapes = {name: tuple(signal.shape) for name, signal in form.signals.items()}
        simulated = {name: np.shape(signal) for name, signal in alone[0].signals.items()}
        assert shapes == simulated, (
            f"abstract must give the signals' shapes {simulated}; got {shapes}"
        )


def strategy(space: FeatureSpace, nominal: Mapping[str, Any] | None = None) -> Any:
    """Return a strategy of Hypothesis for the features of a space, as a system sees them.

    Each unit coordinate is a number from 0 to 1 that Hypothesis draws, and the features are at that
    point, by the inverse of the cumulative distribution. Examples shrink towards `nominal`, and to
    few items of arrays of variable length, such as events; a constraint of the space holds in all
    of them.

        space = FeatureSpace({"x": Box(-1, 1), "n": DiscreteBox(0, 5)})

        @given(strategy(space, nominal={"x": 0, "n": 0}))
        def test_stays_near(features):
            assert abs(features["x"]) * features["n"] < 4

    **Arguments:**

    - `space`: a feature space.
    - `nominal`: ordinary features, towards which examples shrink; the middles of the domains, and
      the least lengths, when left out.

    **Returns:** a `hypothesis.strategies.SearchStrategy` of dictionaries of features.

    **Raises:** `ImportError` without Hypothesis; `ValueError` for nominal features outside the
    space.
    """
    try:
        from hypothesis import strategies
    except ImportError as error:
        raise ImportError("vj.testing.strategy needs Hypothesis: pip install hypothesis") from error
    if not isinstance(space, FeatureSpace):
        raise TypeError(f"strategy needs a FeatureSpace; got {space!r}")
    middle = np.full(space.dim, 0.5, np.float32)
    middle[list(space.lengths)] = 0.0
    if nominal is not None:
        middle = np.array(space.point_of(space.coerce(nominal)))

    # Whether an item is there is drawn by itself, so that each can be shrunk away.
    counted = {length for length, *_ in space.cube.sequences}
    middle[list(counted)] = 1.0

    def point_of(drawn: tuple[tuple[float, ...], tuple[bool, ...]]) -> np.ndarray:
        offsets, kept = drawn
        u = np.clip(middle + np.asarray(offsets, np.float32), 0.0, 1.0).astype(np.float32)[None]
        if space.items:
            u = np.asarray(space.without_items(u, ~np.asarray(kept, bool)[None]))
        return u

    def features_of(u: np.ndarray) -> dict[str, Any]:
        return jax.tree.map(lambda leaf: np.asarray(leaf)[0], space.features_at(u))

    # Zero is what Hypothesis shrinks to. Both ends are reached: often that is where failures are.
    offsets = [
        strategies.just(0.0) if i in counted else strategies.floats(-float(at), 1.0 - float(at))
        for i, at in enumerate(middle)
    ]
    kept = strategies.tuples(*[strategies.booleans()] * space.items)
    points = strategies.tuples(strategies.tuples(*offsets), kept).map(point_of)
    if space.where is not None:
        points = points.filter(lambda u: bool(space.accepts_points(u)[0]))
    return points.map(features_of)


def _check_trace(trace: object) -> None:
    assert isinstance(trace, Trace), f"a system must return a Trace; got {type(trace).__name__}"
    times = np.asarray(trace.clock())
    assert np.all(np.diff(times) > 0), "sample times must increase"
    valid = trace.length if trace.valid is None else int(trace.valid)
    assert 1 <= valid <= trace.length, f"valid must be 1 to {trace.length}; got {valid}"
    if trace.held:
        for name, signal in trace.signals.items():
            rest = np.asarray(signal)[valid - 1 :]
            assert np.array_equal(rest, np.broadcast_to(rest[:1], rest.shape), equal_nan=True), (
                f"a trace that says it is held must repeat its last valid sample; {name!r} does not"
            )
    if trace.status is None or int(trace.status) == Status.OK:
        for name in trace.finite:
            assert np.all(np.isfinite(np.asarray(trace.signals[name]))), (
                f"signal {name!r} is vouched for as finite and is not"
            )


def _check_fold(
    system: System, features: PyTree, keys: Array, alone: list[Trace], tolerance: float
) -> None:
    names = list(alone[0].signals)

    def totals(features: PyTree, key: Array) -> PyTree:
        def add(carry: dict[str, Array], sample: dict[str, Array]) -> dict[str, Array]:
            return {name: carry[name] + jnp.sum(sample[name]) for name in names}

        start = {name: jnp.zeros(()) for name in names}
        return system.fold(features, key, start, add)

    sums, status = jax.jit(jax.vmap(totals))(features, keys)
    for i, trace in enumerate(alone):
        if int(status[i]) != Status.OK:
            continue
        held = trace.hold()
        for name in names:
            wanted = np.asarray(held.signals[name], np.float64)
            size = max(np.abs(wanted).sum(), 1e-6)
            assert abs(float(sums[name][i]) - wanted.sum()) <= max(tolerance, 1e-4) * size, (
                f"fold must take in each sample, the last again behind the end; {name!r} differs"
            )


def _agree_all(alone: list[Trace], batch: Trace, tolerance: float, results: str) -> None:
    for i, trace in enumerate(alone):
        row = jax.tree.map(lambda leaf, i=i: np.asarray(leaf)[i], batch)
        _agree(trace, row, tolerance, f"a simulation must give the same {results}")


def _agree(one: Trace, other: Trace, tolerance: float, law: str) -> None:
    assert list(one.signals) == list(other.signals), (
        f"{law}: signals {list(one.signals)} and {list(other.signals)}"
    )
    assert _status(one) == _status(other), f"{law}: status {_status(one)} and {_status(other)}"
    one, other = one.hold().trim(), other.hold().trim()
    assert one.length == other.length, f"{law}: {one.length} and {other.length} valid samples"
    for name, signal in one.signals.items():
        a, b = np.asarray(signal, np.float64), np.asarray(other.signals[name], np.float64)
        size = max(np.max(np.abs(np.nan_to_num(a)), initial=0.0), 1.0)
        assert np.allclose(a, b, rtol=0, atol=tolerance * size, equal_nan=True), (
            f"{law}: signal {name!r} differs by {np.nanmax(np.abs(a - b)):z.3g}"
        )


def _status(trace: Trace) -> str:
    return Status(0 if trace.status is None else int(trace.status)).name


def _evaluate(u: Array, search: Search, pending: PyTree, cube: Cube) -> Observations:
    """Evaluate a bowl with its bottom, and failures, off the middle, as the search wants it."""
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


def _same_type(before: PyTree, after: PyTree, step: str = "tell") -> None:
    assert jax.tree.structure(before) == jax.tree.structure(after), (
        f"{step} must keep the state's form"
    )
    pairs = zip(jax.tree.leaves_with_path(before), jax.tree.leaves(after), strict=True)
    for (path, one), two in pairs:
        # A weak type, of what was made from Python's numbers only, is no difference to a run.
        assert (one.shape, one.dtype) == (two.shape, two.dtype), (
            f"{step} must keep the types of the state; its part "
            f"{jax.tree_util.keystr(path) or 'state'} was {one.dtype}{list(one.shape)} and became "
            f"{two.dtype}{list(two.shape)}"
        )


def _same(one: PyTree, two: PyTree, law: str, exact: bool = False) -> None:
    assert jax.tree.structure(one) == jax.tree.structure(two), f"{law}; the forms differ"
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        a, b = np.asarray(a), np.asarray(b)
        assert a.dtype == b.dtype, f"{law}; dtypes are {a.dtype} and {b.dtype}"
        # Rounding happens at the scale of the domain, which its values show.
        scale = 0.0 if exact else 1e-6 * float(np.max(np.abs(a), initial=0.0))
        close = np.array_equal(a, b) if a.dtype.kind not in "f" else np.allclose(a, b, 0, scale)
        assert close, f"{law}; got {a} and {b}"
