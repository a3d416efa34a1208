"""PPO of rejax and of PureJaxRL on CartPole, with the settings of ours and evaluated as ours.

`benchmarks/training.py` measures them beside ours.
"""

import sys
import time
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import jax
import jax.numpy as jnp
import numpy as np

HIDDEN = (64, 64)
ENVIRONMENTS, HORIZON, EPOCHS, MINIBATCHES = 8, 128, 4, 4
STEPS = 32_768
POINTS = (8_192, 16_384, 24_576, STEPS, 65_536, 131_072)
"""Steps after which a learning curve has a point."""
Trainings = Callable[[int], tuple[float, list[float]]]
"""CPU seconds of trainings from this seed on, and the mean returns of their policies."""


def our_ppo() -> Any:
    """Return PPO with the settings that all sides have."""
    from verifai_jax.addons.rl import PPO

    return PPO(
        learning_rate=3e-4,
        entropy=0.0,
        hidden=HIDDEN,
        value_hidden=HIDDEN,
        environments=ENVIRONMENTS,
        horizon=HORIZON,
        epochs=EPOCHS,
        minibatches=MINIBATCHES,
        anneal=False,
    )


def mean_returns(policies: Sequence[Any]) -> list[float]:
    """Return each policy's mean return over the same 100 episodes of CartPole."""
    from envs.cartpole_task import CartPoleTask
    from verifai_jax.addons.rl import evaluate

    task = CartPoleTask()
    return [float(evaluate(task, p, seed=1, episodes=100).mean()) for p in policies]


def stacked_policies(dense: Sequence[Any], count: int) -> list[Any]:
    """Return `count` policies from flax' dense layers, first layer first."""
    from verifai_jax.addons.rl import Discrete
    from verifai_jax.addons.rl.policy import Policy

    each = [(np.asarray(one["kernel"]), np.asarray(one["bias"])) for one in dense]
    each = [(weight.reshape(count, -1, weight.shape[-1]), bias) for weight, bias in each]
    each = [(weight, bias.reshape(count, -1)) for weight, bias in each]
    layers = [tuple((weight[n], bias[n]) for weight, bias in each) for n in range(count)]
    return [Policy(one, None, None, None, Discrete(2)) for one in layers]


def timed(
    train: Callable[[Any], Any], policies: Callable[[Any], list[Any]], count: int
) -> Trainings:
    """Return the timed trainings of a compiled function from keys to what holds the policies."""

    def run(seed: int) -> tuple[float, list[float]]:
        keys = jax.random.split(jax.random.key(seed), count)
        before = time.process_time()
        trained = jax.block_until_ready(train(keys if count > 1 else keys[0]))
        seconds = time.process_time() - before
        return seconds, mean_returns(policies(trained))

    return run


def gymnax_cartpole() -> tuple[Any, Any]:
    """Return CartPole of gymnax with one flag for the end of an episode, and its parameters."""
    import gymnax  # pyright: ignore[reportMissingImports]

    made, params = gymnax.make("CartPole-v1")

    class OneEnd(type(made)):
        def step(self, *arguments: Any) -> Any:
            observation, state, reward, *over, info = super().step(*arguments)
            return observation, state, reward, jnp.any(jnp.stack(over)), info

    return OneEnd(), params


def rejax_ppo(steps: int, alike: bool = False) -> Any:
    """Return rejax' PPO with the settings that all sides have, for so many steps.

    If `alike`, its first weights, the clipping of its gradients by their common norm, Adam's
    epsilon and the critic's error are ours too; rejax clips each number of a gradient.
    """
    import optax
    import rejax  # pyright: ignore[reportMissingImports]
    from rejax.algos.algorithm import register_init  # pyright: ignore[reportMissingImports]

    from verifai_jax.addons.rl.on_policy import EPSILON
    from verifai_jax.addons.rl.policy import new_layers

    class Alike(rejax.PPO):
        @register_init
        def initialize_network_params(self, rng: Any) -> Any:
            made = super().initialize_network_params(rng)

            def dense(number: int, outputs: int, gain: float) -> list[dict[str, Any]]:
                layers = new_layers(jax.random.fold_in(rng, number), (4, *HIDDEN, outputs), gain)
                return [{"kernel": weight, "bias": bias} for weight, bias in layers]

            *features, logits = dense(0, 2, 0.01)
            number = lambda layers: {f"Dense_{i}": one for i, one in enumerate(layers)}  # noqa: E731
            params = {
                "actor_ts": {"features": number(features), "action_logits": logits},
                "critic_ts": number(dense(1, 1, 1.0)),
            }
            tx = optax.adam(self.learning_rate, eps=EPSILON)
            return {
                name: made[name].replace(
                    params={"params": own}, tx=tx, opt_state=tx.init({"params": own})
                )
                for name, own in params.items()
            }

        def update(self, ts: Any, batch: Any) -> Any:
            taken = batch.trajectories
            advantage = batch.advantages - batch.advantages.mean()
            advantage = advantage / (batch.advantages.std() + 1e-8)

            def loss(params: tuple[Any, Any]) -> Any:
                policy, critic = params
                log_probability, _ = self.actor.apply(
                    policy, taken.obs, taken.action, method="log_prob_entropy"
                )
                ratio = jnp.exp(log_probability - taken.log_prob)
                clipped = jnp.clip(ratio, 1 - self.clip_eps, 1 + self.clip_eps)
                error = jnp.square(self.critic.apply(critic, taken.obs) - batch.targets)
                surrogate = jnp.minimum(ratio * advantage, clipped * advantage)
                return -surrogate.mean() + self.vf_coef * error.mean() / 2

            gradients = jax.grad(loss)((ts.actor_ts.params, ts.critic_ts.params))
            clip: Any = optax.clip_by_global_norm(self.max_grad_norm)
            policy, critic = clip.update(gradients, optax.EmptyState())[0]
            return ts.replace(
                actor_ts=ts.actor_ts.apply_gradients(grads=policy),
                critic_ts=ts.critic_ts.apply_gradients(grads=critic),
            )

    env, params = gymnax_cartpole()
    algorithm = (Alike if alike else rejax.PPO).create(
        env=env,
        env_params=params,
        num_envs=ENVIRONMENTS,
        num_steps=HORIZON,
        num_epochs=EPOCHS,
        num_minibatches=MINIBATCHES,
        learning_rate=3e-4,
        max_grad_norm=0.5,
        ent_coef=0.0,
        agent_kwargs={"hidden_layer_sizes": HIDDEN, "activation": "tanh"},
        total_timesteps=steps,
        eval_freq=steps,
        skip_initial_evaluation=True,
    )
    return algorithm.replace(eval_callback=lambda *_: ())


def rejax_policies(state: Any, count: int) -> list[Any]:
    """Return the policies of rejax' state of `count` trainings."""
    weights = state.actor_ts.params["params"]
    return stacked_policies([*weights["features"].values(), weights["action_logits"]], count)


def rejax_trainings(count: int) -> Trainings:
    """Return the trainings of `our_trainings` with rejax, whose policies are evaluated as ours."""
    algorithm = rejax_ppo(STEPS)
    train = jax.jit(jax.vmap(algorithm.train) if count > 1 else algorithm.train)
    return timed(train, lambda trained: rejax_policies(trained[0], count), count)


def rejax_curve(seeds: int, alike: bool) -> np.ndarray:
    """Return mean returns `[points, seeds]` of rejax' policies, which train on between points."""
    keys = jax.vmap(jax.random.key)(jnp.arange(seeds))
    state, rows, done = jax.jit(jax.vmap(rejax_ppo(STEPS, alike).init_state))(keys), [], 0
    for steps in POINTS:
        further = rejax_ppo(steps - done, alike)
        go_on = lambda one, further=further: further.train(train_state=one)[0]  # noqa: E731
        state, done = jax.jit(jax.vmap(go_on))(state), steps
        rows.append(mean_returns(rejax_policies(state, seeds)))
    return np.array(rows)


def purejaxrl_program(steps: int, count: int, alike: bool = False) -> Callable[[Any], list[Any]]:
    """Return PureJaxRL's PPO for so many steps, from keys to the dense layers of the policies.

    If `alike`, it does not clip the critic's error: the one place where it takes a maximum.
    """
    # Its wrappers import what only other environments need.
    for name in ("brax", "brax.envs", "brax.envs.wrappers", "brax.envs.wrappers.training", "navix"):
        sys.modules.setdefault(name, MagicMock())
    import ppo  # pyright: ignore[reportMissingImports]

    unclipped = SimpleNamespace(**{**vars(jnp), "maximum": lambda error, clipped: error})
    ppo.jnp, ppo.gymnax = unclipped if alike else jnp, MagicMock(make=lambda _: gymnax_cartpole())
    settings = our_ppo()
    train = ppo.make_train(
        {
            "ENV_NAME": "CartPole-v1",
            "TOTAL_TIMESTEPS": steps,
            "NUM_ENVS": ENVIRONMENTS,
            "NUM_STEPS": HORIZON,
            "UPDATE_EPOCHS": EPOCHS,
            "NUM_MINIBATCHES": MINIBATCHES,
            "LR": settings.learning_rate,
            "ANNEAL_LR": False,
            "GAMMA": settings.discount,
            "GAE_LAMBDA": settings.gae_lambda,
            "CLIP_EPS": settings.clip,
            "ENT_COEF": settings.entropy,
            "VF_COEF": settings.value_weight,
            "MAX_GRAD_NORM": settings.max_gradient,
            "ACTIVATION": "tanh",
        }
    )

    def dense(key: Any) -> list[Any]:
        params = train(key)["runner_state"][0].params["params"]
        return [params[f"Dense_{number}"] for number in range(len(HIDDEN) + 1)]

    return jax.jit(jax.vmap(dense) if count > 1 else dense)


def purejaxrl_trainings(count: int) -> Trainings:
    """Return the same with PureJaxRL."""
    train = purejaxrl_program(STEPS, count)
    return timed(train, lambda dense: stacked_policies(dense, count), count)


def purejaxrl_curve(seeds: int, alike: bool) -> np.ndarray:
    """Return mean returns `[points, seeds]` of PureJaxRL's policies, trained anew for each."""
    keys = jax.vmap(jax.random.key)(jnp.arange(seeds))
    dense = (purejaxrl_program(steps, seeds, alike)(keys) for steps in POINTS)
    return np.array([mean_returns(stacked_policies(one, seeds)) for one in dense])
