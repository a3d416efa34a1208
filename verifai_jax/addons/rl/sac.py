"""Soft actor-critic: a stochastic policy for continuous actions, trained for return and entropy.

The resulting policy is the mean action after tanh, without the noise.

Source: Haarnoja et al., Soft actor-critic algorithms and applications (2018). Exploration with
noise that lasts: Eberhard et al., Pink noise is all you need (2023), here an autoregressive
(Ornstein-Uhlenbeck) process whose marginal is the policy's own Gaussian.
"""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, PyTree

from verifai_jax.addons.rl import experience, replay_buffer
from verifai_jax.addons.rl.algorithm import Number, Progress, Vectorised, check_values, static_field
from verifai_jax.addons.rl.observations import Statistics, mean_and_scale, normalise, update
from verifai_jax.addons.rl.on_policy import adam, annealed
from verifai_jax.addons.rl.policy import Layers, Policy, network, new_layers, scale_to_range
from verifai_jax.addons.rl.replay_buffer import ReplayBuffer, StoredTransitions
from verifai_jax.addons.rl.task.task import Task
from verifai_jax.systems.actions import Continuous

LOG_STD = (-10.0, 2.0)
"""Bounds of the logarithm of the deviation.

Outside these bounds a Gaussian after tanh is nearly constant, or takes almost only -1 and 1.
"""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SAC(Vectorised):
    """Soft actor-critic, for continuous actions, with its hyper-parameters.

    - `learning_rate`: the learning rate of Adam, for the policy, the critics and the temperature;
      falls linearly to 0 over the training if `anneal`.
    - `discount`: the discount of future rewards, in `[0, 1]`.
    - `target_rate`: how far the slow critics move towards the fast ones in a learning step.
    - `temperature`: initial weight of entropy against reward; it then adapts to `target_entropy`,
      the desired mean entropy for each number of an action (scaled to [-1, 1]).
    - `correlation`: the correlation of the noise between consecutive steps, in `[0, 1)`; 0 is white
      noise. Values from 0.9 on reach states that single random steps never reach (the hill of
      mountain car).
    - `warmup`: number of environment steps before learning starts.
    - `reward_scale`: a factor on rewards; values of a few units are learnt best, and the initial
      temperature is chosen for these.
    - `environments`, `horizon`: number of environments, and of steps of each, in an update.
    - `learnings`: number of learning steps, with `batch` transitions each, after each step of all
      environments.
    - `capacity`: number of transitions in the buffer, a multiple of `environments`.
    - `hidden`, `value_hidden`: widths of the policy's and the critics' hidden layers. `activation`:
      their activation, "tanh" or "relu".
    - `normalise`: whether to normalise observations by their running mean and deviation.
    """

    # JAX rebuilds the class with stacked numbers and placeholders in place of numbers.
    __no_type_check__ = True
    actions: ClassVar[tuple[type, ...]] = (Continuous,)
    learning_rate: Number = 1e-3
    discount: Number = 0.99
    target_rate: Number = 0.01
    temperature: Number = 0.2
    target_entropy: Number = -1.0
    correlation: Number = 0.0
    warmup: int | Int[Array, ""] = 1_000
    reward_scale: Number = 0.1
    environments: int = static_field(8)
    horizon: int = static_field(32)
    learnings: int = static_field(1)
    batch: int = static_field(128)
    capacity: int = static_field(50_000)
    hidden: tuple[int, ...] = static_field((64, 64))
    value_hidden: tuple[int, ...] = static_field((64, 64))
    activation: str = static_field("relu")
    normalise: bool = static_field(False)
    anneal: bool = static_field(False)

    def check(self) -> None:
        """Refuse invalid hyper-parameters; see `Algorithm.check`."""
        check_values(self, ("learning_rate", "temperature", "reward_scale"), "positive")
        check_values(self, ["discount"], "between 0 and 1")
        check_values(self, ["target_rate"], "above 0 and at most 1")
        check_values(self, ["correlation"], "at least 0 and below 1")
        check_values(self, ["warmup"], "at least 0")
        self.check_shapes("learnings", "batch", "capacity")
        wanted = f"a multiple of environments = {self.environments}"
        check_values(self, ["capacity"], wanted, lambda value: value % self.environments == 0)

    def init(self, task: Task, key: Key[Array, ""], updates: int | Int[Array, ""]) -> "SACState":
        """Make the state before the first of `updates` updates."""
        policy_key, critic_key, reset_key, noise_key, key = jax.random.split(key, 5)
        episodes = experience.start_episodes(task, reset_key, self.environments)
        size, actions = experience.sizes(task, episodes)

        def critic(key: Key[Array, ""]) -> Layers:
            return new_layers(key, (size + actions, *self.value_hidden, 1), gain=1.0)

        weights = Weights(
            # Mean 0 and deviation 1 at first: under tanh nearly uniform over the range.
            policy=new_layers(policy_key, (size, *self.hidden, 2 * actions), gain=0.01),
            critics=jax.vmap(critic)(jax.random.split(critic_key, 2)),
            log_temperature=jnp.log(jnp.asarray(self.temperature, jnp.float32)),
        )
        return SACState(
            weights=weights, slow=weights.critics, moments=adam().init(weights),
            statistics=Statistics.initial(size), episodes=episodes,
            noise=jax.random.normal(noise_key, (self.environments, actions)),
            buffer=replay_buffer.empty_buffer(self.capacity, size, actions), key=key,
            done=jnp.int32(0), updates=jnp.int32(updates),
        )  # fmt: skip

    def step(self, task: Task, state: "SACState") -> tuple["SACState", Progress]:
        """Step the environments `horizon` times, with learning steps after each step.

        **Returns:** the state after it, and the episodes that ended in it.
        """
        act_key, learn_key, key = jax.random.split(state.key, 3)
        rate = jnp.asarray(annealed(self.learning_rate, state.done, state.updates, self.anneal))

        def one_step(
            carry: "SACState", drawn: tuple[Int[Array, ""], Array, Key[Array, "..."], Array]
        ) -> tuple["SACState", tuple[experience.Transition, Float[Array, "environments k"]]]:
            number, noise, keys, learn_key = drawn
            carry, transition, observation = act(self, task, carry, noise, keys)
            taken = (state.done * self.horizon + number + 1) * self.environments
            carry = jax.lax.cond(
                taken >= self.warmup, lambda: _learn(self, carry, rate, learn_key), lambda: carry
            )
            return carry, (transition, observation)

        noise_key, step_key = jax.random.split(act_key)
        # All random numbers of the update at once: in the loop each draw would cost its own.
        noise = jax.random.normal(noise_key, (self.horizon, *state.noise.shape))
        keys = experience.step_keys(step_key, self.horizon, self.environments)
        drawn = jnp.arange(self.horizon), noise, keys, jax.random.split(learn_key, self.horizon)
        after, (transition, observation) = jax.lax.scan(one_step, state, drawn)
        statistics = update(state.statistics, observation, self.normalise)
        after = after._replace(statistics=statistics, key=key, done=state.done + 1)
        return after, experience.progress(transition)

    def policy(self, task: Task, state: "SACState") -> Policy:
        """Return the policy learnt so far, without exploration."""
        mean, scale = mean_and_scale(state.statistics) if self.normalise else (None, None)
        *layers, (weight, bias) = state.weights.policy
        actions = state.noise.shape[1]
        means = (*layers, (weight[:, :actions], bias[:actions]))
        return Policy(means, mean, scale, None, task.action, self.activation, squash=True)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Weights:
    """The learnt numbers: layers of the policy, whose outputs are means and then logarithms of
    deviations; of two critics, whose leaves have a leading axis of 2; and the logarithm of the
    temperature.
    """

    # JAX rebuilds the class with stacked arrays and placeholders, which have other shapes.
    __no_type_check__ = True
    policy: Layers
    critics: Layers
    log_temperature: Float[Array, ""]


class SACState(NamedTuple):
    """The state between two updates: `weights` and `moments` of the optimizer; `slow`, the critics
    from which targets are computed; `statistics` of the observations so far; the present
    `episodes`; the `noise` of the next actions, in units of the policy's deviation; the `buffer` of
    transitions; the random `key` of the next update; the number of updates `done`, and of all
    `updates`.
    """

    weights: Weights
    slow: Layers
    moments: PyTree
    statistics: Statistics
    episodes: experience.Episodes
    noise: Float[Array, "environments actions"]
    buffer: ReplayBuffer
    key: Key[Array, ""]
    done: Int[Array, ""]
    updates: Int[Array, ""]


def squash_log_prob(
    mean: Float[Array, "*#batch actions"],
    log_std: Float[Array, "*#batch actions"],
    noise: Float[Array, "*#batch actions"],
) -> Float[Array, "*batch"]:
    """Compute the log density of `tanh(mean + exp(log_std) * noise)`, a vector in the unit cube.

    Source: Haarnoja et al. (2018), appendix C, eq. 26; the derivative of tanh at u is `1 -
    tanh(u)^2 = 4 / (e^u + e^-u)^2`, computed here by its logarithm, which avoids cancellation.
    """
    u = mean + jnp.exp(log_std) * noise
    normal = -jnp.square(noise) / 2 - log_std - jnp.log(2 * jnp.pi) / 2
    log_derivative = 2 * (jnp.log(2.0) - u - jax.nn.softplus(-2 * u))
    return jnp.sum(normal - log_derivative, axis=-1)


def act(
    sac: SAC, task: Task, state: SACState, noise: Float[Array, "environments actions"],
    keys: Key[Array, "environments 2"],
) -> tuple[SACState, experience.Transition, Float[Array, "environments k"]]:  # fmt: skip
    """Take one step of each environment, and write the transitions to the buffer."""
    observation = jax.vmap(task.observe)(state.episodes.state)
    normalised = normalise(state.statistics, observation, sac.normalise)
    mean, log_std = _gaussian(sac, state.weights.policy, normalised)
    unit = jnp.tanh(mean + jnp.exp(log_std) * state.noise)
    assert isinstance(task.action, Continuous)
    episodes, transition = experience.advance(
        task, state.episodes, scale_to_range(task.action, unit), keys
    )
    new = StoredTransitions(
        observation, transition.next_observation, unit, transition.reward,
        transition.ends.terminated,
    )  # fmt: skip
    # A new episode begins with noise of its own.
    rho = jnp.where(transition.over, 0.0, sac.correlation)[:, None]
    after = state._replace(
        episodes=episodes, buffer=replay_buffer.add(state.buffer, new),
        noise=rho * state.noise + jnp.sqrt(1 - rho**2) * noise,
    )  # fmt: skip
    return after, transition, observation


def _learn(sac: SAC, state: SACState, rate: Float[Array, ""], key: Key[Array, ""]) -> SACState:
    """Take `learnings` steps of Adam, each on a batch of its own."""
    actions, optimizer = state.noise.shape[1], adam()

    def one_step(
        carry: tuple[Weights, Layers, PyTree], key: Key[Array, ""]
    ) -> tuple[tuple[Weights, Layers, PyTree], None]:
        weights, slow, moments = carry
        batch_key, noise_key = jax.random.split(key)
        batch = replay_buffer.sample(state.buffer, batch_key, sac.batch, actions)
        batch = batch._replace(
            observation=normalise(state.statistics, batch.observation, sac.normalise),
            next_observation=normalise(state.statistics, batch.next_observation, sac.normalise),
        )
        noise = jax.random.normal(noise_key, (2, sac.batch, actions))
        gradient = jax.grad(total_loss)(weights, sac, slow, batch, noise)
        direction, moments = optimizer.update(gradient, moments)
        weights = jax.tree.map(lambda w, d: w - rate * d, weights, direction)
        slow = jax.tree.map(lambda s, f: s + sac.target_rate * (f - s), slow, weights.critics)
        return (weights, slow, moments), None

    carry = (state.weights, state.slow, state.moments)
    keys = jax.random.split(key, sac.learnings)
    (weights, slow, moments), _ = jax.lax.scan(one_step, carry, keys)
    return state._replace(weights=weights, slow=slow, moments=moments)


def total_loss(
    weights: Weights, sac: SAC, slow: Layers, batch: StoredTransitions,
    noise: Float[Array, "2 batch actions"],
) -> Float[Array, ""]:  # fmt: skip
    """Sum three losses, each with a gradient only for its own part of the weights."""
    fixed = jax.lax.stop_gradient(weights)
    temperature = jnp.exp(fixed.log_temperature)
    mean, log_std = _gaussian(sac, fixed.policy, batch.next_observation)
    next_action = jnp.tanh(mean + jnp.exp(log_std) * noise[0])
    next_value = jnp.min(_values(sac, slow, batch.next_observation, next_action), axis=0)
    next_value = next_value - temperature * squash_log_prob(mean, log_std, noise[0])  # eq. 3
    discount = sac.discount * (1.0 - batch.terminated)
    target = jax.lax.stop_gradient(sac.reward_scale * batch.reward + discount * next_value)
    value = _values(sac, weights.critics, batch.observation, batch.action)
    value_error = jnp.sum(jnp.mean(jnp.square(value - target), axis=1)) / 2  # eq. 5
    mean, log_std = _gaussian(sac, weights.policy, batch.observation)
    action = jnp.tanh(mean + jnp.exp(log_std) * noise[1])
    log_probability = squash_log_prob(mean, log_std, noise[1])
    worth = jnp.min(_values(sac, fixed.critics, batch.observation, action), axis=0)
    policy_loss = jnp.mean(temperature * log_probability - worth)  # eq. 9
    wanted = sac.target_entropy * noise.shape[2]
    excess = jax.lax.stop_gradient(jnp.mean(-log_probability) - wanted)
    return value_error + policy_loss + weights.log_temperature * excess  # eq. 18, of the logarithm


def _gaussian(
    sac: SAC, layers: Layers, observation: Float[Array, "batch k"]
) -> tuple[Float[Array, "batch actions"], Float[Array, "batch actions"]]:
    mean, log_std = jnp.split(network(layers, observation, sac.activation), 2, axis=-1)
    return mean, jnp.clip(log_std, *LOG_STD)


def _values(
    sac: SAC, critics: Layers, observation: Float[Array, "batch k"],
    action: Float[Array, "batch actions"],
) -> Float[Array, "2 batch"]:  # fmt: skip
    both = jnp.concatenate([observation, action], axis=-1)
    return jax.vmap(lambda layers: network(layers, both, sac.activation)[:, 0])(critics)
