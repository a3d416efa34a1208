"""Our PPO beside those of stable-baselines3, rejax and PureJaxRL: CPU time, and what is learnt.

    pip install -e '.[bench-rl]'
    python benchmarks/training.py
    python benchmarks/training.py --task mountain_car --rounds 7
    python benchmarks/training.py --beside rejax --trainings 1 8 64     # pip install rejax gymnax
    python benchmarks/training.py --beside rejax --trainings            # the learning curves alone
    PYTHONPATH=clone/purejaxrl python benchmarks/training.py --beside purejaxrl
    python benchmarks/training.py --parts                               # where the time goes
    python benchmarks/training.py --parts --task reacher --environments 64

Both have two hidden layers of 64 tanh units, 8 environments x 128 steps an update, 4 epochs of 4
minibatches (256 rows). The two take turns; the ratio is the median over the rounds. Ours is
measured with its program compiled (compiling is reported apart), theirs after a first call that
warms it up. `--threads 1` holds torch to one thread, which takes it much less CPU time than
its own choice of one a core. What each has learnt after the same number of steps is the mean return
of the likeliest actions over 100 and over 20 episodes. rejax and PureJaxRL train their seeds under
one `vmap`, as their manuals show, and we one on each core; all are measured compiled, without
evaluations, and their policies are evaluated by us: after the timings, and at several points of
longer trainings as learning curves. These come a second time with both sides made alike: our
episodes terminate at the time limit, as theirs do; they do not clip the critic's error, as we do
not, and rejax also gets our first weights, clipping of gradients and Adam's epsilon. Without the
other side the comparison says so and ends.
"""

import argparse
import math
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.other_ppos import (
    ENVIRONMENTS,
    EPOCHS,
    HIDDEN,
    HORIZON,
    MINIBATCHES,
    POINTS,
    STEPS,
    Trainings,
    mean_returns,
    our_ppo,
    purejaxrl_curve,
    purejaxrl_trainings,
    rejax_curve,
    rejax_trainings,
)

Training = Callable[[int], tuple[float, float]]


def task_named(name: str) -> Any:
    """Return the task of this name."""
    from envs.cartpole_task import CartPoleTask
    from envs.mountain_car import ContinuousMountainCarTask
    from envs.reacher import reacher_task

    made = {"cartpole": CartPoleTask, "mountain_car": ContinuousMountainCarTask}
    return {**made, "reacher": reacher_task}[name]()


def our_trainings(count: int) -> Trainings:
    """Return our trainings of `count` seeds on CartPole."""
    from envs.cartpole_task import CartPoleTask
    from verifai_jax.addons.rl.batched_training import BatchedTraining, Configuration

    task = CartPoleTask()

    def run(seed: int) -> tuple[float, list[float]]:
        numbers = range(count)
        each = [Configuration(task, our_ppo(), STEPS, seed + number) for number in numbers]
        training = BatchedTraining(each)
        before = time.process_time()
        for _ in training.advance(dict.fromkeys(numbers, STEPS)):
            pass
        seconds = time.process_time() - before
        return seconds, mean_returns([training.policy(number) for number in numbers])

    return run


class Timed(NamedTuple):
    """A state of a task, and the number of steps so far."""

    state: Any
    age: Any


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class EndsForGood:
    """A task whose episodes terminate at the time limit, as those of rejax and PureJaxRL do."""

    task: Any

    @property
    def action(self) -> Any:
        """The actions of the task."""
        return self.task.action

    @property
    def time_limit(self) -> int:
        """The time limit of the task."""
        return self.task.time_limit

    def reset(self, key: Any) -> Timed:
        """Start an episode of the task."""
        return Timed(self.task.reset(key), jnp.int32(0))

    def step(self, key: Any, state: Timed, action: Any) -> tuple[Timed, Any, Any]:
        """Take a step, with which the last one before the limit terminates the episode."""
        after, reward, over = self.task.step(key, state.state, action)
        age = state.age + 1
        return Timed(after, age), reward, over | (age >= self.time_limit)

    def observe(self, state: Timed) -> Any:
        """Return what the task observes."""
        return self.task.observe(state.state)


def our_curve(seeds: int, alike: bool) -> np.ndarray:
    """Return mean returns `[points, seeds]` of our policies at `POINTS` of their training."""
    from envs.cartpole_task import CartPoleTask
    from verifai_jax.addons.rl.batched_training import BatchedTraining, Configuration

    task = EndsForGood(CartPoleTask()) if alike else CartPoleTask()
    each = [Configuration(task, our_ppo(), POINTS[-1], seed) for seed in range(seeds)]
    training, rows = BatchedTraining(each), []
    for steps in POINTS:
        for _ in training.advance(dict.fromkeys(range(seeds), steps)):
            pass
        rows.append(mean_returns([training.policy(number) for number in range(seeds)]))
    return np.array(rows)


SIDES = {
    "rejax": (rejax_trainings, rejax_curve),
    "purejaxrl": (purejaxrl_trainings, purejaxrl_curve),
}


def curves_beside(other: str, seeds: int) -> None:
    """Print mean returns during training, as the sides are and made alike, and how they differ."""
    from scipy.stats import mannwhitneyu

    print(f"return of the likeliest actions, {seeds} seeds; p: Mann-Whitney, two-sided")
    print("| " + " | ".join(["steps", *map(str, POINTS), "mean of these"]) + " |")
    for alike in (False, True):
        sides = our_curve(seeds, alike), SIDES[other][1](seeds, alike)
        # The mean over the points is one number a training, and so one test of the whole curve.
        sides = [np.vstack([side, side.mean(axis=0)]) for side in sides]
        for name, side in zip(("verifai_jax", other), sides, strict=True):
            errors = side.std(axis=1, ddof=1) / math.sqrt(seeds)
            each = [f"{m:.0f} +- {e:.0f}" for m, e in zip(side.mean(axis=1), errors, strict=True)]
            print("| " + " | ".join([name + ", alike" * alike, *each]) + " |")
        p = [mannwhitneyu(*pair).pvalue for pair in zip(*sides, strict=True)]
        print("| p | " + " | ".join(f"{one:.2g}" for one in p) + " |", flush=True)


def beside(other: str, counts: list[int], rounds: int) -> None:
    """Print CPU microseconds a step of both, in alternating pairs, and the returns."""
    for count in counts:
        sides = our_trainings(count), SIDES[other][0](count)
        for side in sides:
            side(0)
        times: list[list[float]] = [[], []]
        returns: list[list[float]] = [[], []]
        for number in range(rounds):
            for index, side in enumerate(sides):
                seconds, learnt = side(1000 * (number + 1))
                times[index].append(1e6 * seconds / STEPS / count)
                returns[index] += learnt
        ratios = sorted(b / a for a, b in zip(*times, strict=True))
        print(f"{count} trainings, {rounds} pairs")
        for name, spent, learnt in zip(("verifai_jax", other), times, returns, strict=True):
            error = np.std(learnt) / math.sqrt(len(learnt))
            print(
                f"  {name:12} {statistics.median(spent):6.2f} us of CPU a step; return "
                f"{np.mean(learnt):.0f} +- {error:.0f} over {len(learnt)} seeds"
            )
        middle = statistics.median(ratios)
        print(f"  ratio {middle:.2f} (from {ratios[0]:.2f} to {ratios[-1]:.2f})", flush=True)


def parts(task_name: str, environments: int, rounds: int) -> None:
    """Print where the CPU time of a step goes, each part compiled by itself."""
    from verifai_jax.addons.rl import Discrete
    from verifai_jax.addons.rl import ppo as module
    from verifai_jax.addons.rl.on_policy import permutation

    task, updates = task_named(task_name), max(1, 160 // environments)
    ppo = replace(our_ppo(), environments=environments)

    def go(step: Callable[[Any], Any]) -> Callable[[Any], Any]:
        return jax.jit(lambda carry: jax.lax.fori_loop(0, updates, lambda _, c: step(c), carry))

    whole = go(lambda state: ppo.step(task, state)[0])
    start = jax.jit(lambda: ppo.init(task, jax.random.key(0), 1000))()
    start = whole(whole(start))  # Episodes as long as they are in most of a training.

    def collected(state: Any) -> Any:
        key, own = jax.random.split(state.key)
        episodes, _ = module.collect(ppo, task, state, own)
        return state._replace(episodes=episodes, key=key)

    _, experience = jax.jit(lambda s: module.collect(ppo, task, s, s.key))(start)

    def learnt(state: Any) -> Any:
        key, own = jax.random.split(state.key)
        weights, moments = module._learn(ppo, task, state, experience, own)
        return state._replace(weights=weights, moments=moments, key=key)

    discrete = isinstance(task.action, Discrete)
    sizes = () if discrete else (task.action.size,)
    action = (jnp.arange(environments * math.prod(sizes)) % 2).reshape(environments, *sizes)
    action = action if discrete else action.astype(float)

    def environment(state: Any) -> Any:
        keys = module.step_keys(state.key, HORIZON, environments)
        step = lambda e, k: (module.advance(task, e, action, k)[0], None)  # noqa: E731
        return state._replace(
            episodes=jax.lax.scan(step, state.episodes, keys)[0], key=keys[0, 0, 0]
        )

    def shuffled(carry: Any) -> Any:
        key, total = carry
        key, own = jax.random.split(key)
        return key, total + jnp.sum(permutation(own, environments * HORIZON)[:2])

    def stepped(carry: Any) -> Any:
        direction, moments = module.adam(ppo.max_gradient).update(carry[0], carry[1])
        return jax.tree.map(lambda w, d: w - 1e-3 * d, carry[0], direction), moments

    several = lambda one, times: (  # noqa: E731
        lambda carry: jax.lax.fori_loop(0, times, lambda _, c: one(c), carry)
    )
    measured = {
        "all": (whole, start),
        "experience": (go(collected), start),
        "  of that: environments": (go(environment), start),
        "learning": (go(learnt), start),
        "  of that: shuffles": (go(several(shuffled, EPOCHS)), (start.key, jnp.int32(0))),
        "  of that: Adam": (
            go(several(stepped, EPOCHS * MINIBATCHES)),
            (start.weights, start.moments),
        ),
    }
    for name, (run, carry) in measured.items():
        jax.block_until_ready(run(carry))
        spent = []
        for _ in range(rounds):
            before = time.process_time()
            jax.block_until_ready(run(carry))
            spent.append(time.process_time() - before)
        micro = 1e6 * min(spent) / updates / ppo.steps_per_update
        print(f"{name:26} {micro:6.2f} us of CPU a step", flush=True)


def ours(task_name: str) -> Training:
    """Return our training by seed, which gives CPU seconds and the mean return of its policy."""
    from verifai_jax.addons.rl import evaluate, train

    task, ppo = task_named(task_name), our_ppo()

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
    """Print CPU microseconds a step of both sides, and the ratio."""
    parser = argparse.ArgumentParser(description=__doc__)
    tasks = ["cartpole", "mountain_car", "reacher"]
    parser.add_argument("--task", choices=tasks, default="cartpole", help="reacher: with --parts")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, help="of torch; its own choice when left out")
    parser.add_argument("--beside", choices=["stable-baselines3", *SIDES])
    parser.add_argument("--trainings", type=int, nargs="*", default=[1, 8, 64])
    parser.add_argument("--curves", type=int, default=20, help="seeds of the learning curves")
    parser.add_argument("--parts", action="store_true", help="only where our time goes")
    parser.add_argument("--environments", type=int, default=ENVIRONMENTS, help="of --parts")
    chosen = parser.parse_args()
    if chosen.parts:
        return parts(chosen.task, chosen.environments, chosen.rounds)
    if chosen.beside in SIDES:
        try:
            beside(chosen.beside, chosen.trainings, chosen.rounds)
            return curves_beside(chosen.beside, chosen.curves) if chosen.curves else None
        except ImportError as error:
            sys.exit(f"not compared: {error}; see the top of this file")
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
