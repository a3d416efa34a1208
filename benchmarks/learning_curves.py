"""Returns that the training algorithms reach on classic control, and what a step costs.

    python benchmarks/learning_curves.py                       # every curve, five seeds: minutes
    python benchmarks/learning_curves.py --only sac --seeds 2
    python benchmarks/learning_curves.py --list

For each curve: mean return of each seed's final policy, without exploration, over 100 episodes;
the environment steps it was trained for; CPU time of this process for an environment step, learning
included, compiling not. `wanted` is the return at which Gymnasium calls the task solved, or
(Acrobot, Pendulum, which have none) about what well-tuned agents reach.
"""

import argparse
import time
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from benchmarks.control_tasks import Acrobot, Pendulum
from envs.cartpole_task import CartPoleTask
from envs.mountain_car import ContinuousMountainCarTask, MountainCarTask
from verifai_jax.addons.rl import PPO, evaluate
from verifai_jax.addons.rl.batched_training import BatchedTraining, Configuration
from verifai_jax.addons.rl.pqn import PQN
from verifai_jax.addons.rl.sac import SAC
from verifai_jax.addons.rl.task.task import Task


@dataclass(frozen=True)
class Curve:
    """A task, an algorithm with settings that suit it, and the return to reach.

    - `steps`: of the environment, of each training.
    - `wanted`: the mean return over the seeds is to be at least this.
    - `nominal`: the task to measure returns on, where training shapes the reward.
    """

    name: str
    task: Task
    algorithm: Any
    steps: int
    wanted: float
    nominal: Task | None = None


CURVES = (
    Curve("CartPole ppo", CartPoleTask(), PPO(learning_rate=5e-4, hidden=(16, 16)), 500_000, 475),
    Curve("CartPole pqn", CartPoleTask(), PQN(), 100_000, 475),
    Curve("Acrobot ppo", Acrobot(), PPO(learning_rate=1e-3), 200_000, -100),
    Curve("Acrobot pqn", Acrobot(), PQN(), 200_000, -100),
    Curve(
        "MountainCar ppo, shaped",
        MountainCarTask(potential=10.0),
        PPO(learning_rate=2e-3, gae_lambda=0.98),
        300_000,
        -110,
        nominal=MountainCarTask(),
    ),
    Curve(
        "MountainCar pqn",
        MountainCarTask(),
        PQN(
            learning_rate=3e-3,
            discount=0.995,
            hold=20.0,
            reward_scale=0.05,
            horizon=64,
            epochs=4,
        ),
        300_000,
        -110,
    ),
    Curve(
        "Pendulum ppo",
        Pendulum(),
        PPO(
            learning_rate=1e-3,
            discount=0.95,
            entropy=0.0,
            max_gradient=5.0,
            environments=4,
            horizon=256,
            epochs=10,
            minibatches=8,
            normalise=True,
        ),
        300_000,
        -200,
    ),
    Curve("Pendulum sac", Pendulum(), SAC(), 40_000, -200),
    Curve(
        "MountainCarContinuous ppo",
        ContinuousMountainCarTask(),
        PPO(learning_rate=1e-3, normalise=True),
        200_000,
        90,
    ),
    Curve(
        "MountainCarContinuous sac",
        ContinuousMountainCarTask(),
        SAC(correlation=0.95),
        50_000,
        90,
    ),
)


def returns(curve: Curve, seeds: int) -> np.ndarray:
    """Mean return of each seed's policy, on the nominal task."""
    task = curve.nominal or curve.task
    training = BatchedTraining(
        [Configuration(curve.task, curve.algorithm, curve.steps, seed) for seed in range(seeds)]
    )
    for _ in training.advance(dict.fromkeys(range(seeds), curve.steps)):
        pass
    policies = [training.policy(seed) for seed in range(seeds)]
    return np.array([evaluate(task, p, seed=99, episodes=100).mean() for p in policies])


def microseconds(curve: Curve, steps: int = 40_000) -> float:
    """CPU time of an environment step, in microseconds."""
    task, algorithm = curve.task, curve.algorithm
    updates = max(1, steps // algorithm.steps_per_update)

    @jax.jit
    def go_on(state: Any) -> Any:
        return jax.lax.fori_loop(0, updates, lambda _, s: algorithm.step(task, s)[0], state)

    state = jax.jit(lambda key: algorithm.init(task, key, 10 * updates))(jax.random.key(0))
    # Twice: the first call compiles, and an algorithm that waits begins to learn in it.
    for _ in range(2):
        state = jax.block_until_ready(go_on(state))
    began = time.process_time()
    jax.block_until_ready(go_on(state))
    return (time.process_time() - began) / (updates * algorithm.steps_per_update) * 1e6


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="curves whose name contains this")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--list", action="store_true", help="names only")
    arguments = parser.parse_args()
    chosen = [curve for curve in CURVES if arguments.only in curve.name]
    if arguments.list:
        print("\n".join(curve.name for curve in chosen))
        return
    print("| task, algorithm | steps | wanted | mean | returns by seed | us a step |")
    print("|---|---|---|---|---|---|")
    for curve in chosen:
        got, cost = returns(curve, arguments.seeds), microseconds(curve)
        by_seed = ", ".join(f"{value:.1f}" for value in got)
        print(
            f"| {curve.name} | {curve.steps:,} | {curve.wanted:g} | {got.mean():.1f} | {by_seed} "
            f"| {cost:.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
