"""Parallelised Q network: Q(lambda) over many environments, with no replay and no target network.

The policy's outputs are the values of the actions (times `reward_scale`).

Source: Gallici et al., Simplifying deep temporal difference learning (2024), algorithm 1. Their
layer normalisation is left out: with low-dimensional observations bounded units (tanh) do not need
it, and a policy stays a plain network. The exploration, which holds random actions, is from Dabney
et al., Temporally extended epsilon-greedy exploration (2021), with geometric durations.
"""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, PyTree

from verifai_jax.addons.rl import experience
from verifai_jax.addons.rl.advantage import Ends
from verifai_jax.addons.rl.algorithm import Number, Progress, Vectorised, check_values, static_field
from verifai_jax.addons.rl.experience import Episodes, Transition, advance, step_keys
from verifai_jax.addons.rl.observations import Statistics, mean_and_scale, normalise, update
from verifai_jax.addons.rl.on_policy import adam, annealed, minibatch_epochs, minibatch_network
from verifai_jax.addons.rl.policy import Layers, Policy, network, new_layers
from verifai_jax.addons.rl.task.task import Task
from verifai_jax.systems.actions import Discrete


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PQN(Vectorised):
    """Parallelised Q network, for discrete actions, with its hyper-parameters.

    - `learning_rate`: the learning rate of Adam; falls linearly to 0 over the training if `anneal`.
    - `discount`, `q_lambda`: the discount of future rewards, and the weight of longer look-aheads,
      in `[0, 1]`.
    - `epsilon_start`, `epsilon_end`: share of exploring steps, which changes linearly from one to
      the other over the share `exploration` of the training.
    - `hold`: mean number of steps for which a random action is kept, at least 1. Long holds find
      states that single random steps never reach (the hill of mountain car).
    - `reward_scale`: a factor on rewards; values around 1 are learnt best.
    - `max_gradient`: norm to which gradients are clipped.
    - `environments`, `horizon`: number of environments, and of steps of each, in an update.
    - `epochs`, `minibatches`: number of passes over these steps, and of minibatches in a pass.
    - `hidden`: widths of the hidden layers. `activation`: their activation, "tanh" or "relu".
    - `normalise`: whether to normalise observations by their running mean and deviation.
    """

    # JAX rebuilds the class with stacked numbers and placeholders in place of numbers.
    __no_type_check__ = True
    actions: ClassVar[tuple[type, ...]] = (Discrete,)
    learning_rate: Number = 2e-3
    discount: Number = 0.99
    q_lambda: Number = 0.9
    epsilon_start: Number = 1.0
    epsilon_end: Number = 0.05
    exploration: Number = 0.3
    hold: Number = 1.0
    reward_scale: Number = 0.1
    max_gradient: Number = 10.0
    environments: int = static_field(16)
    horizon: int = static_field(32)
    epochs: int = static_field(2)
    minibatches: int = static_field(8)
    hidden: tuple[int, ...] = static_field((64, 64))
    activation: str = static_field("tanh")
    normalise: bool = static_field(True)
    anneal: bool = static_field(True)

    def check(self) -> None:
        """Refuse invalid hyper-parameters; see `Algorithm.check`."""
        positive = ("learning_rate", "exploration", "reward_scale", "max_gradient")
        check_values(self, positive, "positive")
        fractions = ("discount", "q_lambda", "epsilon_start", "epsilon_end")
        check_values(self, fractions, "between 0 and 1")
        check_values(self, ["hold"], "at least 1")
        self.check_shapes("epochs", "minibatches")

    def init(self, task: Task, key: Key[Array, ""], updates: int | Int[Array, ""]) -> "PQNState":
        """Make the state before the first of `updates` updates."""
        weights_key, reset_key, key = jax.random.split(key, 3)
        episodes = experience.start_episodes(task, reset_key, self.environments)
        size, count = experience.sizes(task, episodes)
        layers = new_layers(weights_key, (size, *self.hidden, count), gain=0.01)
        return PQNState(
            layers=layers, moments=adam(self.max_gradient).init(layers),
            statistics=Statistics.initial(size), episodes=episodes,
            held=jnp.full(self.environments, -1, jnp.int32), key=key, done=jnp.int32(0),
            updates=jnp.int32(updates),
        )  # fmt: skip

    def step(self, task: Task, state: "PQNState") -> tuple["PQNState", Progress]:
        """Collect `horizon` steps of each environment and learn from them.

        **Returns:** the state after it, and the episodes that ended in it.
        """
        collect_key, learn_key, key = jax.random.split(state.key, 3)
        episodes, held, seen = _collect(self, task, state, collect_key)
        layers, moments = _learn(self, state, seen, learn_key)
        statistics = update(state.statistics, seen.observation, self.normalise)
        after = PQNState(
            layers, moments, statistics, episodes, held, key, state.done + 1, state.updates
        )
        return after, experience.progress(seen.transition)

    def policy(self, task: Task, state: "PQNState") -> Policy:
        """Return the policy learnt so far, without exploration."""
        mean, scale = mean_and_scale(state.statistics) if self.normalise else (None, None)
        return Policy(state.layers, mean, scale, None, task.action, self.activation)


class PQNState(NamedTuple):
    """The state between two updates: the network's `layers` and the optimizer's `moments`;
    `statistics` of the observations so far; the present `episodes`; `held`, the random action that
    an environment is repeating, -1 if it is greedy; the random `key` of the next update; the number
    of updates `done`, and of all `updates`.
    """

    layers: Layers
    moments: PyTree
    statistics: Statistics
    episodes: Episodes
    held: Int[Array, " environments"]
    key: Key[Array, ""]
    done: Int[Array, ""]
    updates: Int[Array, ""]


class Experience(NamedTuple):
    """Steps of the environments: observations, indices of actions, and what these led to."""

    observation: Float[Array, "horizon environments k"]
    action: Int[Array, "horizon environments"]
    transition: Transition


class Minibatch(NamedTuple):
    """Steps to learn from: observations, normalised if the algorithm does so, indices of actions,
    and targets for the values of these.
    """

    observation: Float[Array, "*rows k"]
    action: Int[Array, "*rows"]
    target: Float[Array, "*rows"]


def q_lambda_targets(
    reward: Float[Array, "time *lanes"], next_value: Float[Array, "time *lanes"], ends: Ends,
    discount: Number, q_lambda: Number,
) -> Float[Array, "time *lanes"]:  # fmt: skip
    """Compute targets for the values of the actions taken, `[time, *lanes]`.

    **Arguments:**
    - `next_value`: the value of the best action in the state that each step led to, *before* any
      reset.
    - `ends`: the steps that ended an episode.
    - `discount`, `q_lambda`: as in `PQN`.

    Source: Gallici et al. (2024), section 4 (Peng's Q(lambda)); look-aheads end with the episode.
    """
    discount = discount * (1.0 - ends.terminated)
    longer = q_lambda * (1.0 - (ends.terminated | ends.truncated))

    def backwards(
        later: Float[Array, "*lanes"], step: tuple[Float[Array, "*lanes"], ...]
    ) -> tuple[Float[Array, "*lanes"], Float[Array, "*lanes"]]:
        reward, next_value, discount, longer = step
        target = reward + discount * (next_value + longer * (later - next_value))
        return target, target

    steps = (reward, next_value, discount, longer)
    return jax.lax.scan(backwards, next_value[-1], steps, reverse=True)[1]


def _collect(
    pqn: PQN, task: Task, state: PQNState, key: Key[Array, ""]
) -> tuple[Episodes, Int[Array, " environments"], Experience]:
    choice_key, action_key, step_key = jax.random.split(key, 3)
    keep, start = exploration_chances(pqn, state.done, state.updates)
    # All random numbers of the update at once: in the loop each draw would cost a pass of its own.
    chances = jax.random.uniform(choice_key, (pqn.horizon, pqn.environments))
    shape, count = (pqn.horizon, pqn.environments), state.layers[-1][1].shape[0]
    options = jax.random.randint(action_key, shape, 0, count, jnp.int32)

    def step(
        carry: tuple[Episodes, Int[Array, " environments"]],
        drawn: tuple[
            Float[Array, " environments"], Int[Array, " environments"], Key[Array, "environments 2"]
        ],
    ) -> tuple[tuple[Episodes, Int[Array, " environments"]], Experience]:
        episodes, held = carry
        chance, option, keys = drawn
        observation = jax.lax.optimization_barrier(jax.vmap(task.observe)(episodes.state))
        normalised = normalise(state.statistics, observation, pqn.normalise)
        greedy = jnp.argmax(network(state.layers, normalised, pqn.activation), axis=-1)
        held = next_held(held, chance, option, keep, start)
        action = jnp.where(held >= 0, held, greedy.astype(jnp.int32))
        episodes, transition = advance(task, episodes, action, keys)
        held = jnp.where(transition.over, -1, held)
        return (episodes, held), Experience(observation, action, transition)

    keys = step_keys(step_key, pqn.horizon, pqn.environments)
    carry = (state.episodes, state.held)
    (episodes, held), seen = jax.lax.scan(step, carry, (chances, options, keys))
    return episodes, held, seen


def exploration_chances(
    pqn: PQN, done: int | Int[Array, ""], updates: int | Int[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the probabilities of continuing to hold a random action, and of starting to.

    With these the share of exploring steps is epsilon for any hold: it is the stationary
    distribution of a Markov chain with two states, exploring or not.
    """
    progress = jnp.clip(done / (pqn.exploration * updates), 0.0, 1.0)
    epsilon = pqn.epsilon_start + progress * (pqn.epsilon_end - pqn.epsilon_start)
    keep = 1.0 - 1.0 / pqn.hold
    return jnp.asarray(keep), epsilon * (1.0 - keep) / jnp.maximum(1.0 - epsilon * keep, 1e-6)


def next_held(
    held: Int[Array, " environments"], chance: Float[Array, " environments"],
    option: Int[Array, " environments"], keep: Float[Array, ""], start: Float[Array, ""],
) -> Int[Array, " environments"]:  # fmt: skip
    """Return the random action that each environment repeats in the next step; -1 for none."""
    goes_on = (held >= 0) & (chance < keep)
    # Given that the action is not held on, `chance` is uniform on [keep, 1).
    again = jnp.where(held >= 0, (chance - keep) / jnp.maximum(1.0 - keep, 1e-6), chance)
    return jnp.where(goes_on, held, jnp.where(again < start, option, -1))


def _learn(
    pqn: PQN, state: PQNState, seen: Experience, key: Key[Array, ""]
) -> tuple[Layers, PyTree]:
    """Take a few passes of regression towards the targets of one stretch of experience."""
    transition = seen.transition
    observation = normalise(state.statistics, seen.observation, pqn.normalise)
    next_observation = normalise(state.statistics, transition.next_observation, pqn.normalise)
    next_values = network(state.layers, next_observation, pqn.activation)
    target = q_lambda_targets(
        pqn.reward_scale * transition.reward, jnp.max(next_values, axis=-1), transition.ends,
        pqn.discount, pqn.q_lambda,
    )  # fmt: skip
    return minibatch_epochs(
        lambda layers, part: _loss(layers, pqn, part), (state.layers, state.moments),
        Minibatch(observation, seen.action, target), key, adam(pqn.max_gradient),
        annealed(pqn.learning_rate, state.done, state.updates, pqn.anneal), pqn.epochs,
        pqn.minibatches,
    )  # fmt: skip


def _loss(layers: Layers, pqn: PQN, part: Minibatch) -> Float[Array, ""]:
    values = minibatch_network(layers, part.observation, pqn.activation)
    # A choice instead of an index, whose derivative would scatter row by row.
    chosen = jnp.arange(values.shape[-1]) == part.action[:, None]
    value = jnp.sum(jnp.where(chosen, values, 0.0), axis=-1)
    return jnp.mean(jnp.square(value - part.target)) / 2
