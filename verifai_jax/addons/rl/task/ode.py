"""Systems made by `ode` as tasks to train on: their dynamics, with the control as the action.

loop = ode(dynamics, initial, dt=0.02, duration=4.0, terminate=fallen)
task = ode_task(loop, Continuous(-10.0, 10.0), reward=lambda time, state, force, after: 1.0)
task = ode_task(..., reward=lambda time, state, force, after, effort: 1.0 - effort * force**2,
                weights={"effort": 0.01})                   # task.effort, which a sweep may vary
tested = replace(loop, controller=lambda time, state, features: trained.policy.act(...)[0])
"""

import dataclasses
import functools
import inspect
import keyword
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Key, PyTree, Shaped

from verifai_jax.addons.rl.task.stepping import abstract_action
from verifai_jax.core.messages.checks import check_count, is_number
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.core.user_code.user_errors import check_called_with, defined_at, explain_user_error
from verifai_jax.systems.actions import Action, Continuous, Discrete
from verifai_jax.systems.ode.closed_loop import Ode, substep, updated
from verifai_jax.systems.pytree_checks import as_floating, outline

Tree = TypeVar("Tree")
Reward = Callable[..., ArrayLike]
Control = Callable[[Array], PyTree]
Observe = Callable[[PyTree], ArrayLike]
DrawFeatures = Callable[[Key[Array, ""]], PyTree]


class OdeState(NamedTuple):
    """The state of an episode: seconds since its start; the state of the dynamics, any pytree of
    arrays; its features.
    """

    time: Float[Array, ""]
    state: PyTree
    features: PyTree


@dataclass(frozen=True, eq=False)
class OdeTask:
    """A task from a system made by `ode`; made by `ode_task`, which documents its parts.

    If its reward has weights, it has a field for each of them, and is a pytree of these.
    """

    weights: ClassVar[tuple[str, ...]] = ()
    loop: Ode
    action: Action
    time_limit: int
    reward: Reward
    control: Control
    observe_state: Observe
    features: DrawFeatures

    def reset(self, key: Key[Array, ""]) -> OdeState:
        """Start as the loop does, with features drawn for this episode."""
        features_key, start_key = jax.random.split(key)
        return self.start(start_key, self.features(features_key))

    def start(self, key: Key[Array, ""], features: PyTree) -> OdeState:
        """Start as the loop does, with these features."""
        features = jax.tree.map(jnp.asarray, features)
        state = as_floating(self.loop.initial(features, key), "initial")
        return OdeState(jnp.zeros((), jax.tree.leaves(state)[0].dtype), state, features)

    def step(
        self, key: Key[Array, ""], state: OdeState, action: Shaped[Array, "..."]
    ) -> tuple[OdeState, Float[Array, ""], Bool[Array, ""]]:
        """Take one control period, shorter if the loop ends."""
        loop, start = self.loop, state
        features, control = start.features, self.control(action)
        dt = loop.dt / loop.substeps

        def ended(state: PyTree) -> Bool[Array, ""]:
            over = False if loop.terminate is None else loop.terminate(state, features)
            return jnp.asarray(over, bool)

        time, now, over = start.time, start.state, jnp.array(False)
        for _ in range(loop.steps_per_control):
            after, later = now, time
            for _ in range(loop.substeps):
                after, later = substep(loop, features, control, later, after, dt), later + dt
            after = updated(loop, time + loop.dt, after, features)
            # Each sample of a trace may be its last.
            time, now = _where(over, (time, now), (time + loop.dt, after))
            over = over | ended(now)
        weights = {name: getattr(self, name) for name in self.weights}
        earned = self.reward(start.time, start.state, control, now, **weights)
        reward = jnp.asarray(earned, jnp.float32)
        if reward.size != 1:
            raise ValueError(
                f"reward must return one number; got {outline(earned)}{defined_at(self.reward)}"
            )
        return OdeState(time, now, start.features), reward.reshape(()), over

    def observe(self, state: OdeState) -> Float[Array, " k"]:
        """Return what the policy observes, `[k]`."""
        return jnp.ravel(jnp.asarray(self.observe_state(state.state), jnp.float32))


@suggests_options
def ode_task(
    loop: Ode, action: Action, *, reward: Reward, control: Control | None = None,
    observe: Observe | None = None, features: Mapping[str, ArrayLike] | DrawFeatures | None = None,
    time_limit: int | None = None, weights: Mapping[str, float] | None = None,
) -> OdeTask:  # fmt: skip
    """Make a `Task` from an `ode`, with its start, dynamics, step, control period and end.

    The loop's own controller is not used.

    **Arguments:**
    - `loop`: a system made by `ode`.
    - `action`: the kind of action.
    - `reward(time, state, control, after) -> number`: the reward of one control period that begins
      in `state` at `time` seconds and leads to `after`.
    - `control(action) -> control`: the input of the dynamics. By default a continuous action
      itself, a single number as a scalar. Discrete actions need it.
    - `observe(state) -> [k]`: the policy's observation; all numbers of the state when left out.
    - `features`: the features passed to dynamics and start, or a function `key -> features` that
      draws them for each episode (domain randomisation). No features when left out.
    - `time_limit`: number of control periods; by default the loop's duration.
    - `weights`: numbers passed to `reward` by name, such as `{"effort": 0.01}`. They are fields of
      the task, so `dataclasses.replace` changes them and a sweep may vary them; all values share
      one compiled training.
    **Returns:** a task; its states are `OdeState`.
    **Raises:** `ValueError` for a loop with a traced step, discrete actions without `control`,
    weights that are not numbers or have the name of a field, and functions that do not fit
    together.
    """
    if not isinstance(loop, Ode):
        raise ValueError(f"loop must be made by ode(...); got {outline(loop)}")
    if not isinstance(action, Discrete | Continuous):
        raise ValueError(f"action must be a Discrete or a Continuous; got {action!r}")
    if not isinstance(loop.substeps, int):
        raise ValueError("loop has a traced number of substeps; a task needs a fixed one")
    if control is None:
        if isinstance(action, Discrete):
            raise ValueError(
                f"{action} needs control=..., a function from the index to the input of the "
                "dynamics"
            )
        control = _action_itself
    limit = max(1, loop.steps // loop.steps_per_control) if time_limit is None else time_limit
    check_count("time_limit", limit)
    draw = features if callable(features) else _constant(dict(features or {}))
    weights = dict(weights or {})
    _check_weights(weights)
    _check_reward(reward, weights)
    check_called_with("control", control, ("action",))
    check_called_with("observe", observe, ("state",))
    check_called_with("features", draw, ("key",))
    kind = _with_weights(tuple(weights)) if weights else OdeTask
    task = kind(loop, action, limit, reward, control, observe or _all_numbers, draw, **weights)
    key = jax.eval_shape(lambda: jax.random.key(0))
    drawn = None
    try:
        drawn = jax.eval_shape(draw, key)
        start = jax.eval_shape(task.reset, key)
        after, _, _ = jax.eval_shape(task.step, key, start, abstract_action(action))
    except ValueError:
        raise
    except Exception as error:
        why = explain_user_error(error, drawn, system=False)
        raise ValueError(f"the parts of the task do not fit together: {why}") from error
    if jax.tree.structure(after) != jax.tree.structure(start):
        raise ValueError(f"dynamics must return the derivative of {outline(start)}")
    jax.eval_shape(task.observe, start)
    return task


def _check_weights(weights: Mapping[str, float]) -> None:
    taken = [field.name for field in dataclasses.fields(OdeTask)]
    for name, value in weights.items():
        if not name.isidentifier() or keyword.iskeyword(name) or hasattr(OdeTask, name):
            raise ValueError(f"a weight's name must be an identifier of its own; got {name!r}")
        if name in taken:
            raise ValueError(f"{name!r} cannot be a weight; reserved: {', '.join(taken)}")
        if not is_number(value) or not math.isfinite(value):
            raise ValueError(f"weight {name} must be a finite number; got {value!r}")


def _check_reward(reward: Reward, weights: Mapping[str, float]) -> None:
    try:
        signature = inspect.signature(reward)
    except (TypeError, ValueError):
        return  # Such as a function written in C, which says nothing of its arguments.
    arguments = ("time", "state", "control", "after")
    try:
        signature.bind(*arguments, **weights)
    except TypeError:
        named = f" and weights={{{', '.join(weights)}}} by name" if weights else " and no weights"
        raise ValueError(
            f"reward is called with ({', '.join(arguments)}){named}; got a function of "
            f"({', '.join(signature.parameters)}){defined_at(reward)}"
        ) from None


@functools.cache
def _with_weights(names: tuple[str, ...]) -> type[OdeTask]:
    """Return a task class with a field for each weight; these fields are its pytree leaves."""
    static = [field.name for field in dataclasses.fields(OdeTask)]
    made = dataclasses.make_dataclass(
        "OdeTask", [(name, float) for name in names], bases=(OdeTask,),
        namespace={"weights": names, "__module__": __name__}, frozen=True, eq=False,
    )  # fmt: skip
    return jax.tree_util.register_dataclass(made, data_fields=list(names), meta_fields=static)


def _action_itself(action: Float[Array, " size"]) -> Float[Array, "..."]:
    return action[0] if action.shape == (1,) else action


def _all_numbers(state: PyTree) -> Shaped[Array, " k"]:
    return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(state)])


def _constant(features: dict[str, ArrayLike]) -> DrawFeatures:
    return lambda key: features


def _where(condition: Bool[Array, ""], yes: Tree, no: Tree) -> Tree:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)
