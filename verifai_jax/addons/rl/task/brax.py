"""Brax environments as tasks to train on.

    train(brax_task("inverted_pendulum", backend="generalized"), PPO(normalise=True))
    train(brax_task(MyEnvironment(), time_limit=200), PPO())

`brax.training` is not needed, and does not work with the JAX version pinned here.
"""

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from verifai_jax.addons.rl.task.stepping import ObservedState, flat_observation, match_types
from verifai_jax.addons.simulators.environments._brax import Brax, brax
from verifai_jax.addons.simulators.environments._playground import loaded
from verifai_jax.addons.simulators.environments.brax_model import Env as PlaygroundEnv
from verifai_jax.addons.simulators.environments.brax_model import explain_errors
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.systems.actions import Continuous

if TYPE_CHECKING:
    from brax.envs.base import Env
    from brax.envs.base import State as BraxState
Option = float | str
"""A keyword argument of an environment: a number or text."""


@dataclass(frozen=True)
class BraxTask:
    """A task of a Brax environment, made by `brax_task`: the environment, its name in error
    messages, and the number of steps after which an episode is truncated.
    """

    env: "Env"
    name: str
    time_limit: int

    @property
    def action(self) -> Continuous:
        """The kind of action: from -1 to 1 for each actuator."""
        return Continuous(-1.0, 1.0, self.env.action_size)

    def reset(self, key: Key[Array, ""]) -> ObservedState:
        """Draw a start from the environment's own distribution."""
        with explain_errors(self.env, self.name, "reset"):
            first = self.env.reset(key)
        start = self._observed(first)
        action = jax.ShapeDtypeStruct((self.env.action_size,), jnp.float32)
        following = jax.eval_shape(lambda *to: self._step(*to), start, action)
        return match_types(start, following, self.name)

    def step(
        self, key: Key[Array, ""], state: ObservedState, action: Float[Array, " size"]
    ) -> tuple[ObservedState, Float[Array, ""], Bool[Array, ""]]:
        """Take the environment's own step, which draws nothing at random."""
        after = match_types(self._step(state, action), state, self.name)
        # Its `done` is an end for good: the time limit is in a wrapper, which is refused.
        return after, jnp.asarray(after.state.reward, jnp.float32), after.state.done > 0.5

    def observe(self, state: ObservedState) -> Float[Array, " k"]:
        """Return the environment's observation as a vector `[k]`."""
        return state.observation

    def _step(self, state: ObservedState, action: Float[Array, " size"]) -> ObservedState:
        with explain_errors(self.env, self.name, "step"):
            after = self.env.step(state.state, action)
        return self._observed(after)

    def _observed(self, state: "BraxState") -> ObservedState:
        return ObservedState(state, flat_observation(state.obs, self.name))


@suggests_options
def brax_task(
    env: "str | Env", *, backend: str | None = None, time_limit: int = 1000,
    options: Mapping[str, Option] | None = None,
) -> BraxTask:  # fmt: skip
    """Make a `Task` from an environment of Brax.

    **Arguments:**
    - `env`: the name of an environment of Brax, or an `Env` of your own.
    - `backend`: the physics pipeline, as in `brax`.
    - `time_limit`: number of steps after which an episode is truncated; Brax uses 1000 in training.
    - `options`: keyword arguments of an environment given by name, numbers or text.
    **Returns:** a task with actions from -1 to 1 for each actuator.
    **Raises:** `MissingExtra` without brax; `UnknownNameError` for an unknown environment or
    backend; `ValueError` for an environment in a wrapper that resets, ends or batches episodes, for
    observations that are not an array, and for a `time_limit` that is not a positive integer.
    """
    check_count("time_limit", time_limit)
    chosen = tuple(sorted((options or {}).items()))
    system = (_by_name if isinstance(env, str) else _checked)(env, backend, chosen)
    task = BraxTask(system.env, system.name, time_limit)
    jax.eval_shape(task.reset, jax.random.key(0))
    return task


@suggests_options
def playground_task(
    env: str | PlaygroundEnv, *, time_limit: int = 1000, options: Mapping[str, object] | None = None
) -> BraxTask:
    """Make a `Task` from an environment of MuJoCo Playground.

    **Arguments:**
    - `env`: the name of an environment, or an `MjxEnv` of your own.
    - `time_limit`: number of steps after which an episode is truncated.
    - `options`: overrides of the configuration of an environment given by name.
    **Returns:** a task with actions from -1 to 1 for each actuator.
    **Raises:** `MissingExtra` without Playground; `UnknownNameError` for an unknown environment;
    `ValueError` for observations that are not an array, and for an environment whose assets are not
    installed.
    """
    check_count("time_limit", time_limit)
    made, name = loaded(env, options)
    task = BraxTask(made, name, time_limit)
    jax.eval_shape(task.reset, jax.random.key(0))
    return task


def _checked(
    env: "str | Env", backend: str | None, options: tuple[tuple[str, Option], ...]
) -> Brax:
    # Whatever `brax` refuses in an environment is refused here too; the system simulates nothing.
    chosen = dict(options) or None
    return brax(env, lambda observation: observation, backend=backend, options=chosen, steps=1)


_by_name = functools.cache(_checked)
"""The same object for the same name, so that its compiled programs are reused."""
