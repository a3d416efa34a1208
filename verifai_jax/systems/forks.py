"""A simulation as a loop over its samples, which may stop before any of them and go on: its forks.

    forks = system.forks(features, key)                 # all of them, in one simulation
    system.go_on(forks.at(40))                          # the undisturbed trace, bit for bit
    system.go_on(forks.at(40)._replace(features=other)) # with other features from sample 40 on
    save_fork(forks.at(40), "at40.npz")
    system.go_on(read_fork("at40.npz", system.forks, features))

A system that can fork returns its `Rollout`; everything else is here and in `System`.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key, PyTree

from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.core.store.foreign_archives import read_arrays
from verifai_jax.core.values.trace import Trace
from verifai_jax.systems.channels import States
from verifai_jax.systems.checkpointing import checkpointed_scan

Samples: TypeAlias = Mapping[str, Array]
"""The signals of one sample, or with a leading axis of samples."""


class LoopState(NamedTuple):
    """The state of a closed loop before a sample.

    - `plant`: the state of what is controlled.
    - `memory`: the memory of the controller; another controller begins with a memory of its own.
    - `links`: the memory of delays and faults.
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
      next one. At the last sample, and after an early end, the state stays.
    - `length`: number of samples; `dt`: seconds between two of them.
    - `status(state)`: the status of a simulation that ends in a state.
    - `ends`: whether a simulation may end early.
    - `finite`: signals that are finite if the status is OK.
    - `scan(step, state, length)`: the loop, such as `checkpointed_scan`.
    """

    start: LoopState
    sample: Callable[[Any, Int[Array, ""]], tuple[Any, Samples]]
    length: int
    dt: float
    status: Callable[[Any], Int[Array, ""]]
    ends: bool = True
    finite: tuple[str, ...] = ()
    scan: Callable[..., tuple[Any, Any]] = checkpointed_scan

    def trace(self) -> Trace:
        """Simulate, and store all samples."""
        return self.ended(*self.scan(self.sample, self.start, self.length))

    def ended(self, last: LoopState, samples: Samples) -> Trace:
        """Return the trace of a simulation from its last state and its samples."""
        valid = last.age + 1 if self.ends else None
        return Trace(
            samples, dt=self.dt, valid=valid, status=self.status(last), held=self.ends,
            finite=self.finite,
        )  # fmt: skip

    def fold(self, carry: PyTree, update: Callable[[Any, Any], Any]) -> tuple[Any, Any]:
        """Simulate without storing samples; see `System.fold`."""

        def folded(carry: PyTree, k: Int[Array, ""]) -> Any:
            state, signals = self.sample(carry[0], k)
            return (state, update(carry[1], signals)), None

        (last, carry), _ = self.scan(folded, (self.start, carry), self.length)
        return carry, self.status(last)


class Fork(NamedTuple):
    """A simulation that stopped before a sample: all that it needs to go on, as a pytree of arrays.

    - `features`, `key`: those with which it began, and with which it goes on.
    - `index`: number of the next sample.
    - `state`: the state before it; `samples`: all samples, of which the earlier ones count.
    """

    features: PyTree
    key: Key[Array, ""] | int | None
    index: Int[Array, ""] | int
    state: LoopState
    samples: Samples


class Forks(NamedTuple):
    """All forks of one simulation; the fields of `Fork`, each state with a leading axis."""

    features: PyTree
    key: Key[Array, ""] | int | None
    states: LoopState
    samples: Samples

    def at(self, index: Int[Array, ""] | int) -> Fork:
        """Return the fork before sample `index`, which JAX may trace."""
        state = jax.tree.map(lambda leaf: leaf[index], self.states)
        return Fork(self.features, self.key, index, state, self.samples)


def all_forks(rollout: Rollout, features: PyTree, key: Any) -> Forks:
    """Simulate, and return the forks before all samples."""

    def kept(state: LoopState, k: Int[Array, ""]) -> Any:
        after, signals = rollout.sample(state, k)
        return after, (state, signals)

    _, (states, samples) = rollout.scan(kept, rollout.start, rollout.length)
    return Forks(features, key, states, samples)


def continued(rollout: Rollout, fork: Fork, first: Int[Array, ""] | int = 0) -> Trace:
    """Return the trace of a fork that goes on with this rollout.

    **Arguments:**
    - `first`: an index before which no fork of a batch begins. It is common to the batch, so the
      samples before it cost nothing.
    """

    def sample(state: LoopState, k: Int[Array, ""]) -> Any:
        def known() -> Any:
            return state, jax.tree.map(lambda leaf: leaf[k], dict(fork.samples))

        def reached() -> Any:
            return jax.lax.cond(k < fork.index, known, lambda: rollout.sample(state, k))

        return jax.lax.cond(k < first, known, reached)

    return rollout.ended(*rollout.scan(sample, fork.state, rollout.length))


def save_fork(fork: Fork, path: str | Path) -> None:
    """Write a fork as `.npz`, from which another process may go on."""
    leaves = jax.tree.leaves(fork)
    arrays: dict[str, Any] = {str(i): np.asarray(_plain(leaf)) for i, leaf in enumerate(leaves)}
    with replacing(Path(path)) as partial, partial.open("wb") as file:
        np.savez_compressed(file, **arrays)


def read_fork(
    path: str | Path, forks: Callable[..., Forks], features: PyTree, key: Any = None
) -> Fork:
    """Read a fork that `save_fork` wrote. The file can only contain numbers.

    **Arguments:**
    - `forks`: the method `forks` of the system whose fork it is.
    - `features`, `key`: any of the system's, for their forms.
    **Raises:** `FileNotFoundError`; `ValueError` for the fork of another system.
    """
    implementations: list[Any] = []

    def plain(features: PyTree, key: Any) -> list[Array]:
        leaves = jax.tree.leaves(forks(features, key).at(jnp.int32(0)))
        implementations[:] = [jax.random.key_impl(x) if _is_key(x) else None for x in leaves]
        return [_plain(leaf) for leaf in leaves]

    form = jax.eval_shape(lambda *given: forks(*given).at(jnp.int32(0)), features, key)
    wanted = {str(i): one for i, one in enumerate(jax.eval_shape(plain, features, key))}
    arrays = read_arrays(Path(path), str(path))
    forms = {name: (array.shape, array.dtype) for name, array in arrays.items()}
    if forms != {name: (one.shape, one.dtype) for name, one in wanted.items()}:
        raise ValueError(f"{path} holds no fork of this system: its arrays have other forms")
    leaves = [jnp.asarray(arrays[name]) for name in wanted]
    for i, implementation in enumerate(implementations):
        if implementation is not None:
            leaves[i] = jax.random.wrap_key_data(leaves[i], impl=implementation)
    return jax.tree.unflatten(jax.tree.structure(form), leaves)


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(getattr(leaf, "dtype", np.int32), jax.dtypes.prng_key)


def _plain(leaf: Any) -> Any:
    return jax.random.key_data(leaf) if _is_key(leaf) else jnp.asarray(leaf)
