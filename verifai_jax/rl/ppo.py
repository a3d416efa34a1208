"""Proximal policy optimisation: experience of many environments, a few clipped passes over it.

    ppo = PPO(learning_rate=1e-3, hidden=(32, 32))
    training = ppo.init(task, key, updates=200)
    training, progress = ppo.step(task, training)

Source: Schulman et al., Proximal policy optimization algorithms (2017).
"""

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from verifai_jax.rl.advantage import Ends, advantages
from verifai_jax.rl.algorithm import Number, Progress, check_values, shape
from verifai_jax.rl.experience import (
    Episodes,
    Transition,
    begin,
    observation_size,
    progress,
)
from verifai_jax.rl.observations import Seen, normalised, normaliser, watch
from verifai_jax.rl.policy import Layers, Policy, in_range, network, new_layers
from verifai_jax.rl.shuffling import permutation
from verifai_jax.rl.task.task import Action, Continuous, Discrete, Task


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PPO:
    """Hyper-parameters.

    - `learning_rate`: of Adam; falls linearly to 0 over the training if `anneal`.
    - `discount`, `gae_lambda`: of future rewards, and of longer looks ahead, in `[0, 1]`.
    - `clip`: how far the ratio of new to old probability may leave 1.
    - `entropy`, `value_weight`: weights in the loss.
    - `max_gradient`: norm to which gradients are cut.
    - `environments`, `horizon`: steps of experience in an update, wide and long.
    - `epochs`, `minibatches`: passes over them, and parts in a pass.
    - `hidden`, `value_hidden`: widths of the policy's and the critic's hidden layers.
    - `normalise`: observations by their running mean and deviation.
    """

    actions: ClassVar[tuple[type, ...]] = (Discrete, Continuous)

    learning_rate: Number = 2.5e-4
    discount: Number = 0.99
    gae_lambda: Number = 0.95
    clip: Number = 0.2
    entropy: Number = 0.01
    value_weight: Number = 0.5
    max_gradient: Number = 0.5
    environments: int = shape(8)
    horizon: int = shape(128)
    epochs: int = shape(4)
    minibatches: int = shape(4)
    hidden: tuple[int, ...] = shape((64, 64))
    value_hidden: tuple[int, ...] = shape((64, 64))
    normalise: bool = shape(False)
    anneal: bool = shape(True)

    @property
    def steps_per_update(self) -> int:
        """Environment steps of one update."""
        return self.environments * self.horizon

    def check(self) -> None:
        """Refuse values that cannot train.

        **Raises:** `ValueError`, naming the hyper-parameter and its value.
        """
        positive = ("learning_rate", "clip", "max_gradient")
        check_values(self, positive, lambda value: float(value) > 0, "positive")
        fractions = ("discount", "gae_lambda")
        check_values(self, fractions, lambda value: 0 <= float(value) <= 1, "between 0 and 1")
        weights = ("entropy", "value_weight")
        check_values(self, weights, lambda value: float(value) >= 0, "at least 0")
        counts = ("environments", "horizon", "epochs", "minibatches")
        check_values(self, counts, lambda value: value >= 1, "at least 1")
        steps = self.steps_per_update
        wanted = f"a divisor of environments * horizon = {steps}"
        check_values(self, ["minibatches"], lambda value: steps % value == 0, wanted)
        widths = ("hidden", "value_hidden")
        check_values(self, widths, lambda value: all(w >= 1 for w in value), "positive widths")

    def init(self, task: Task, key: Key[Array, ""], updates: int | Int[Array, ""]) -> "Training":
        """The state before the first of `updates` updates."""
        policy_key, critic_key, reset_key, key = jax.random.split(key, 4)
        episodes = begin(task, reset_key, self.environments)
        size = observation_size(task, episodes)
        discrete = isinstance(task.action, Discrete)
        outputs = task.action.n if isinstance(task.action, Discrete) else task.action.size
        weights = Weights(
            # A nearly uniform first policy, and a critic that starts at unit scale.
            policy=new_layers(policy_key, (size, *self.hidden, outputs), gain=0.01),
            critic=new_layers(critic_key, (size, *self.value_hidden, 1), gain=1.0),
            log_std=None if discrete else jnp.zeros(outputs),
        )
        return Training(
            weights=weights,
            moments=_optimizer(self).init(weights),
            seen=Seen.nothing(size),
            episodes=episodes,
            key=key,
            done=jnp.int32(0),
            updates=jnp.int32(updates),
        )

    def step(self, task: Task, state: "Training") -> tuple["Training", Progress]:
        """Collect `horizon` steps of each environment and learn from them."""
        collect_key, learn_key, key = jax.random.split(state.key, 3)
        episodes, experience = _collect(self, task, state, collect_key)
        seen = watch(state.seen, experience.observation) if self.normalise else state.seen
        weights, moments = _learn(self, task, state, experience, learn_key)
        after = Training(weights, moments, seen, episodes, key, state.done + 1, state.updates)
        return after, progress(experience.transition)

    def policy(self, task: Task, state: "Training") -> Policy:
        """The policy as learnt so far, without exploration."""
        mean, scale = normaliser(state.seen) if self.normalise else (None, None)
        return Policy(state.weights.policy, mean, scale, state.weights.log_std, task.action)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Weights:
    """What is learnt: the policy's layers, the critic's, and the width of exploration."""

    policy: Layers
    critic: Layers
    log_std: Float[Array, " size"] | None


class Training(NamedTuple):
    """Everything that goes from one update to the next."""

    weights: Weights
    moments: Any
    seen: Seen
    episodes: Episodes
    key: Key[Array, ""]
    done: Int[Array, ""]
    updates: Int[Array, ""]


class Experience(NamedTuple):
    """One step of one environment."""

    observation: Float[Array, " k"]
    action: Array
    outputs: Float[Array, " outputs"]
    transition: Transition


def _collect(
    ppo: PPO, task: Task, training: Training, key: Key[Array, ""]
) -> tuple[Episodes, Experience]:
    """Experience `[environments, horizon]` under the present policy, resetting as episodes end."""
    log_std = training.weights.log_std

    def step(carry: Any, drawn: Any) -> Any:
        state, age, total = carry
        noise, step_key, reset_key = drawn
        observation = task.observe(state)
        outputs = network(
            training.weights.policy, normalised(training.seen, observation, ppo.normalise)
        )
        action = _explore(task.action, outputs, log_std, noise)
        taken = action if isinstance(task.action, Discrete) else in_range(task.action, action)
        after, reward, terminated = task.step(step_key, state, taken)
        age, total = age + 1, total + reward
        ends = Ends(terminated, age >= task.time_limit)
        over = ends.terminated | ends.truncated
        seen = Experience(
            observation=observation,
            action=action,
            outputs=outputs,
            transition=Transition(
                jnp.asarray(reward, jnp.float32), task.observe(after), ends, total
            ),
        )
        fresh = (task.reset(reset_key), jnp.int32(0), jnp.zeros(()))
        return jax.tree.map(
            lambda new, old: jnp.where(over, new, old), fresh, (after, age, total)
        ), seen

    def draw(key: Key[Array, ""]) -> Any:
        action_key, step_key, reset_key = jax.random.split(key, 3)
        return _noise(task.action, action_key), step_key, reset_key

    def one(episode: Any, key: Key[Array, ""]) -> Any:
        # All at once: random bits of a few lanes at a time would cost as much as the network.
        drawn = jax.vmap(draw)(jax.random.split(key, ppo.horizon))
        return jax.lax.scan(step, episode, drawn)

    keys = jax.random.split(key, ppo.environments)
    episodes, experience = jax.vmap(one)(tuple(training.episodes), keys)
    return Episodes(*episodes), experience


def _learn(
    ppo: PPO, task: Task, training: Training, experience: Experience, key: Key[Array, ""]
) -> tuple[Weights, Any]:
    """A few epochs of clipped policy and value steps on one stretch of experience."""
    look = jax.vmap(jax.vmap(lambda o: normalised(training.seen, o, ppo.normalise)))
    transition = experience.transition
    observation, next_observation = look(experience.observation), look(transition.next_observation)
    critic = jax.vmap(jax.vmap(lambda o: network(training.weights.critic, o)[0]))
    value = critic(observation)
    estimate = jax.vmap(advantages, in_axes=(0, 0, 0, 0, None, None))
    advantage = estimate(
        transition.reward,
        value,
        critic(next_observation),
        transition.ends,
        ppo.discount,
        ppo.gae_lambda,
    )
    log_std = training.weights.log_std
    log_probability = jax.vmap(jax.vmap(lambda o, a: _log_probability(task.action, o, log_std, a)))(
        experience.outputs, experience.action
    )
    batch = (
        observation,
        experience.action,
        log_probability,
        advantage,
        advantage + value,
    )
    batch = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), batch)
    optimizer = _optimizer(ppo)
    left = 1.0 - training.done * (1.0 / training.updates) if ppo.anneal else 1.0
    rate = ppo.learning_rate * left

    def minibatch(carry: Any, part: Any) -> Any:
        weights, moments = carry
        gradient = jax.grad(_loss)(weights, ppo, task.action, part)
        direction, moments = optimizer.update(gradient, moments)
        weights = jax.tree.map(lambda w, d: w - rate * d, weights, direction)
        return (weights, moments), None

    def epoch(carry: Any, key: Key[Array, ""]) -> Any:
        order = permutation(key, ppo.steps_per_update)
        parts = jax.tree.map(
            lambda leaf: leaf[order].reshape(ppo.minibatches, -1, *leaf.shape[1:]), batch
        )
        return jax.lax.scan(minibatch, carry, parts)

    start = (training.weights, training.moments)
    return jax.lax.scan(epoch, start, jax.random.split(key, ppo.epochs))[0]


def _loss(weights: Weights, ppo: PPO, action: Action, part: Any) -> Float[Array, ""]:
    observation, taken, old_log_probability, advantage, target = part
    outputs = jax.vmap(lambda o: network(weights.policy, o))(observation)
    value = jax.vmap(lambda o: network(weights.critic, o)[0])(observation)
    log_probability = jax.vmap(lambda o, a: _log_probability(action, o, weights.log_std, a))(
        outputs, taken
    )
    advantage = (advantage - jnp.mean(advantage)) / (jnp.std(advantage) + 1e-8)
    ratio = jnp.exp(log_probability - old_log_probability)
    clipped = jnp.clip(ratio, 1 - ppo.clip, 1 + ppo.clip)
    surrogate = jnp.mean(jnp.minimum(ratio * advantage, clipped * advantage))  # eq. 7
    value_error = jnp.mean(jnp.square(value - target)) / 2
    entropy = jnp.mean(jax.vmap(lambda o: _entropy(action, o, weights.log_std))(outputs))
    return -surrogate + ppo.value_weight * value_error - ppo.entropy * entropy  # eq. 9


def _optimizer(ppo: PPO) -> Any:
    import optax

    return optax.chain(
        optax.clip_by_global_norm(ppo.max_gradient),  # pyright: ignore[reportArgumentType]
        optax.scale_by_adam(eps=1e-5),
    )


def _noise(action: Action, key: Key[Array, ""]) -> Array:
    """What an action is drawn with: the same whatever the network says."""
    if isinstance(action, Discrete):
        return jax.random.gumbel(key, (action.n,))
    return jax.random.normal(key, (action.size,))


def _explore(action: Action, outputs: Array, log_std: Any, noise: Array) -> Array:
    """A draw from the distribution that the outputs describe (Gumbel-max if discrete)."""
    if isinstance(action, Discrete):
        return jnp.argmax(noise + outputs).astype(jnp.int32)
    return outputs + jnp.exp(log_std) * noise


def _log_probability(action: Action, outputs: Array, log_std: Any, taken: Array) -> Array:
    if isinstance(action, Discrete):
        # A choice instead of an index, whose derivative would scatter row by row.
        chosen = jnp.arange(action.n) == taken
        return jnp.sum(jnp.where(chosen, jax.nn.log_softmax(outputs), 0.0))
    standard = (taken - outputs) / jnp.exp(log_std)
    return -jnp.sum(jnp.square(standard) / 2 + log_std + jnp.log(2 * jnp.pi) / 2)


def _entropy(action: Action, outputs: Array, log_std: Any) -> Array:
    if isinstance(action, Continuous):
        return jnp.sum(log_std + (jnp.log(2 * jnp.pi) + 1) / 2)
    log_probability = jax.nn.log_softmax(outputs)
    return -jnp.sum(jnp.exp(log_probability) * log_probability)
