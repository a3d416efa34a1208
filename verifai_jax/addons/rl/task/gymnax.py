"""Gymnax environments as tasks to train on.

    train(gymnax_task("CartPole-v1"), PPO())
    train(gymnax_task("Reacher-misc", time_limit=50), PPO())
    train(gymnax_task(MyEnvironment(), params=MyParams(mass=2.0)), PPO())

The environment's own reset and step are used, but no automatic reset. Its time limit truncates
episodes and does not terminate them, as `Task` requires.
"""

import dataclasses
import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Key, PyTree, Shaped

from verifai_jax.addons.rl.task import stepping
from verifai_jax.addons.simulators.environments._gymnax import Gymnax, gymnax
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.systems.actions import Action
from verifai_jax.systems.pytree_checks import outline

if TYPE_CHECKING:
    # gymnax does not install alongside JAX 0.12.
    from gymnax.environments.environment import Environment  # pyright: ignore[reportMissingImports]


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class GymnaxTask:
    """A task of a gymnax environment, made by `gymnax_task`: the environment, its parameters, whose
    numbers JAX may trace, the converter of actions, and the number of steps of an episode.
    """

    params: PyTree
    env: "Environment" = dataclasses.field(metadata={"static": True})
    adapter: stepping.ActionAdapter = dataclasses.field(metadata={"static": True})
    time_limit: int = dataclasses.field(metadata={"static": True})

    @property
    def action(self) -> Action:
        """The kind of action."""
        return self.adapter.action

    def reset(self, key: Key[Array, ""]) -> stepping.ObservedState:
        """Draw a start from the environment's own distribution."""
        observation, state = self.env.reset_env(key, self.params)
        start = stepping.ObservedState(state, stepping.flat_observation(observation, self.env.name))
        action = jax.ShapeDtypeStruct(self.adapter.shape, self.adapter.dtype)
        following = jax.eval_shape(
            lambda start, action: self._step(key, start, action)[0], start, action
        )
        return stepping.match_types(start, following, self.env.name)

    def step(
        self, key: Key[Array, ""], state: stepping.ObservedState, action: Shaped[Array, "..."]
    ) -> tuple[stepping.ObservedState, Float[Array, ""], Bool[Array, ""]]:
        """Take the environment's own step; `terminated` is true only if it ends for good."""
        after, reward, over = self._step(key, state, self.adapter(action))
        after = stepping.match_types(after, state, self.env.name)
        return after, jnp.asarray(reward, jnp.float32).reshape(()), over

    def observe(self, state: stepping.ObservedState) -> Float[Array, " k"]:
        """Return the environment's observation as a vector `[k]`."""
        return state.observation

    def _step(
        self, key: Key[Array, ""], state: stepping.ObservedState, action: Shaped[Array, "..."]
    ) -> tuple[stepping.ObservedState, ArrayLike, Bool[Array, ""]]:
        env, params = self.env, self.params
        observation, after, reward, over, _ = env.step_env(key, state.state, action, params)
        if _may_end_at_its_limit(env, params):
            # A step that reports the time limit as an end cannot do so where the limit is out of
            # reach. Only `over` is taken from it: the limit may change other results too.
            limit = jnp.asarray(params.max_steps_in_episode)
            far = np.iinfo(np.int32).max if jnp.issubdtype(limit.dtype, jnp.integer) else jnp.inf
            endless = params.replace(max_steps_in_episode=jnp.asarray(far, limit.dtype))
            over = env.step_env(key, state.state, action, endless)[3]
        observed = stepping.ObservedState(after, stepping.flat_observation(observation, env.name))
        return observed, reward, jnp.asarray(over, bool).reshape(())


@suggests_options
def gymnax_task(
    env: "str | Environment", *, params: PyTree = None, time_limit: int | None = None
) -> GymnaxTask:
    """Make a `Task` from an environment of gymnax.

    **Arguments:**
    - `env`: the id of a registered environment, or an `Environment` of your own.
    - `params`: the environment's parameters; its defaults when left out.
    - `time_limit`: number of steps; the environment's `max_steps_in_episode` when left out.
    **Returns:** a task with the environment's actions: a choice, or a box. For a box whose entries
    have different bounds the policy's actions are from -1 to 1. Observations are one vector of
    float32.
    **Raises:** `MissingExtra` without gymnax, or with an outdated one; `UnknownNameError` for an
    unknown environment; `ValueError` for an environment in a wrapper, a missing time limit, and
    actions or observations of another kind.
    """
    made = _by_name(env) if isinstance(env, str) else _checked(env, params)
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
    task = GymnaxTask(params, made.env, _action_adapter(made.env, params), int(limit))
    jax.eval_shape(task.reset, jax.random.key(0))
    return task


def _checked(env: "str | Environment", params: PyTree = None) -> Gymnax:
    # Whatever `gymnax` refuses in an environment is refused here too; the system simulates nothing.
    return gymnax(env, lambda observation: observation, steps=1, params=params)


_by_name = functools.cache(_checked)
"""The same object for the same id, so that its compiled programs are reused."""


def _action_adapter(env: "Environment", params: PyTree) -> stepping.ActionAdapter:
    space = env.action_space(params)
    if hasattr(space, "n"):
        return stepping.discrete_actions(space.n, getattr(space, "shape", ()), space.dtype)
    if hasattr(space, "low") and hasattr(space, "high"):
        return stepping.box_actions(
            space.low, space.high, tuple(space.shape), space.dtype, env.name
        )
    raise ValueError(
        f"the actions of {env.name} are {space!r}; a task supports one choice of several, or a box"
    )


def _may_end_at_its_limit(env: "Environment", params: PyTree) -> bool:
    of_gymnax = type(env).__module__.split(".")[0] == "gymnax"
    return not of_gymnax and hasattr(params, "max_steps_in_episode") and hasattr(params, "replace")
