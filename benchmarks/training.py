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
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest.mock import MagicMock

import jax
import jax.numpy as jnp
import numpy as np

HIDDEN = (64, 64)
ENVIRONMENTS, HORIZON, EPOCHS, MINIBATCHES = 8, 128, 4, 4
STEPS = 32_768
POINTS = (8_192, 16_384, 24_576, STEPS, 65_536, 131_072)
"""Steps after which a learning curve has a point."""


Training = Callable[[int], tuple[float, float]]
Trainings = Callable[[int], tuple[float, list[float]]]
"""CPU seconds of trainings from this seed on, and the mean returns of their policies."""


def task_named(name: str) -> Any:
    """Return the task of this name."""
    from envs.cartpole_task import CartPoleTask
    from envs.mountain_car import ContinuousMountainCarTask
    from envs.reacher import reacher_task

    made = {"cartpole": CartPoleTask, "mountain_car": ContinuousMountainCarTask}
    return {**made, "reacher": reacher_task}[name]()


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


def mean_returns(policies: Sequence[Any]) -> list[float]:
    """Return each policy's mean return over the same 100 episodes of CartPole."""
    from envs.cartpole_task import CartPoleTask
    from verifai_jax.addons.rl import evaluate

    task = CartPoleTask()
    return [float(evaluate(task, p, seed=1, episodes=100).mean()) for p in policies]


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


def stacked_policies(dense: Sequence[Any], count: int) -> list[Any]:
    """Return `count` policies from flax' dense layers, first layer first."""
    from verifai_jax.addons.rl import Discrete
    from verifai_jax.addons.rl.policy import Policy

    each = [(np.asarray(one["kernel"]), np.asarray(one["bias"])) for one in dense]
    each = [(weight.reshape(count, -1, weight.shape[-1]), bias) for weight, bias in each]
    each = [(weight, bias.reshape(count, -1)) for weight, bias in each]
    layers = [tuple((weight[n], bias[n]) for weight, bias in each) for n in range(count)]
    return [Policy(one, None, None, None, Discrete(2)) for one in layers]


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

    def run(seed: int) -> tuple[float, list[float]]:
        keys = jax.random.split(jax.random.key(seed), count)
        before = time.process_time()
        state, _ = jax.block_until_ready(train(keys if count > 1 else keys[0]))
        seconds = time.process_time() - before
        return seconds, mean_returns(rejax_policies(state, count))

    return run


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

    def run(seed: int) -> tuple[float, list[float]]:
        keys = jax.random.split(jax.random.key(seed), count)
        before = time.process_time()
        dense = jax.block_until_ready(train(keys if count > 1 else keys[0]))
        seconds = time.process_time() - before
        return seconds, mean_returns(stacked_policies(dense, count))

    return run


def purejaxrl_curve(seeds: int, alike: bool) -> np.ndarray:
    """Return mean returns `[points, seeds]` of PureJaxRL's policies, trained anew for each."""
    keys = jax.vmap(jax.random.key)(jnp.arange(seeds))
    dense = (purejaxrl_program(steps, seeds, alike)(keys) for steps in POINTS)
    return np.array([mean_returns(stacked_policies(one, seeds)) for one in dense])


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
