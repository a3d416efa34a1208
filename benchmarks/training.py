"""Our PPO beside stable-baselines3's or rejax': CPU time of a step, and what is learnt.

    pip install -e '.[bench-rl]'
    python benchmarks/training.py
    python benchmarks/training.py --task mountain_car --rounds 7
    python benchmarks/training.py --beside rejax --trainings 1 8 64     # pip install rejax gymnax
    python benchmarks/training.py --parts                               # where the time goes

Both have two hidden layers of 64 tanh units, 8 environments x 128 steps an update, 4 epochs of 4
minibatches (256 rows). The two take turns; the ratio is the median over the rounds. Ours is
measured with its program compiled (compiling is reported apart), theirs after a first call that
warms it up. `--threads 1` holds torch to one thread, which takes it much less CPU time than
its own choice of one a core. What each has learnt after the same number of steps is the mean return
of the likeliest actions over 100 and over 20 episodes. rejax trains its seeds under one `vmap`, as
its manual shows, and we one on each core; both are measured compiled, without evaluations, and the
policies of both are evaluated by us. Without rejax the comparison says so and ends.
"""

import argparse
import math
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

HIDDEN = (64, 64)
ENVIRONMENTS, HORIZON, EPOCHS, MINIBATCHES = 8, 128, 4, 4
STEPS = 32_768


Training = Callable[[int], tuple[float, float]]
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


def our_trainings(count: int) -> Trainings:
    """Return our trainings of `count` seeds on CartPole."""
    from envs.cartpole_task import CartPoleTask
    from verifai_jax.addons.rl import evaluate
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
        policies = [training.policy(number) for number in numbers]
        return seconds, [float(evaluate(task, p, seed=1, episodes=100).mean()) for p in policies]

    return run


def rejax_trainings(count: int) -> Trainings:
    """Return the same with rejax, whose policies are evaluated as ours."""
    import gymnax  # pyright: ignore[reportMissingImports]
    import rejax  # pyright: ignore[reportMissingImports]

    from envs.cartpole_task import CartPoleTask
    from verifai_jax.addons.rl import Discrete, evaluate
    from verifai_jax.addons.rl.policy import Policy

    made, params = gymnax.make("CartPole-v1")

    class OneEnd(type(made)):
        """The environment with one flag for the end of an episode, which rejax expects."""

        def step(self, *arguments: Any) -> Any:
            observation, state, reward, *over, info = super().step(*arguments)
            return observation, state, reward, jnp.any(jnp.stack(over)), info

    algorithm = rejax.PPO.create(
        env=OneEnd(),
        env_params=params,
        num_envs=ENVIRONMENTS,
        num_steps=HORIZON,
        num_epochs=EPOCHS,
        num_minibatches=MINIBATCHES,
        learning_rate=3e-4,
        max_grad_norm=0.5,
        ent_coef=0.0,
        agent_kwargs={"hidden_layer_sizes": HIDDEN, "activation": "tanh"},
        total_timesteps=STEPS,
        eval_freq=STEPS,
        skip_initial_evaluation=True,
    ).replace(eval_callback=lambda *_: ())
    train = jax.jit(jax.vmap(algorithm.train) if count > 1 else algorithm.train)

    def run(seed: int) -> tuple[float, list[float]]:
        keys = jax.random.split(jax.random.key(seed), count)
        before = time.process_time()
        state, _ = jax.block_until_ready(train(keys if count > 1 else keys[0]))
        seconds = time.process_time() - before
        weights = state.actor_ts.params["params"]
        dense = [*weights["features"].values(), weights["action_logits"]]
        returns = []
        for number in range(count):
            lane = (lambda leaf, i=number: leaf[i]) if count > 1 else (lambda leaf: leaf)
            layers = tuple((lane(one["kernel"]), lane(one["bias"])) for one in dense)
            policy = Policy(layers, None, None, None, Discrete(2))
            returns.append(float(evaluate(CartPoleTask(), policy, seed=1, episodes=100).mean()))
        return seconds, returns

    return run


def beside_rejax(counts: list[int], rounds: int) -> None:
    """Print CPU microseconds a step of both, in alternating pairs, and the returns."""
    for count in counts:
        sides = our_trainings(count), rejax_trainings(count)
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
        for name, spent, learnt in zip(("verifai_jax", "rejax"), times, returns, strict=True):
            error = np.std(learnt) / math.sqrt(len(learnt))
            print(
                f"  {name:12} {statistics.median(spent):6.2f} us of CPU a step; return "
                f"{np.mean(learnt):.0f} +- {error:.0f} over {len(learnt)} seeds"
            )
        middle = statistics.median(ratios)
        print(f"  ratio {middle:.2f} (from {ratios[0]:.2f} to {ratios[-1]:.2f})", flush=True)


def parts(rounds: int) -> None:
    """Print where the CPU time of a step goes, each part compiled by itself."""
    from envs.cartpole_task import CartPoleTask
    from verifai_jax.addons.rl import ppo as module
    from verifai_jax.addons.rl.on_policy import permutation

    task, ppo, updates = CartPoleTask(), our_ppo(), 20

    def go(step: Callable[[Any], Any]) -> Callable[[Any], Any]:
        return jax.jit(lambda carry: jax.lax.fori_loop(0, updates, lambda _, c: step(c), carry))

    whole = go(lambda state: ppo.step(task, state)[0])
    start = jax.jit(lambda: ppo.init(task, jax.random.key(0), 1000))()
    start = whole(whole(start))  # Episodes as long as they are in most of a training.

    def collected(state: Any) -> Any:
        key, own = jax.random.split(state.key)
        episodes, _ = module._collect(ppo, task, state, own)
        return state._replace(episodes=episodes, key=key)

    _, experience = jax.jit(lambda s: module._collect(ppo, task, s, s.key))(start)

    def learnt(state: Any) -> Any:
        key, own = jax.random.split(state.key)
        weights, moments = module._learn(ppo, task, state, experience, own)
        return state._replace(weights=weights, moments=moments, key=key)

    def environment(state: Any) -> Any:
        keys = module.step_keys(state.key, HORIZON, ENVIRONMENTS)
        action = jnp.arange(ENVIRONMENTS) % 2
        step = lambda e, k: (module.advance(task, e, action, k)[0], None)  # noqa: E731
        return state._replace(
            episodes=jax.lax.scan(step, state.episodes, keys)[0], key=keys[0, 0, 0]
        )

    def shuffled(carry: Any) -> Any:
        key, total = carry
        key, own = jax.random.split(key)
        return key, total + jnp.sum(permutation(own, ENVIRONMENTS * HORIZON)[:2])

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
    from envs.cartpole_task import CartPoleTask
    from verifai_jax.addons.rl import evaluate, train

    if task_name == "cartpole":
        task: Any = CartPoleTask()
    else:
        from envs.mountain_car import ContinuousMountainCarTask

        task = ContinuousMountainCarTask()
    ppo = our_ppo()

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
    parser.add_argument("--task", choices=["cartpole", "mountain_car"], default="cartpole")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, help="of torch; its own choice when left out")
    parser.add_argument("--beside", choices=["stable-baselines3", "rejax"])
    parser.add_argument("--trainings", type=int, nargs="+", default=[1, 8, 64])
    parser.add_argument("--parts", action="store_true", help="only where our time goes")
    chosen = parser.parse_args()
    if chosen.parts:
        return parts(chosen.rounds)
    if chosen.beside == "rejax":
        try:
            return beside_rejax(chosen.trainings, chosen.rounds)
        except ImportError as error:
            sys.exit(f"not compared: {error}; pip install rejax gymnax")
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
