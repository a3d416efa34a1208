"""Our PPO and stable-baselines3's, side by side: CPU time of a step, and what is learnt.

    pip install -e '.[bench-rl]'
    python benchmarks/training.py
    python/bin/python benchmarks/training.py --task mountain_car --rounds 7

Both have two hidden layers of 64 tanh units, 8 environments x 128 steps an update, 4 epochs of 4
minibatches (256 rows). The two take turns; the ratio is the median over the rounds. Ours is
measured with its program compiled (compiling is reported apart), theirs after a first call that
warms it up. `--threads 1` holds torch to one thread, which takes it much less CPU time than
its own choice of one a core. What each has learnt after the same number of steps is the mean return
of the likeliest actions over 100 and over 20 episodes.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

HIDDEN = (64, 64)
ENVIRONMENTS, HORIZON, EPOCHS, MINIBATCHES = 8, 128, 4, 4
STEPS = 32_768


Training = Callable[[int], tuple[float, float]]


def ours(task_name: str) -> Training:
    """Return our training by seed, which gives CPU seconds and the mean return of its policy."""
    from envs.cartpole_task import CartPoleTask
    from verifai_jax.addons.rl import PPO, evaluate, train

    if task_name == "cartpole":
        task: Any = CartPoleTask()
    else:
        from envs.mountain_car import ContinuousMountainCarTask

        task = ContinuousMountainCarTask()
    ppo = PPO(
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

    def run(seed: int) -> tuple[float, float]:
        before = time.process_time()
        trained = train(task, ppo, seed=seed, steps=STEPS)
        seconds = time.process_time() - before
        return seconds, float(evaluate(task, trained.policy, seed=seed, episodes=100).mean())

    return run


def theirs(task_name: str, threads: int | None) -> Training:
    """Return the same with stable-baselines3."""
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy

    if threads is not None:
        torch.set_num_threads(threads)
    environment = {"cartpole": "CartPole-v1", "mountain_car": "MountainCarContinuous-v0"}[task_name]

    def run(seed: int) -> tuple[float, float]:
        environments = make_vec_env(environment, n_envs=ENVIRONMENTS, seed=seed)
        model = PPO(
            "MlpPolicy",
            environments,
            learning_rate=3e-4,
            n_steps=HORIZON,
            batch_size=ENVIRONMENTS * HORIZON // MINIBATCHES,
            n_epochs=EPOCHS,
            policy_kwargs={"net_arch": list(HIDDEN)},
            seed=seed,
            device="cpu",
        )
        before = time.process_time()
        model.learn(STEPS)
        seconds = time.process_time() - before
        mean_return, _ = evaluate_policy(model, environments, n_eval_episodes=20)
        return seconds, float(np.mean(mean_return))

    return run


def main() -> None:
    """Print CPU microseconds a step of both, and the ratio."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", choices=["cartpole", "mountain_car"], default="cartpole")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, help="of torch; its own choice when left out")
    chosen = parser.parse_args()
    mine, other = ours(chosen.task), theirs(chosen.task, chosen.threads)
    before = time.process_time()
    mine(0)
    print(f"first call, compilation included: {time.process_time() - before:.1f} CPU s")
    other(0)
    pairs = [(mine(seed), other(seed)) for seed in range(1, chosen.rounds + 1)]
    for name, side in (("verifai_jax", 0), ("stable-baselines3", 1)):
        seconds = statistics.median(pair[side][0] for pair in pairs)
        returns = sorted(round(pair[side][1], 1) for pair in pairs)
        print(f"{name:18} {1e6 * seconds / STEPS:8.1f} us of CPU a step; returns {returns}")
    ratios = sorted(b[0] / a[0] for a, b in pairs)
    print(f"ratio {statistics.median(ratios):.1f} (from {ratios[0]:.1f} to {ratios[-1]:.1f})")


if __name__ == "__main__":
    main()
