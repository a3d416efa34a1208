"""Soft actor-critic: a random policy for continuous actions that earns much and stays random.

    sac = SAC(learning_rate=1e-3, hidden=(32, 32))
    training = sac.init(task, key, updates=200)
    training, progress = sac.step(task, training)

The policy that comes out is the mean action through tanh, without the noise.

Source: Haarnoja et al., Soft actor-critic algorithms and applications (2018). Exploration with
noise that lasts: Eberhard et al., Pink noise is all you need (2023), here an autoregressive
(Ornstein-Uhlenbeck) process whose marginal is the policy's own Gaussian.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from verifai_jax.rl.algorithm import Number, Progress, check_values, shape
from verifai_jax.rl.experience import (
    Episodes,
    Transition,
    advance,
    begin,
    observation_size,
    progress,
)
from verifai_jax.rl.observations import Seen, normalised, normaliser, watch
from verifai_jax.rl.policy import ACTIVATIONS, Layers, Policy, in_range, network, new_layers
from verifai_jax.rl.replay_buffer import Remembered, ReplayBuffer, draw, empty, remember
from verifai_jax.rl.task.task import Continuous, Task

# Beyond these a Gaussian under tanh is a constant, or a coin that shows only the two ends.
LOG_STD = (-10.0, 2.0)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SAC:
    """Hyper-parameters.

    - `learning_rate`: of Adam, for the policy, the critics and the temperature; falls linearly to
      0 over the training if `anneal`.
    - `discount`: of future rewards, in `[0, 1]`.
    - `target_rate`: how far the slow critics move to the fast ones in a step of learning.
    - `temperature`: weight of entropy against reward at first; then it follows `target_entropy`,
      which is wanted on average for each number of an action (of units of half its range).
    - `correlation`: of the noise between one step and the next, in `[0, 1)`; 0 is white noise.
      0.9 and more reach what single random steps never do (the hill of mountain car).
    - `warmup`: environment steps before any learning.
    - `reward_scale`: rewards are multiplied by it; values of a few units are learnt best, and the
      first temperature is one for these.
    - `environments`, `horizon`: steps of experience in an update, wide and long.
    - `learnings`: steps of learning after each step of all environments, from `batch` transitions.
    - `capacity`: transitions that are remembered, a multiple of `environments`.
    - `hidden`, `value_hidden`: widths of the policy's and the critics' hidden layers.
      `activation`: between all of them, "tanh" or "relu".
    - `normalise`: observations by their running mean and deviation.
    """

    actions: ClassVar[tuple[type, ...]] = (Continuous,)

    learning_rate: Number = 1e-3
    discount: Number = 0.99
    target_rate: Number = 0.01
    temperature: Number = 0.2
    target_entropy: Number = -1.0
    correlation: Number = 0.0
    warmup: int | Int[Array, ""] = 1_000
    reward_scale: Number = 0.1
    environments: int = shape(8)
    horizon: int = shape(32)
    learnings: int = shape(1)
    batch: int = shape(128)
    capacity: int = shape(50_000)
    hidden: tuple[int, ...] = shape((64, 64))
    value_hidden: tuple[int, ...] = shape((64, 64))
    activation: str = shape("relu")
    normalise: bool = shape(False)
    anneal: bool = shape(False)

    @property
    def steps_per_update(self) -> int:
        """Environment steps of one update."""
        return self.environments * self.horizon

    def check(self) -> None:
        """Refuse values that cannot train.

        **Raises:** `ValueError`, naming the hyper-parameter and its value.
        """
        positive = ("learning_rate", "temperature", "reward_scale")
        check_values(self, positive, lambda value: float(value) > 0, "positive")
        check_values(self, ["discount"], lambda value: 0 <= float(value) <= 1, "between 0 and 1")
        check_values(
            self, ["target_rate"], lambda value: 0 < float(value) <= 1, "above 0 and at most 1"
        )
        check_values(
            self, ["correlation"], lambda value: 0 <= float(value) < 1, "at least 0 and below 1"
        )
        check_values(self, ["warmup"], lambda value: int(value) >= 0, "at least 0")
        counts = ("environments", "horizon", "learnings", "batch", "capacity")
        check_values(self, counts, lambda value: value >= 1, "at least 1")
        wanted = f"a multiple of environments = {self.environments}"
        check_values(self, ["capacity"], lambda value: value % self.environments == 0, wanted)
        widths = ("hidden", "value_hidden")
        check_values(self, widths, lambda value: all(w >= 1 for w in value), "positive widths")
        known = " or ".join(ACTIVATIONS)
        check_values(self, ["activation"], lambda value: value in ACTIVATIONS, known)

    def init(self, task: Task, key: Key[Array, ""], updates: int | Int[Array, ""]) -> "Training":
        """The state before the first of `updates` updates."""
        policy_key, critic_key, reset_key, noise_key, key = jax.random.split(key, 5)
        episodes = begin(task, reset_key, self.environments)
        size, actions = observation_size(task, episodes), _count(task)

        def critic(key: Key[Array, ""]) -> Layers:
            return new_layers(key, (size + actions, *self.value_hidden, 1), gain=1.0)

        weights = Weights(
            # Mean 0 and deviation 1 at first: under tanh nearly uniform over the range.
            policy=new_layers(policy_key, (size, *self.hidden, 2 * actions), gain=0.01),
            critics=jax.vmap(critic)(jax.random.split(critic_key, 2)),
            log_temperature=jnp.log(jnp.asarray(self.temperature, jnp.float32)),
        )
        return Training(
            weights=weights,
            slow=weights.critics,
            moments=_optimizer().init(weights),
            seen=Seen.nothing(size),
            episodes=episodes,
            noise=jax.random.normal(noise_key, (self.environments, actions)),
            buffer=empty(self.capacity, size, actions),
            key=key,
            done=jnp.int32(0),
            updates=jnp.int32(updates),
        )

    def step(self, task: Task, state: "Training") -> tuple["Training", Progress]:
        """`horizon` times a step of each environment, and some steps of learning after it."""
        act_key, learn_key, key = jax.random.split(state.key, 3)
        rate = _rate(self, state)

        def one(carry: Any, drawn: Any) -> Any:
            at, (noise, step_key, learn_key) = drawn
            carry, transition, observation = _act(self, task, carry, noise, step_key)
            taken = (state.done * self.horizon + at + 1) * self.environments
            carry = jax.lax.cond(
                taken >= self.warmup,
                lambda: _learn(self, carry, rate, learn_key),
                lambda: carry,
            )
            return carry, (transition, observation)

        noise_key, step_key = jax.random.split(act_key)
        drawn = (
            # All random numbers of the update at once: in the loop each draw would cost its own.
            jax.random.normal(noise_key, (self.horizon, *state.noise.shape)),
            jax.random.split(step_key, self.horizon),
            jax.random.split(learn_key, self.horizon),
        )
        after, (transition, observation) = jax.lax.scan(
            one, state, (jnp.arange(self.horizon), drawn)
        )
        seen = watch(state.seen, observation) if self.normalise else state.seen
        return after._replace(seen=seen, key=key, done=state.done + 1), progress(transition)

    def policy(self, task: Task, state: "Training") -> Policy:
        """The policy as learnt so far, without exploration."""
        mean, scale = normaliser(state.seen) if self.normalise else (None, None)
        *layers, (weight, bias) = state.weights.policy
        actions = _count(task)
        means = (*layers, (weight[:, :actions], bias[:actions]))
        return Policy(means, mean, scale, None, task.action, self.activation, squash=True)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Weights:
    """What is learnt: the policy (means, then log deviations), two critics, the temperature.

    The leaves of `critics` have a leading axis of 2.
    """

    policy: Layers
    critics: Layers
    log_temperature: Float[Array, ""]


class Training(NamedTuple):
    """Everything that goes from one update to the next.

    - `slow`: the critics that targets are made of.
    - `noise`: in units of the policy's deviation.
    """

    weights: Weights
    slow: Layers
    moments: Any
    seen: Seen
    episodes: Episodes
    noise: Float[Array, "environments actions"]
    buffer: ReplayBuffer
    key: Key[Array, ""]
    done: Int[Array, ""]
    updates: Int[Array, ""]


def squash_log_prob(
    mean: Float[Array, "*batch actions"],
    log_std: Float[Array, "*batch actions"],
    noise: Float[Array, "*batch actions"],
) -> Float[Array, "*batch"]:
    """Log density of `tanh(mean + exp(log_std) * noise)`, a vector in the unit cube.

    Source: Haarnoja et al. (2018), appendix C, eq. 26; the derivative of tanh at u is
    `1 - tanh(u)^2 = 4 / (e^u + e^-u)^2`, here by its logarithm, which never cancels.
    """
    u = mean + jnp.exp(log_std) * noise
    normal = -jnp.square(noise) / 2 - log_std - jnp.log(2 * jnp.pi) / 2
    slope = 2 * (jnp.log(2.0) - u - jax.nn.softplus(-2 * u))
    return jnp.sum(normal - slope, axis=-1)


def _act(
    sac: SAC, task: Task, training: Training, noise: Array, key: Key[Array, ""]
) -> tuple[Training, Transition, Array]:
    """One step of each environment, and what came of it into the buffer."""
    observation = jax.vmap(task.observe)(training.episodes.state)
    look = normalised(training.seen, observation, sac.normalise)
    mean, log_std = _gaussian(sac, training.weights.policy, look)
    unit = jnp.tanh(mean + jnp.exp(log_std) * training.noise)
    assert isinstance(task.action, Continuous)
    episodes, transition = advance(task, training.episodes, in_range(task.action, unit), key)
    new = Remembered(
        observation,
        transition.next_observation,
        unit,
        transition.reward,
        transition.ends.terminated,
    )
    # A new episode begins with noise of its own.
    rho = jnp.where(transition.over, 0.0, sac.correlation)[:, None]
    after = training._replace(
        episodes=episodes,
        buffer=remember(training.buffer, new),
        noise=rho * training.noise + jnp.sqrt(1 - rho**2) * noise,
    )
    return after, transition, observation


def _learn(sac: SAC, training: Training, rate: Float[Array, ""], key: Key[Array, ""]) -> Training:
    """`learnings` steps of Adam, each on a batch of its own."""
    actions = training.noise.shape[1]

    def one(carry: Any, key: Key[Array, ""]) -> Any:
        weights, slow, moments = carry
        batch_key, noise_key = jax.random.split(key)
        batch = draw(training.buffer, batch_key, sac.batch, actions)
        batch = batch._replace(
            observation=normalised(training.seen, batch.observation, sac.normalise),
            next_observation=normalised(training.seen, batch.next_observation, sac.normalise),
        )
        noise = jax.random.normal(noise_key, (2, sac.batch, actions))
        gradient = jax.grad(_loss)(weights, sac, slow, batch, noise)
        direction, moments = _optimizer().update(gradient, moments)
        weights = jax.tree.map(lambda w, d: w - rate * d, weights, direction)
        slow = jax.tree.map(lambda s, f: s + sac.target_rate * (f - s), slow, weights.critics)
        return (weights, slow, moments), None

    carry = (training.weights, training.slow, training.moments)
    keys = jax.random.split(key, sac.learnings)
    (weights, slow, moments), _ = jax.lax.scan(one, carry, keys)
    return training._replace(weights=weights, slow=slow, moments=moments)


def _loss(
    weights: Weights,
    sac: SAC,
    slow: Layers,
    batch: Remembered,
    noise: Float[Array, "2 batch actions"],
) -> Float[Array, ""]:
    """The sum of three losses, each with a gradient for its own part of the weights only."""
    fixed = jax.lax.stop_gradient(weights)
    temperature = jnp.exp(fixed.log_temperature)

    mean, log_std = _gaussian(sac, fixed.policy, batch.next_observation)
    next_action = jnp.tanh(mean + jnp.exp(log_std) * noise[0])
    next_value = jnp.min(_values(sac, slow, batch.next_observation, next_action), axis=0)
    next_value = next_value - temperature * squash_log_prob(mean, log_std, noise[0])  # eq. 3
    goes_on = sac.discount * (1.0 - batch.terminated)
    target = jax.lax.stop_gradient(sac.reward_scale * batch.reward + goes_on * next_value)
    value = _values(sac, weights.critics, batch.observation, batch.action)
    value_error = jnp.sum(jnp.mean(jnp.square(value - target), axis=1)) / 2  # eq. 5

    mean, log_std = _gaussian(sac, weights.policy, batch.observation)
    action = jnp.tanh(mean + jnp.exp(log_std) * noise[1])
    log_probability = squash_log_prob(mean, log_std, noise[1])
    worth = jnp.min(_values(sac, fixed.critics, batch.observation, action), axis=0)
    surprise = jnp.mean(temperature * log_probability - worth)  # eq. 9

    wanted = sac.target_entropy * noise.shape[2]
    excess = jax.lax.stop_gradient(jnp.mean(-log_probability) - wanted)
    return value_error + surprise + weights.log_temperature * excess  # eq. 18, of the logarithm


def _gaussian(sac: SAC, layers: Layers, look: Array) -> tuple[Array, Array]:
    mean, log_std = jnp.split(network(layers, look, sac.activation), 2, axis=-1)
    return mean, jnp.clip(log_std, *LOG_STD)


def _values(
    sac: SAC, critics: Layers, look: Float[Array, "batch k"], action: Float[Array, "batch actions"]
) -> Float[Array, "2 batch"]:
    both = jnp.concatenate([look, action], axis=-1)
    return jax.vmap(lambda layers: network(layers, both, sac.activation)[:, 0])(critics)


def _rate(sac: SAC, training: Training) -> Float[Array, ""]:
    left = 1.0 - training.done * (1.0 / training.updates) if sac.anneal else 1.0
    return jnp.asarray(sac.learning_rate * left)


def _optimizer() -> Any:
    import optax

    return optax.scale_by_adam(eps=1e-5)


def _count(task: Task) -> int:
    assert isinstance(task.action, Continuous)
    return task.action.size
