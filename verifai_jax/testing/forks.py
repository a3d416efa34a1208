"""The laws of a system that can fork."""

import tempfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from verifai_jax.core.values.trace import Trace
from verifai_jax.features import FeatureSpace
from verifai_jax.systems.base import as_system
from verifai_jax.systems.forks import Fork, read_fork, save_fork


def check_forks(system: Any, space: FeatureSpace, *, samples: int = 2, seed: int = 0) -> None:
    """Check that forks of random simulations go on to the undisturbed trace, bit for bit.

    They are alone, in a batch with a common index, and read from a file.

    **Arguments:** as in `check_system`, of a system that can fork.
    **Raises:** `AssertionError` naming the broken law; `NotImplementedError` if it cannot.
    """
    system = as_system(system)
    simulate, fork, go_on = jax.jit(system), jax.jit(system.forks), jax.jit(system.go_on)
    batch, fork_batch = jax.jit(jax.vmap(system)), jax.jit(jax.vmap(system.forks))
    go_on_batch = jax.jit(jax.vmap(system.go_on, in_axes=(Fork(0, 0, None, 0, 0),)))  # pyright: ignore
    for i, point in enumerate(np.random.default_rng(seed).random((samples, space.dim), np.float32)):
        given = space.unflatten(jnp.asarray(point)), jax.random.key(seed + i)
        whole, forks = simulate(*given), fork(*given)
        pair = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), given)
        undisturbed, together = batch(*pair), fork_batch(*pair)
        with tempfile.TemporaryDirectory() as folder:
            save_fork(forks.at(whole.length // 2), Path(folder, "fork.npz"))
            kept = read_fork(Path(folder, "fork.npz"), forks.at(0))
        _same(whole, go_on(kept), "a fork from a file must go on like one from memory")
        for k in np.unique([0, 1, whole.length // 3, whole.length // 2, whole.length - 1]):
            one, law = forks.at(k), f"before sample {k} must go on to the undisturbed trace"
            _same(whole, go_on(one), f"a fork {law}")
            empty = jax.tree.map(lambda leaf, k=k: leaf.at[k:].set(1), one.samples)
            _same(whole, go_on(one._replace(samples=empty)), f"without later samples a fork {law}")
            state = jax.tree.map(lambda leaf, k=k: leaf[:, k], together.state)
            both = together._replace(index=jnp.int32(k), state=state)
            _same(undisturbed, go_on_batch(both), f"forks in a batch {law}")


def _same(wanted: Trace, got: Trace, law: str) -> None:
    pairs: list[Any] = [(name, wanted.signals[name], got.signals[name]) for name in wanted.signals]
    ends = [(name, getattr(wanted, name), getattr(got, name)) for name in ("valid", "status")]
    for name, one, other in [*pairs, *(end for end in ends if end[1] is not None)]:
        assert np.array_equal(one, other, equal_nan=True), f"{law}; {name} differs"
