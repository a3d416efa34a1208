"""PPO of stable-baselines3 on a task in JAX, whose environments step together in one program.

    policy = train(programs_of(environment), parameters, kind, ppo, 32_768, values, (64, 64), 0)

The environment has gymnax' form (`safe_sweeps.environment_of`). Environments in processes of their
own, or one after the other, would take longer. It needs `pip install stable-baselines3`.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.vec_env import VecEnv, VecNormalize  # pyright: ignore

from verifai_jax.addons.rl import PPO as Ours
from verifai_jax.addons.rl import Continuous, Discrete, Policy

NAMES = {"discount": "gamma", "clip": "clip_range", "entropy": "ent_coef"}
torch.set_num_threads(1)


class Environments(VecEnv):
    """Environments of a task, which begin anew when an episode is over."""

    def __init__(self, programs: Any, parameters: Any, kind: Any, count: int, seed: int) -> None:
        self.begin, self.advance = programs
        self.parameters, self.key, self.number = parameters, jax.random.key(seed), 0
        first = np.asarray(self.reset_of(count)[0])
        space: Any = gymnasium.spaces.Box(-np.inf, np.inf, first.shape[1:], np.float32)
        acts: Any = gymnasium.spaces.Box(np.float32(-1), np.float32(1), (1,))
        if isinstance(kind, Discrete):
            acts = gymnasium.spaces.Discrete(kind.n)
        elif isinstance(kind, Continuous):
            low, high = (np.broadcast_to(np.float32(b), kind.size) for b in (kind.low, kind.high))
            acts = gymnasium.spaces.Box(low, high)
        super().__init__(count, space, acts)

    def reset_of(self, count: int) -> Any:
        return self.begin(jax.random.split(self.key, count), self.parameters)

    def reset(self) -> np.ndarray:
        observations, self.states = self.reset_of(self.num_envs)
        return np.array(observations)

    def step_async(self, actions: np.ndarray) -> None:
        self.actions = actions

    def step_wait(self) -> Any:
        self.number += 1
        observations, self.states, rewards, over, _ = self.advance(
            self.key, self.number, self.states, self.actions, self.parameters
        )
        # PyTorch takes arrays that can be written alone.
        return np.array(observations), np.array(rewards), np.array(over), self.infos()

    def infos(self) -> list[dict[str, Any]]:
        return [{} for _ in range(self.num_envs)]

    def close(self) -> None:
        pass

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [None] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError

    def env_method(self, method_name: str, *args: Any, **options: Any) -> list[Any]:
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


def programs_of(environment: Any) -> tuple[Any, Any]:
    """Return the compiled beginning and step of many environments."""

    def step(key: Any, number: Any, states: Any, actions: Any, parameters: Any) -> Any:
        keys = jax.random.split(jax.random.fold_in(key, number), len(actions))
        return jax.vmap(environment.step, in_axes=(0, 0, 0, None))(
            keys, states, actions, parameters
        )

    return jax.jit(jax.vmap(environment.reset, in_axes=(0, None))), jax.jit(step)


def train(
    programs: tuple[Any, Any], parameters: Any, kind: Any, ours: Ours, steps: int,
    values: Mapping[str, float], hidden: tuple[int, ...], seed: int,
) -> Policy:  # fmt: skip
    """Train with the settings of an algorithm of ours, and return the policy as one of ours."""
    environments: Any = Environments(programs, parameters, kind, ours.environments, seed)
    if ours.normalise:
        environments = VecNormalize(environments, norm_reward=False, clip_obs=np.inf)
    model = PPO(
        "MlpPolicy",
        environments,
        n_steps=ours.horizon,
        batch_size=ours.environments * ours.horizon // ours.minibatches,
        n_epochs=ours.epochs,
        max_grad_norm=ours.max_gradient,
        policy_kwargs={"net_arch": [*hidden], "activation_fn": torch.nn.Tanh},
        seed=seed,
        device="cpu",
        **{NAMES.get(name, name): value for name, value in values.items()},
    )
    model.learn(steps)
    dense = [*model.policy.mlp_extractor.policy_net, model.policy.action_net]
    layers = [
        tuple(jnp.asarray(part.detach().numpy()) for part in (one.weight.T, one.bias))
        for one in dense
        if isinstance(one, torch.nn.Linear)
    ]
    if isinstance(kind, Continuous):
        middle, half = (kind.high + kind.low) / 2, (kind.high - kind.low) / 2
        layers[-1] = (layers[-1][0] / half, (layers[-1][1] - middle) / half)
    mean = scale = None
    if ours.normalise:
        mean = jnp.asarray(environments.obs_rms.mean, jnp.float32)
        scale = jnp.sqrt(jnp.asarray(environments.obs_rms.var, jnp.float32) + 1e-8)
    return Policy(tuple(layers), mean, scale, None, kind)
