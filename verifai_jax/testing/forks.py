"""The laws of a system that can fork."""

import tempfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int, PyTree

from verifai_jax.core.values.trace import Trace
from verifai_jax.features import FeatureSpace
from verifai_jax.systems.base import as_system
from verifai_jax.systems.forks import Fork, read_fork, save_fork


def check_forks(system: Any, space: FeatureSpace, *, samples: int = 2, seed: int = 0) -> None:
    """Check that forks of random simulations go on to the undisturbed trace, bit for bit.

    They begin at the start, between, and before the last sample, alone and in a batch of a common
    index; and one is read from a file.

    **Arguments:**
    - `system`: the system to check, which can fork.
    - `space`: the feature space of the system.
    - `samples`: number of random features.
    - `seed`: the seed of features and keys.
    **Raises:** `AssertionError` naming the broken law; `ValueError` for a system that cannot fork.
    """
    system = as_system(system)
    simulate, go_on = jax.jit(system), jax.jit(system.go_on)
    batch, fork_together = jax.jit(jax.vmap(system)), jax.jit(jax.vmap(system.forks))
    go_on_together = jax.jit(jax.vmap(system.go_on, in_axes=(Fork(0, 0, None, 0, 0),)))
    for i, point in enumerate(np.random.default_rng(seed).random((samples, space.dim), np.float32)):
        features, key = space.unflatten(jnp.asarray(point)), jax.random.key(seed + i)
        whole, forks = simulate(features, key), jax.jit(system.forks)(features, key)
        indices = np.unique([0, 1, whole.length // 3, whole.length // 2, whole.length - 1])
        begun: list[Any] = [forks.at(jnp.int32(index)) for index in indices]
        for fork in begun:
            text = f"a fork before sample {int(fork.index)}"
            _same(whole, go_on(fork), f"{text} must go on to the undisturbed trace")
            law = f"{text} must not depend on later samples"
            _same(
                whole, go_on(fork._replace(samples=_later_changed(fork.samples, fork.index))), law
            )
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder, "fork.npz")
            save_fork(begun[-2], file)
            kept = read_fork(file, system.forks, features, key)
        _same(whole, go_on(kept), "a fork from a file must go on like one from memory")
        pair = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), (features, key))
        together, undisturbed = fork_together(*pair), batch(*pair)
        for index in indices:
            states = jax.tree.map(lambda leaf, k=index: leaf[:, k], together.states)
            fork = Fork(*pair, jnp.int32(index), states, together.samples)
            law = f"forks of a batch before sample {index} must go on to its undisturbed traces"
            _same(undisturbed, go_on_together(fork), law)


def _later_changed(samples: PyTree, index: Int[Any, ""]) -> Any:
    """Return samples of which those from an index on are other numbers."""

    def changed(leaf: Any) -> Any:
        later = jnp.arange(len(leaf)) >= index
        return jnp.where(later.reshape(-1, *[1] * (leaf.ndim - 1)), jnp.ones_like(leaf), leaf)

    return jax.tree.map(changed, samples)


def _same(wanted: Trace, got: Trace, law: str) -> None:
    def parts(trace: Trace) -> dict[str, Any]:
        return {**trace.signals, "its valid": trace.valid, "its status": trace.status}

    for name, one in parts(wanted).items():
        other = parts(got)[name]
        if one is not None:
            same = np.array_equal(np.asarray(one), np.asarray(other), equal_nan=True)
            assert same, f"{law}; {name} differs"
