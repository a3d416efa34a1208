"""Proximal policy optimisation: experience of many environments, a few clipped passes over it.

Source: Schulman et al., Proximal policy optimization algorithms (2017).
"""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, PyTree, Shaped

from verifai_jax.addons.rl import experience
from verifai_jax.addons.rl.advantage import advantages
from verifai_jax.addons.rl.algorithm import Number, Progress, Vectorised, check_values, static_field
from verifai_jax.addons.rl.experience import Episodes, Transition, advance, step_keys
from verifai_jax.addons.rl.observations import Statistics, mean_and_scale, normalise, update
from verifai_jax.addons.rl.on_policy import adam, annealed, minibatch_epochs, minibatch_network
from verifai_jax.addons.rl.policy import Layers, Policy, network, new_layers, scale_to_range
from verifai_jax.addons.rl.task.task import Task
from verifai_jax.systems.actions import Action, Continuous, Discrete


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PPO(Vectorised):
    """Proximal policy optimisation, for discrete and continuous actions, with its hyper-parameters.

    - `learning_rate`: the learning rate of Adam; falls linearly to 0 over the training if `anneal`.
    - `discount`, `gae_lambda`: the discount of future rewards, and the weight of longer
      look-aheads, in `[0, 1]`.
    - `clip`: how far the ratio of new to old probability may differ from 1.
    - `entropy`, `value_weight`: weights of entropy and value error in the loss.
    - `max_gradient`: norm to which gradients are clipped.
    - `environments`, `horizon`: number of environments, and of steps of each, in an update.
    - `epochs`, `minibatches`: number of passes over these steps, and of minibatches in a pass.
    - `hidden`, `value_hidden`: widths of the policy's and the critic's hidden layers.
    - `normalise`: whether to normalise observations by their running mean and deviation.
    """

    # JAX rebuilds the class with stacked numbers and placeholders in place of numbers.
    __no_type_check__ = True
    actions: ClassVar[tuple[type, ...]] = (Discrete, Continuous)
    learning_rate: Number = 2.5e-4
    discount: Number = 0.99
    gae_lambda: Number = 0.95
    clip: Number = 0.2
    entropy: Number = 0.01
    value_weight: Number = 0.5
    max_gradient: Number = 0.5
    environments: int = static_field(8)
    horizon: int = static_field(128)
    epochs: int = static_field(4)
    minibatches: int = static_field(4)
    hidden: tuple[int, ...] = static_field((64, 64))
    value_hidden: tuple[int, ...] = static_field((64, 64))
    normalise: bool = static_field(False)
    anneal: bool = static_field(True)

    def check(self) -> None:
        """Refuse invalid hyper-parameters; see `Algorithm.check`."""
        check_values(self, ("learning_rate", "clip", "max_gradient"), "positive")
        check_values(self, ("discount", "gae_lambda"), "between 0 and 1")
        check_values(self, ("entropy", "value_weight"), "at least 0")
        self.check_shapes("epochs", "minibatches")

    def init(self, task: Task, key: Key[Array, ""], updates: int | Int[Array, ""]) -> "PPOState":
        """Make the state before the first of `updates` updates."""
        policy_key, critic_key, reset_key, key = jax.random.split(key, 4)
        episodes = experience.start_episodes(task, reset_key, self.environments)
        size, outputs = experience.sizes(task, episodes)
        discrete = isinstance(task.action, Discrete)
        weights = Weights(
            # A nearly uniform first policy, and a critic that starts at unit scale.
            policy=new_layers(policy_key, (size, *self.hidden, outputs), gain=0.01),
            critic=new_layers(critic_key, (size, *self.value_hidden, 1), gain=1.0),
            log_std=None if discrete else jnp.zeros(outputs),
        )
        return PPOState(
            weights=weights, moments=adam(self.max_gradient).init(weights),
            statistics=Statistics.initial(size), episodes=episodes, key=key,
            done=jnp.int32(0), updates=jnp.int32(updates),
        )  # fmt: skip

    def step(self, task: Task, state: "PPOState") -> tuple["PPOState", Progress]:
        """Collect `horizon` steps of each environment and learn from them.

        **Returns:** the state after it, and the episodes that ended in it.
        """
        collect_key, learn_key, key = jax.random.split(state.key, 3)
        episodes, seen = collect(self, task, state, collect_key)
        statistics = update(state.statistics, seen.observation, self.normalise)
        weights, moments = _learn(self, task, state, seen, learn_key)
        after = PPOState(weights, moments, statistics, episodes, key, state.done + 1, state.updates)
        return after, experience.progress(seen.transition)

    def policy(self, task: Task, state: "PPOState") -> Policy:
        """Return the policy learnt so far, without exploration."""
        mean, scale = mean_and_scale(state.statistics) if self.normalise else (None, None)
        return Policy(state.weights.policy, mean, scale, state.weights.log_std, task.action)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Weights:
    """The layers of the two networks, and `log_std` `[size]`, the logarithm of the deviation for
    exploration; None for discrete actions.
    """

    # JAX rebuilds the class with stacked arrays and placeholders, which have other shapes.
    __no_type_check__ = True
    policy: Layers
    critic: Layers
    log_std: Float[Array, " size"] | None


class PPOState(NamedTuple):
    """The state between two updates: the learnt `weights` and the optimizer's `moments`;
    `statistics` of the observations so far; the present `episodes`; the random `key` of the next
    update; the number of updates `done`, and of all `updates`.
    """

    weights: Weights
    moments: PyTree
    statistics: Statistics
    episodes: Episodes
    key: Key[Array, ""]
    done: Int[Array, ""]
    updates: Int[Array, ""]


class Experience(NamedTuple):
    """Steps of the environments, `[horizon, environments]`: the `observation`; the `action`, an
    index or a vector scaled to [-1, 1]; the `outputs` of the policy's network; the resulting
    `transition`.
    """

    observation: Float[Array, "*steps k"]
    action: Shaped[Array, "..."]
    outputs: Float[Array, "*steps outputs"]
    transition: Transition


class Minibatch(NamedTuple):
    """Steps to learn from, with a leading axis `[rows]`: the `observation`, normalised if the
    algorithm does so; the `action` as in `Experience`, with its `log_probability` under the policy
    that took it and its `advantage`; the `target` of the critic.
    """

    observation: Float[Array, "*rows k"]
    action: Shaped[Array, "..."]
    log_probability: Float[Array, "*rows"]
    advantage: Float[Array, "*rows"]
    target: Float[Array, "*rows"]


def collect(
    ppo: PPO, task: Task, state: PPOState, key: Key[Array, ""]
) -> tuple[Episodes, Experience]:
    """Collect experience `[horizon, environments]`, with a new episode where one ends."""
    log_std, action = state.weights.log_std, task.action
    noise_key, step_key = jax.random.split(key)
    shape = (ppo.horizon, ppo.environments, state.weights.policy[-1][1].shape[0])
    draw = jax.random.gumbel if isinstance(action, Discrete) else jax.random.normal

    def step(
        episodes: Episodes,
        drawn: tuple[Float[Array, "environments outputs"], Key[Array, "environments 2"]],
    ) -> tuple[Episodes, Experience]:
        noise, keys = drawn
        # Without the barrier XLA would make the first product of parts of the state, slowly.
        observation = jax.lax.optimization_barrier(jax.vmap(task.observe)(episodes.state))
        normalised = normalise(state.statistics, observation, ppo.normalise)
        outputs = network(state.weights.policy, normalised)
        if isinstance(action, Discrete):
            chosen = taken = jnp.argmax(noise + outputs, axis=-1).astype(jnp.int32)
        else:
            assert log_std is not None
            chosen = outputs + jnp.exp(log_std) * noise
            taken = scale_to_range(action, chosen)
        episodes, transition = advance(task, episodes, taken, keys)
        return episodes, Experience(observation, chosen, outputs, transition)

    keys = step_keys(step_key, ppo.horizon, ppo.environments)
    return jax.lax.scan(step, state.episodes, (draw(noise_key, shape), keys))


def _learn(
    ppo: PPO, task: Task, state: PPOState, seen: Experience, key: Key[Array, ""]
) -> tuple[Weights, PyTree]:
    """Take a few epochs of clipped policy and value steps on one stretch of experience."""
    transition, action = seen.transition, task.action
    observation = normalise(state.statistics, seen.observation, ppo.normalise)
    value, next_value = values(ppo, task, state, transition, observation)
    advantage = advantages(
        transition.reward, value, next_value, transition.ends, ppo.discount, ppo.gae_lambda
    )
    batch = Minibatch(
        observation=observation, action=seen.action,
        log_probability=_log_probability(action, seen.outputs, state.weights.log_std, seen.action),
        advantage=advantage, target=advantage + value,
    )  # fmt: skip
    return minibatch_epochs(
        lambda weights, part: _loss(weights, ppo, action, part),
        (state.weights, state.moments), batch, key, adam(ppo.max_gradient),
        annealed(ppo.learning_rate, state.done, state.updates, ppo.anneal), ppo.epochs,
        ppo.minibatches,
    )  # fmt: skip


def values(
    ppo: PPO, task: Task, state: PPOState, transition: Transition,
    observation: Float[Array, "time lanes k"],
) -> tuple[Float[Array, "time lanes"], Float[Array, "time lanes"]]:  # fmt: skip
    """Return the values of the observations, and of those that the steps led to."""
    time, lanes, size = observation.shape
    # The same values one step later, but for the last step and where the time limit cut a lane.
    limit = task.time_limit
    cuts = 1 + (time - 1) // limit if isinstance(limit, int) else time
    cut = jax.lax.top_k(transition.ends.truncated.T.astype(jnp.int32), cuts)[1].T, jnp.arange(lanes)
    following = transition.next_observation
    others = jnp.concatenate([following[-1:], following[cut]])
    rows = jnp.concatenate([observation, normalise(state.statistics, others, ppo.normalise)])
    value = minibatch_network(state.weights.critic, rows.reshape(-1, size)).reshape(-1, lanes)
    return value[:time], value[1 : time + 1].at[cut].set(value[time + 1 :])


def _loss(weights: Weights, ppo: PPO, action: Action, part: Minibatch) -> Float[Array, ""]:
    outputs = minibatch_network(weights.policy, part.observation)
    value = minibatch_network(weights.critic, part.observation)[:, 0]
    log_probability = _log_probability(action, outputs, weights.log_std, part.action)
    advantage = part.advantage
    advantage = (advantage - jnp.mean(advantage)) / (jnp.std(advantage) + 1e-8)
    ratio = jnp.exp(log_probability - part.log_probability)
    clipped = jnp.clip(ratio, 1 - ppo.clip, 1 + ppo.clip)
    surrogate = jnp.mean(jnp.minimum(ratio * advantage, clipped * advantage))  # eq. 7
    value_error = jnp.mean(jnp.square(value - part.target)) / 2
    entropy = jnp.mean(_entropy(action, outputs, weights.log_std))
    return -surrogate + ppo.value_weight * value_error - ppo.entropy * entropy  # eq. 9


def _log_probability(
    action: Action, outputs: Float[Array, "*rows outputs"],
    log_std: Float[Array, " outputs"] | None, taken: Shaped[Array, "..."],
) -> Float[Array, "*rows"]:  # fmt: skip
    if isinstance(action, Discrete):
        # A choice instead of an index, whose derivative would scatter row by row.
        chosen = jnp.arange(action.n) == taken[..., None]
        return jnp.sum(jnp.where(chosen, jax.nn.log_softmax(outputs), 0.0), axis=-1)
    assert log_std is not None
    standard = (taken - outputs) / jnp.exp(log_std)
    return -jnp.sum(jnp.square(standard) / 2 + log_std + jnp.log(2 * jnp.pi) / 2, axis=-1)


def _entropy(
    action: Action, outputs: Float[Array, "*rows outputs"], log_std: Float[Array, " outputs"] | None
) -> Float[Array, "*#rows"]:
    if isinstance(action, Continuous):
        assert log_std is not None
        return jnp.sum(log_std + (jnp.log(2 * jnp.pi) + 1) / 2)
    log_probability = jax.nn.log_softmax(outputs)
    return -jnp.sum(jnp.exp(log_probability) * log_probability, axis=-1)
