"""Parallelised Q network: Q(lambda) over many environments, with no replay and no target network.

    pqn = PQN(learning_rate=1e-3, hidden=(32, 32))
    training = pqn.init(task, key, updates=200)
    training, progress = pqn.step(task, training)

The policy's outputs are the values of the actions (times `reward_scale`).

Source: Gallici et al., Simplifying deep temporal difference learning (2024), algorithm 1. Their
layer normalisation is left out: on low-dimensional observations bounded units (tanh) do without,
and a policy stays a plain network. Exploring by holding random actions: Dabney et al., Temporally
extended epsilon-greedy exploration (2021), with geometric durations.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from verifai_jax.rl.advantage import Ends
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
from verifai_jax.rl.policy import ACTIVATIONS, Layers, Policy, network, new_layers
from verifai_jax.rl.shuffling import permutation
from verifai_jax.rl.task.task import Discrete, Task


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PQN:
    """Hyper-parameters.

    - `learning_rate`: of Adam; falls linearly to 0 over the training if `anneal`.
    - `discount`, `q_lambda`: of future rewards, and of longer looks ahead, in `[0, 1]`.
    - `epsilon_start`, `epsilon_end`: part of the steps that explore; goes linearly from one to the
      other over the part `exploration` of the training.
    - `hold`: mean steps for which a random action is kept, at least 1. Long ones find what single
      random steps never do (the hill of mountain car).
    - `reward_scale`: rewards are multiplied by it; values around 1 are learnt best.
    - `max_gradient`: norm to which gradients are cut.
    - `environments`, `horizon`: steps of experience in an update, wide and long.
    - `epochs`, `minibatches`: passes over them, and parts in a pass.
    - `hidden`: widths of the hidden layers. `activation`: between them, "tanh" or "relu".
    - `normalise`: observations by their running mean and deviation.
    """

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
    environments: int = shape(16)
    horizon: int = shape(32)
    epochs: int = shape(2)
    minibatches: int = shape(8)
    hidden: tuple[int, ...] = shape((64, 64))
    activation: str = shape("tanh")
    normalise: bool = shape(True)
    anneal: bool = shape(True)

    @property
    def steps_per_update(self) -> int:
        """Environment steps of one update."""
        return self.environments * self.horizon

    def check(self) -> None:
        """Refuse values that cannot train.

        **Raises:** `ValueError`, naming the hyper-parameter and its value.
        """
        positive = ("learning_rate", "exploration", "reward_scale", "max_gradient")
        check_values(self, positive, lambda value: float(value) > 0, "positive")
        fractions = ("discount", "q_lambda", "epsilon_start", "epsilon_end")
        check_values(self, fractions, lambda value: 0 <= float(value) <= 1, "between 0 and 1")
        check_values(self, ["hold"], lambda value: float(value) >= 1, "at least 1")
        counts = ("environments", "horizon", "epochs", "minibatches")
        check_values(self, counts, lambda value: value >= 1, "at least 1")
        steps = self.steps_per_update
        wanted = f"a divisor of environments * horizon = {steps}"
        check_values(self, ["minibatches"], lambda value: steps % value == 0, wanted)
        widths = lambda value: all(w >= 1 for w in value)  # noqa: E731
        check_values(self, ["hidden"], widths, "positive widths")
        known = " or ".join(ACTIVATIONS)
        check_values(self, ["activation"], lambda value: value in ACTIVATIONS, known)

    def init(self, task: Task, key: Key[Array, ""], updates: int | Int[Array, ""]) -> "Training":
        """The state before the first of `updates` updates."""
        weights_key, reset_key, key = jax.random.split(key, 3)
        episodes = begin(task, reset_key, self.environments)
        size = observation_size(task, episodes)
        layers = new_layers(weights_key, (size, *self.hidden, _count(task)), gain=0.01)
        return Training(
            layers=layers,
            moments=_optimizer(self).init(layers),
            seen=Seen.nothing(size),
            episodes=episodes,
            held=jnp.full(self.environments, -1, jnp.int32),
            key=key,
            done=jnp.int32(0),
            updates=jnp.int32(updates),
        )

    def step(self, task: Task, state: "Training") -> tuple["Training", Progress]:
        """Collect `horizon` steps of each environment and learn from them."""
        collect_key, learn_key, key = jax.random.split(state.key, 3)
        episodes, held, experience = _collect(self, task, state, collect_key)
        layers, moments = _learn(self, state, experience, learn_key)
        seen = watch(state.seen, experience.observation) if self.normalise else state.seen
        after = Training(layers, moments, seen, episodes, held, key, state.done + 1, state.updates)
        return after, progress(experience.transition)

    def policy(self, task: Task, state: "Training") -> Policy:
        """The policy as learnt so far, without exploration."""
        mean, scale = normaliser(state.seen) if self.normalise else (None, None)
        return Policy(state.layers, mean, scale, None, task.action, self.activation)


class Training(NamedTuple):
    """Everything that goes from one update to the next.

    - `held`: the random action that an environment holds on to; -1 where it is greedy.
    """

    layers: Layers
    moments: Any
    seen: Seen
    episodes: Episodes
    held: Int[Array, " environments"]
    key: Key[Array, ""]
    done: Int[Array, ""]
    updates: Int[Array, ""]


class Experience(NamedTuple):
    """What is learnt from, `[horizon, environments]`."""

    observation: Float[Array, "horizon environments k"]
    action: Int[Array, "horizon environments"]
    transition: Transition


def q_lambda_targets(
    reward: Float[Array, "time *lanes"],
    next_value: Float[Array, "time *lanes"],
    ends: Ends,
    discount: Float[Array, ""] | float,
    q_lambda: Float[Array, ""] | float,
) -> Float[Array, "time *lanes"]:
    """Targets for the values of the actions taken, lane by lane.

    - `next_value`: of the best action in the state that the step led to, *before* any reset.

    Source: Gallici et al. (2024), section 4 (Peng's Q(lambda)); a look ahead ends with its episode.
    """
    discount = discount * (1.0 - ends.terminated)
    longer = q_lambda * (1.0 - (ends.terminated | ends.truncated))

    def backwards(later: Array, step: Any) -> tuple[Array, Array]:
        reward, next_value, discount, longer = step
        target = reward + discount * (next_value + longer * (later - next_value))
        return target, target

    steps = (reward, next_value, discount, longer)
    return jax.lax.scan(backwards, next_value[-1], steps, reverse=True)[1]


def _collect(
    pqn: PQN, task: Task, training: Training, key: Key[Array, ""]
) -> tuple[Episodes, Int[Array, " environments"], Experience]:
    choice_key, action_key, step_key = jax.random.split(key, 3)
    keep, start = _exploring(pqn, training.done, training.updates)
    # All random numbers of the update at once: in the loop each draw would cost a pass of its own.
    chances = jax.random.uniform(choice_key, (pqn.horizon, pqn.environments))
    options = jax.random.randint(
        action_key, (pqn.horizon, pqn.environments), 0, _count(task), jnp.int32
    )

    def step(carry: Any, drawn: Any) -> Any:
        episodes, held = carry
        chance, option, key = drawn
        observation = jax.vmap(task.observe)(episodes.state)
        seen = normalised(training.seen, observation, pqn.normalise)
        greedy = jnp.argmax(network(training.layers, seen, pqn.activation), axis=-1)
        held = _next_held(held, chance, option, keep, start)
        action = jnp.where(held >= 0, held, greedy.astype(jnp.int32))
        episodes, transition = advance(task, episodes, action, key)
        held = jnp.where(transition.over, -1, held)
        return (episodes, held), Experience(observation, action, transition)

    keys = jax.random.split(step_key, pqn.horizon)
    carry = (training.episodes, training.held)
    (episodes, held), experience = jax.lax.scan(step, carry, (chances, options, keys))
    return episodes, held, experience


def _exploring(
    pqn: PQN, done: int | Int[Array, ""], updates: int | Int[Array, ""]
) -> tuple[Array, Array]:
    """Chances to go on holding a random action, and to begin with one.

    With these the part of steps that explore is epsilon, whatever the hold: the stationary
    distribution of the chain of two states, exploring or not.
    """
    way = jnp.clip(done / (pqn.exploration * updates), 0.0, 1.0)
    epsilon = pqn.epsilon_start + way * (pqn.epsilon_end - pqn.epsilon_start)
    keep = 1.0 - 1.0 / pqn.hold
    return jnp.asarray(keep), epsilon * (1.0 - keep) / jnp.maximum(1.0 - epsilon * keep, 1e-6)


def _next_held(held: Array, chance: Array, option: Array, keep: Array, start: Array) -> Array:
    kept = (held >= 0) & (chance < keep)
    # Given that it is not kept, `chance` is uniform on [keep, 1).
    again = jnp.where(held >= 0, (chance - keep) / jnp.maximum(1.0 - keep, 1e-6), chance)
    return jnp.where(kept, held, jnp.where(again < start, option, -1))


def _learn(
    pqn: PQN, training: Training, experience: Experience, key: Key[Array, ""]
) -> tuple[Layers, Any]:
    """A few passes of regression towards the targets of one stretch of experience."""
    transition = experience.transition
    look = lambda o: normalised(training.seen, o, pqn.normalise)  # noqa: E731
    observation, next_observation = look(experience.observation), look(transition.next_observation)
    next_values = network(training.layers, next_observation, pqn.activation)
    target = q_lambda_targets(
        pqn.reward_scale * transition.reward,
        jnp.max(next_values, axis=-1),
        transition.ends,
        pqn.discount,
        pqn.q_lambda,
    )
    batch = (observation, experience.action, target)
    batch = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), batch)
    optimizer = _optimizer(pqn)
    left = 1.0 - training.done * (1.0 / training.updates) if pqn.anneal else 1.0
    rate = pqn.learning_rate * left

    def minibatch(carry: Any, part: Any) -> Any:
        layers, moments = carry
        gradient = jax.grad(_loss)(layers, pqn, *part)
        direction, moments = optimizer.update(gradient, moments)
        layers = jax.tree.map(lambda w, d: w - rate * d, layers, direction)
        return (layers, moments), None

    def epoch(carry: Any, key: Key[Array, ""]) -> Any:
        order = permutation(key, pqn.steps_per_update)
        parts = jax.tree.map(
            lambda leaf: leaf[order].reshape(pqn.minibatches, -1, *leaf.shape[1:]), batch
        )
        return jax.lax.scan(minibatch, carry, parts)

    start = (training.layers, training.moments)
    return jax.lax.scan(epoch, start, jax.random.split(key, pqn.epochs))[0]


def _loss(
    layers: Layers, pqn: PQN, observation: Array, action: Array, target: Array
) -> Float[Array, ""]:
    values = network(layers, observation, pqn.activation)
    # A choice instead of an index, whose derivative would scatter row by row.
    chosen = jnp.arange(values.shape[-1]) == action[:, None]
    value = jnp.sum(jnp.where(chosen, values, 0.0), axis=-1)
    return jnp.mean(jnp.square(value - target)) / 2


def _optimizer(pqn: PQN) -> Any:
    import optax

    return optax.chain(
        optax.clip_by_global_norm(pqn.max_gradient),  # pyright: ignore[reportArgumentType]
        optax.scale_by_adam(eps=1e-5),
    )


def _count(task: Task) -> int:
    assert isinstance(task.action, Discrete)
    return task.action.n
