"""What tasks made of other libraries' environments share: states of one form, flat observations.

state = kept(state, jax.eval_shape(step, state))      # in the types that it will have
vector(observation, "CartPole-v1")                    # float32[k]
fit = fitted(low, high, shape, dtype, "Pendulum-v1")  # the kind of action, and the way back
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from verifai_jax.rl.task.task import Action, Continuous, Discrete
from verifai_jax.systems.pytree_checks import outline


class Shown(NamedTuple):
    """A state of an environment, and what it shows of it: some draw at random what they show."""

    state: Any
    observation: Float[Array, " k"]


class Fit(NamedTuple):
    """The kind of action that a policy takes, and how an environment wants it: hashable.

    - `low`, `high`: of each entry, where they differ and the policy acts from -1 to 1.
    """

    action: Action
    shape: tuple[int, ...]
    dtype: str
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()

    def __call__(self, action: Array) -> Array:
        """The environment's own action."""
        if self.low:
            low, high = jnp.array(self.low), jnp.array(self.high)
            action = (high + low) / 2 + (high - low) / 2 * action
        return jnp.asarray(action).reshape(self.shape).astype(self.dtype)


def choice(n: int, shape: tuple[int, ...], dtype: Any) -> Fit:
    """One of `n`."""
    return Fit(Discrete(int(n)), tuple(shape), str(np.dtype(dtype)))


def fitted(low: Any, high: Any, shape: tuple[int, ...], dtype: Any, name: str) -> Fit:
    """A box of actions. Where its entries have different bounds the policy acts from -1 to 1.

    **Raises:** `ValueError` for a box without bounds.
    """
    lows, highs = (
        np.broadcast_to(np.asarray(b, np.float64), shape).reshape(-1) for b in (low, high)
    )
    if not (np.all(np.isfinite(lows)) and np.all(np.isfinite(highs))):
        raise ValueError(f"{name} has actions without bounds, {low} to {high}; a task needs some")
    kind, size = str(np.dtype(dtype)), max(1, lows.size)
    if np.all(lows == lows[0]) and np.all(highs == highs[0]):
        return Fit(Continuous(float(lows[0]), float(highs[0]), size), tuple(shape), kind)
    bounds = (tuple(map(float, lows)), tuple(map(float, highs)))
    return Fit(Continuous(-1.0, 1.0, size), tuple(shape), kind, *bounds)


def vector(observation: Any, name: str) -> Float[Array, " k"]:
    """An observation as one vector of float32.

    **Raises:** `ValueError` for one that is no array of numbers.
    """
    if not hasattr(observation, "shape") or not hasattr(observation, "dtype"):
        raise ValueError(
            f"a policy sees one array of numbers; {name} shows {outline(observation)}: "
            "give it an environment that shows one array"
        )
    return jnp.ravel(observation).astype(jnp.float32)


def kept(state: Any, following: Any, name: str) -> Any:
    """A state in the types that it has from step to step: a count may begin as an integer.

    **Raises:** `ValueError` for a step that leads to a state of another form.
    """
    if jax.tree.structure(state) != jax.tree.structure(following):
        raise ValueError(
            f"{name}: a step must return a state in the form that the start has: "
            f"{outline(state)}; got {outline(following)}"
        )
    return jax.tree.map(_promoted, state, following)


def _promoted(leaf: Any, other: Any) -> Array:
    if jnp.issubdtype(leaf.dtype if hasattr(leaf, "dtype") else type(leaf), jax.dtypes.prng_key):
        return leaf
    return jnp.asarray(leaf, jnp.promote_types(jnp.result_type(leaf), other.dtype))
