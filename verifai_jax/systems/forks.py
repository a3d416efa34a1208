"""A simulation as a loop over its samples, which may stop before any of them and go on: its forks.

forks = system.forks(features, key)                 # all of them, in one simulation
system.go_on(forks.at(40))                          # the undisturbed trace, bit for bit
system.go_on(forks.at(40)._replace(features=other)) # with other features from sample 40 on
save_fork(forks.at(40), "40.npz"); read_fork("40.npz", forks.at(0))
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key, PyTree

from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.core.store.foreign_archives import read_arrays
from verifai_jax.core.values.trace import Trace
from verifai_jax.systems.channels import States
from verifai_jax.systems.checkpointing import checkpointed_scan


class LoopState(NamedTuple):
    """The state of a closed loop before a sample.

    - `plant`: the state of what is controlled; `memory`: that of the controller; `links`: that of
      delays and faults.
    - `age`: number of steps so far; it stays at an early end.
    - `held`: the control that is held between two decisions.
    """

    plant: PyTree
    memory: PyTree
    links: States
    age: Int[Array, ""]
    held: PyTree = None


class Rollout(NamedTuple):
    """One simulation as a loop over its samples.

    - `start`: the state before the first sample.
    - `sample(state, k) -> (state, signals)`: the signals of sample `k`, and the state before the
      next one, which stays at the last sample and after an early end.
    - `length`: number of samples; `dt`: seconds between two of them.
    - `status(state)`: the status of a simulation that ends in a state.
    - `ends`: whether it may end early; `finite`: signals that are finite if the status is OK.
    - `scan(step, state, length)`: the loop.
    """

    start: LoopState
    sample: Callable[[Any, Int[Array, ""]], tuple[Any, Any]]
    length: int
    dt: float
    status: Callable[[Any], Int[Array, ""]]
    ends: bool = True
    finite: tuple[str, ...] = ()
    scan: Callable[..., tuple[Any, Any]] = checkpointed_scan

    def trace(self) -> Trace:
        """Simulate, and store all samples."""
        return self.ended(*self.scan(self.sample, self.start, self.length))

    def ended(self, last: LoopState, samples: PyTree) -> Trace:
        """Return the trace of a simulation from its last state and its samples."""
        return Trace(
            samples, dt=self.dt, valid=last.age + 1 if self.ends else None,
            status=self.status(last), held=self.ends, finite=self.finite,
        )  # fmt: skip

    def fold(self, carry: PyTree, update: Callable[[Any, Any], Any]) -> tuple[Any, Any]:
        """Simulate without storing samples; see `System.fold`."""

        def folded(carry: PyTree, k: Int[Array, ""]) -> Any:
            state, signals = self.sample(carry[0], k)
            return (state, update(carry[1], signals)), None

        (last, carry), _ = self.scan(folded, (self.start, carry), self.length)
        return carry, self.status(last)

    def forks(self, features: PyTree, key: Any) -> "Fork":
        """Simulate, and return the forks before all samples."""

        def kept(state: LoopState, k: Int[Array, ""]) -> Any:
            after, signals = self.sample(state, k)
            return after, (state, signals)

        _, (states, samples) = self.scan(kept, self.start, self.length)
        return Fork(features, key, jnp.arange(self.length), states, samples)

    def go_on(self, fork: "Fork", first: Int[Array, ""] | int = 0) -> Trace:
        """Return the trace of a fork that goes on; `first` is that of `System.go_on`."""

        def sample(state: LoopState, k: Int[Array, ""]) -> Any:
            def known() -> Any:
                return state, jax.tree.map(lambda leaf: leaf[k], fork.samples)

            def reached() -> Any:
                return jax.lax.cond(k < fork.index, known, lambda: self.sample(state, k))

            return jax.lax.cond(k < first, known, reached)

        return self.ended(*self.scan(sample, fork.state, self.length))


class Fork(NamedTuple):
    """A simulation that stopped before a sample, as a pytree of arrays; or all of one simulation.

    - `features`, `key`: those with which it goes on.
    - `index`: number of the next sample; `state`: the state before it. Those of all forks of a
      simulation have a leading axis.
    - `samples`: all samples, of which the earlier ones count.
    """

    features: PyTree
    key: Key[Array, ""] | int | None
    index: Int[Array, "*n"]
    state: LoopState
    samples: PyTree

    def at(self, index: Int[Array | np.ndarray, "*n"] | int) -> "Fork":
        """Return the fork of a simulation before a sample, or those before several."""
        state = jax.tree.map(lambda leaf: leaf[index], self.state)
        return self._replace(index=self.index[index], state=state)


def save_fork(fork: Fork, path: str | Path) -> None:
    """Write a fork as `.npz`, from which another process may go on."""
    arrays: dict[str, Any] = {str(i): _plain(leaf) for i, leaf in enumerate(jax.tree.leaves(fork))}
    with replacing(Path(path)) as partial, partial.open("wb") as file:
        np.savez_compressed(file, **arrays)


def read_fork(path: str | Path, like: Fork) -> Fork:
    """Read a fork of the same system as `like`; the file can only contain numbers.

    **Raises:** `FileNotFoundError`; `ValueError` for the fork of another system.
    """
    arrays, (leaves, form) = read_arrays(Path(path), str(path)), jax.tree.flatten(like)
    saved = [arrays.get(str(i), np.zeros(0)) for i in range(max(len(leaves), len(arrays)))]
    wanted = [(plain.shape, plain.dtype) for plain in map(_plain, leaves)]
    if [(array.shape, array.dtype) for array in saved] != wanted:
        raise ValueError(f"{path} holds no fork of this system: its arrays have other forms")
    for i, leaf in enumerate(leaves):
        array = jnp.asarray(saved[i])
        own = _is_key(leaf)
        leaves[i] = (
            jax.random.wrap_key_data(array, impl=jax.random.key_impl(leaf)) if own else array
        )
    return jax.tree.unflatten(form, leaves)


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(getattr(leaf, "dtype", np.int32), jax.dtypes.prng_key)


def _plain(leaf: Any) -> np.ndarray:
    return np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else jnp.asarray(leaf))
