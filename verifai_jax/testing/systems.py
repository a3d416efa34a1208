"""The laws of a system."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from verifai_jax.core.values.trace import Status, Trace
from verifai_jax.features import FeatureSpace
from verifai_jax.systems.base import System, as_system
from verifai_jax.systems.blackbox._blackbox import plain_leaves


def check_system(
    system: Any, space: FeatureSpace, *, samples: int = 4, seed: int = 0, tolerance: float = 1e-5
) -> None:
    """Check the contract of a system on random features: pure, one clock, all methods agree.

    **Arguments:**
    - `system`: the system to check, in any form that `Problem` accepts.
    - `space`: the feature space of the system.
    - `samples`: number of random features.
    - `seed`: the seed of features and keys.
    - `tolerance`: maximum difference of signals between simulations, relative to their largest
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
    assert status_of(one) == status_of(other), (
        f"{law}: status {status_of(one)} and {status_of(other)}"
    )
    one, other = one.hold().trim(), other.hold().trim()
    assert one.length == other.length, f"{law}: {one.length} and {other.length} valid samples"
    for name, signal in one.signals.items():
        a, b = np.asarray(signal, np.float64), np.asarray(other.signals[name], np.float64)
        size = max(np.max(np.abs(np.nan_to_num(a)), initial=0.0), 1.0)
        assert np.allclose(a, b, rtol=0, atol=tolerance * size, equal_nan=True), (
            f"{law}: signal {name!r} differs by {np.nanmax(np.abs(a - b)):z.3g}"
        )


def status_of(trace: Trace) -> str:
    return Status(0 if trace.status is None else int(trace.status)).name
