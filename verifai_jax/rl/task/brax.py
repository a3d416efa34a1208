"""A Brax environment to train on.

    train(brax_task("inverted_pendulum", backend="generalized"), PPO(normalise=True))
    train(brax_task(MyEnvironment(), time_limit=200), PPO())

`brax.training` is not needed, and does not work with the JAX that is pinned here.
"""

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from verifai_jax.core.checks import check_count
from verifai_jax.core.errors import suggests_options
from verifai_jax.rl.task.stepping import Shown, kept, vector
from verifai_jax.rl.task.task import Continuous
from verifai_jax.systems.environments._brax import Brax, brax
from verifai_jax.systems.environments.brax_model import explain_errors


@dataclass(frozen=True)
class BraxTask:
    """A task; made by `brax_task`."""

    env: Any
    name: str
    time_limit: int

    @property
    def action(self) -> Continuous:
        """Brax's actions are from -1 to 1."""
        return Continuous(-1.0, 1.0, self.env.action_size)

    def reset(self, key: Key[Array, ""]) -> Shown:
        """The environment's own start."""
        with explain_errors(self.env, self.name, "reset"):
            first = self.env.reset(key)
        start = self._shown(first)
        action = jax.ShapeDtypeStruct((self.env.action_size,), jnp.float32)
        following = jax.eval_shape(lambda *to: self._stepped(*to), start, action)
        return kept(start, following, self.name)

    def step(
        self, key: Key[Array, ""], state: Shown, action: Float[Array, " size"]
    ) -> tuple[Shown, Float[Array, ""], Bool[Array, ""]]:
        """The environment's own step; nothing in it is drawn at random."""
        after = kept(self._stepped(state, action), state, self.name)
        # Its `done` is an end for good: the time limit is in a wrapper, which is refused.
        return after, jnp.asarray(after.state.reward, jnp.float32), after.state.done > 0.5

    def observe(self, state: Shown) -> Float[Array, " k"]:
        """The environment's observation, flat."""
        return state.observation

    def _stepped(self, state: Shown, action: Array) -> Shown:
        with explain_errors(self.env, self.name, "step"):
            after = self.env.step(state.state, action)
        return self._shown(after)

    def _shown(self, state: Any) -> Shown:
        return Shown(state, vector(state.obs, self.name))


@suggests_options
def brax_task(
    env: Any,
    *,
    backend: str | None = None,
    time_limit: int = 1000,
    options: Mapping[str, Any] | None = None,
) -> BraxTask:
    """A `Task` of an environment of Brax.

    **Arguments:**

    - `env`: the name of an environment of Brax, or an `Env` of your own.
    - `backend`: as for `brax`.
    - `time_limit`: in steps, after which an episode is cut off; Brax trains on 1000.
    - `options`: keyword arguments of an environment by name, numbers or text.

    **Raises:** `MissingExtra` without brax; `UnknownNameError` for an unknown environment or
    backend; `ValueError` for one in a wrapper that resets, ends or batches episodes, and for
    observations that are no array.
    """
    check_count("time_limit", time_limit)
    chosen = tuple(sorted((options or {}).items()))
    made = (_known if isinstance(env, str) else _made)(env, backend, chosen)
    task = BraxTask(made.env, made.name, time_limit)
    jax.eval_shape(task.reset, jax.random.key(0))
    return task


def _made(env: Any, backend: str | None, options: tuple[tuple[str, Any], ...]) -> Brax:
    # All that it refuses in an environment is refused here too; nothing is simulated with it.
    chosen = dict(options) or None
    return brax(env, lambda observation: observation, backend=backend, options=chosen, steps=1)


_known = functools.cache(_made)  # One object for one name: what is compiled for it is found.
