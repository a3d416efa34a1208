"""States, observations and actions of other libraries' environments in the form of a task.

state = match_types(state, jax.eval_shape(step, state), "CartPole-v1")
flat_observation(observation, "CartPole-v1")               # float32[k]
adapter = box_actions(low, high, shape, dtype, "Pendulum-v1")
adapter.action, adapter(action)                            # what the policy, the environment takes
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, DTypeLike, Float, PyTree, Shaped

from verifai_jax.systems.actions import Action, Continuous, Discrete
from verifai_jax.systems.pytree_checks import outline


class ObservedState(NamedTuple):
    """A state of an environment with its observation, which may be random."""

    state: PyTree
    observation: Float[Array, " k"]


class ActionAdapter(NamedTuple):
    """The policy's kind of action, and its conversion to the environment's of this shape and dtype.

    It is hashable. `low`, `high` are bounds of each entry, given if they differ: the policy then
    acts in [-1, 1].
    """

    action: Action
    shape: tuple[int, ...]
    dtype: str
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()

    def __call__(self, action: Shaped[Array, "..."]) -> Shaped[Array, "..."]:
        """Return the environment's own action."""
        if self.low:
            low, high = jnp.array(self.low), jnp.array(self.high)
            action = (high + low) / 2 + (high - low) / 2 * action
        return jnp.asarray(action).reshape(self.shape).astype(self.dtype)


def abstract_action(action: Action) -> jax.ShapeDtypeStruct:
    """Return shape and dtype of an action in the form of `Task.step`."""
    if isinstance(action, Discrete):
        return jax.ShapeDtypeStruct((), jnp.int32)
    return jax.ShapeDtypeStruct((action.size,), jnp.float32)


def discrete_actions(n: int, shape: tuple[int, ...], dtype: DTypeLike) -> ActionAdapter:
    """Return the adapter for one of `n` choices."""
    return ActionAdapter(Discrete(int(n)), tuple(shape), str(np.dtype(dtype)))


def box_actions(
    low: ArrayLike, high: ArrayLike, shape: tuple[int, ...], dtype: DTypeLike, name: str
) -> ActionAdapter:
    """Return the adapter for a box. If the entries' bounds differ the policy acts in [-1, 1].

    **Raises:** `ValueError` for a box without bounds.
    """
    lows, highs = (
        np.broadcast_to(np.asarray(b, np.float64), shape).reshape(-1) for b in (low, high)
    )
    if not (np.all(np.isfinite(lows)) and np.all(np.isfinite(highs))):
        raise ValueError(
            f"the actions of {name} have no finite bounds, {low} to {high}; a task needs them"
        )
    kind, size = str(np.dtype(dtype)), max(1, lows.size)
    if np.all(lows == lows[0]) and np.all(highs == highs[0]):
        action = Continuous(float(lows[0]), float(highs[0]), size)
        return ActionAdapter(action, tuple(shape), kind)
    bounds = (tuple(map(float, lows)), tuple(map(float, highs)))
    return ActionAdapter(Continuous(-1.0, 1.0, size), tuple(shape), kind, *bounds)


def flat_observation(observation: object, name: str) -> Float[Array, " k"]:
    """Return an observation as one vector of float32.

    **Raises:** `ValueError` for an observation that is not an array of numbers.
    """
    if not hasattr(observation, "shape") or not hasattr(observation, "dtype"):
        raise ValueError(
            f"a policy receives one array of numbers; an observation of {name} is "
            f"{outline(observation)}: use an environment whose observation is one array"
        )
    return jnp.ravel(jnp.asarray(observation)).astype(jnp.float32)


def match_types(state: PyTree, following: PyTree, name: str) -> PyTree:
    """Convert a state to the dtypes that a step returns, which may differ from the reset's.

    - `following`: the state after a step, or its shapes and dtypes.

    **Raises:** `ValueError` for a step that returns a state of another structure.
    """
    if jax.tree.structure(state) != jax.tree.structure(following):
        raise ValueError(
            f"{name}: a step must return a state of the same structure as the start: "
            f"{outline(state)}; got {outline(following)}"
        )
    return jax.tree.map(_promote, state, following)


def _promote(
    leaf: jax.Array | np.ndarray | float, other: jax.Array | jax.ShapeDtypeStruct
) -> Array:
    if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return leaf
    return jnp.asarray(leaf, jnp.promote_types(jnp.result_type(leaf), other.dtype))
