"""A gymnax environment to train on.

    train(gymnax_task("CartPole-v1"), PPO())
    train(gymnax_task("Reacher-misc", time_limit=50), PPO())
    train(gymnax_task(MyEnvironment(), params=MyParams(mass=2.0)), PPO())

Its own reset and step are used, without its reset at the end; its time limit cuts episodes off and
does not end them, as `Task` asks.
"""

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from verifai_jax.core.errors import suggests_options
from verifai_jax.rl.task.stepping import Fit, Shown, choice, fitted, kept, vector
from verifai_jax.rl.task.task import Action
from verifai_jax.systems.environments._gymnax import Gymnax, gymnax
from verifai_jax.systems.pytree_checks import outline


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class GymnaxTask:
    """A task; made by `gymnax_task`. The numbers in `params` may be traced."""

    params: Any
    env: Any = dataclasses.field(metadata={"static": True})
    fit: Fit = dataclasses.field(metadata={"static": True})
    time_limit: int = dataclasses.field(metadata={"static": True})

    @property
    def action(self) -> Action:
        """The kind of action."""
        return self.fit.action

    def reset(self, key: Key[Array, ""]) -> Shown:
        """The environment's own start."""
        observation, state = self.env.reset_env(key, self.params)
        start = Shown(state, vector(observation, self.env.name))
        action = jax.ShapeDtypeStruct(self.fit.shape, self.fit.dtype)
        following = jax.eval_shape(
            lambda start, action: self._stepped(key, start, action)[0], start, action
        )
        return kept(start, following, self.env.name)

    def step(
        self, key: Key[Array, ""], state: Shown, action: Array
    ) -> tuple[Shown, Float[Array, ""], Bool[Array, ""]]:
        """The environment's own step, over only where its episode ends for good."""
        after, reward, over = self._stepped(key, state, self.fit(action))
        after = kept(after, state, self.env.name)
        return after, jnp.asarray(reward, jnp.float32).reshape(()), over

    def observe(self, state: Shown) -> Float[Array, " k"]:
        """The environment's observation, flat."""
        return state.observation

    def _stepped(self, key: Any, state: Shown, action: Any) -> tuple[Shown, Any, Any]:
        env, params = self.env, self.params
        observation, after, reward, over, _ = env.step_env(key, state.state, action, params)
        if _may_merge(env, params):
            # One whose step reports its time limit as an end does not with a limit out of reach.
            # What the limit may change besides stays: the other results are those above.
            limit = jnp.asarray(params.max_steps_in_episode)
            far = np.iinfo(np.int32).max if jnp.issubdtype(limit.dtype, jnp.integer) else jnp.inf
            endless = params.replace(max_steps_in_episode=jnp.asarray(far, limit.dtype))
            over = env.step_env(key, state.state, action, endless)[3]
        shown = Shown(after, vector(observation, env.name))
        return shown, reward, jnp.asarray(over, bool).reshape(())


@suggests_options
def gymnax_task(env: Any, *, params: Any = None, time_limit: int | None = None) -> GymnaxTask:
    """A `Task` of an environment of gymnax.

    **Arguments:**

    - `env`: the id of a registered environment, or an `Environment` of your own.
    - `params`: its parameters; its own when left out.
    - `time_limit`: in steps; the environment's `max_steps_in_episode` when left out.

    Actions are the environment's: a choice, or a box. A box whose entries have different bounds
    takes actions from -1 to 1 for each. Observations are made one vector of float32.

    **Raises:** `MissingExtra` without gymnax, or with one that is too old; `UnknownNameError` for
    an unknown environment; `ValueError` for one in a wrapper, no time limit, and actions or
    observations of another kind.
    """
    made = _known(env) if isinstance(env, str) else _made(env, params)
    if params is not None and isinstance(env, str) and not isinstance(params, type(made.params)):
        raise ValueError(
            f"params must be those of {env}, a {type(made.params).__name__} of its own; "
            f"got {outline(params)}"
        )
    params = made.params if params is None else params
    limit = getattr(params, "max_steps_in_episode", None) if time_limit is None else time_limit
    if limit is None or isinstance(limit, bool) or limit != int(limit) or limit < 1:
        raise ValueError(
            f"{made.env.name} needs a time limit of at least one step: "
            f"give time_limit=...; got {limit}"
        )
    task = GymnaxTask(params, made.env, _fit(made.env, params), int(limit))
    jax.eval_shape(task.reset, jax.random.key(0))
    return task


def _made(env: Any, params: Any = None) -> Gymnax:
    # All that it refuses in an environment is refused here too; nothing is simulated with it.
    return gymnax(env, lambda observation: observation, steps=1, params=params)


_known = functools.cache(_made)  # One object for one id: what is compiled for it is found.


def _fit(env: Any, params: Any) -> Fit:
    space = env.action_space(params)
    if hasattr(space, "n"):
        return choice(space.n, getattr(space, "shape", ()), space.dtype)
    if hasattr(space, "low") and hasattr(space, "high"):
        return fitted(space.low, space.high, tuple(space.shape), space.dtype, env.name)
    raise ValueError(f"{env.name} takes {space!r}; a task takes one of several, or a box")


def _may_merge(env: Any, params: Any) -> bool:
    own = type(env).__module__.split(".")[0] == "gymnax"
    return not own and hasattr(params, "max_steps_in_episode") and hasattr(params, "replace")
