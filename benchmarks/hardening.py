"""Hardening against plain domain randomisation at equal environment steps; see RESULTS.md.

    python benchmarks/hardening.py CASE [--first 100] [--seeds 5] [--folder hardenings]

A case is cartpole, mountain_car, hopper, reacher or lane_keeping.

Of each seed both arms are one training up to the first round, and take the same steps afterwards.
The policies before, after and of randomisation are simulated at the same fresh samples, which
decided nothing. What is compared is the logarithm of the failure probability, with half a failure
added to each count. Interrupted, it goes on where it was.
"""

import argparse
import dataclasses
from pathlib import Path

import numpy as np

import verifai_jax as vj
from envs.cartpole_task import CartPoleTask
from envs.hopper import HopperTask, hopper
from envs.hopper import neural as hopping
from envs.lane_keeping import LaneKeepingTask, lane_keeping, neural
from envs.mountain_car import MountainCarTask
from envs.reacher import reacher_task, start_with
from envs.train_cartpole import HYPER_PARAMETERS
from envs.train_hopper import HYPER_PARAMETERS as HOPPER_PPO
from envs.train_lane_keeping import HYPER_PARAMETERS as LANE_PPO
from specs.cartpole import balance_with
from specs.hopper import bodies, upright
from specs.lane_keeping import learned
from specs.mountain_car import climb_with, safe_training
from specs.reacher import reach_with
from verifai_jax.addons.rl import PPO
from verifai_jax.addons.training.paired import paired_difference

WIDE = {
    "x0": vj.Box(-1.5, 1.5),
    "theta0": vj.Box(-0.12, 0.12),
    "masspole": vj.Box(0.05, 1.0),
    "length": vj.Box(0.2, 2.0),
}
"""Starts and poles of which a policy that was trained on CartPole-v1 keeps not all."""


def wide_with(policy):
    """Return `balance` under a policy, with these starts and poles."""
    return dataclasses.replace(balance_with(policy), space=vj.FeatureSpace(WIDE))


WEAK = {"power": vj.Box(0.00085, 0.0012), "velocity_bias": vj.Box(-0.006, 0.006)}
"""Engines and sensors of which a policy that was trained on MountainCar-v0 keeps not all."""


def weak_with(policy):
    """Return `climb` under a policy, with these engines and sensors."""
    climb = climb_with(policy)
    return dataclasses.replace(climb, space=vj.FeatureSpace({**climb.space.domains, **WEAK}))


def lane_with(policy):
    """Return `learned` under another policy."""
    return dataclasses.replace(learned, system=lane_keeping(neural(policy)))


def upright_with(policy):
    """Return `upright` under another policy."""
    return dataclasses.replace(upright, system=hopper(*bodies, controller=hopping(policy)))


REACHING = PPO(
    learning_rate=2e-3, entropy=0.0, discount=0.95, environments=32, horizon=64, minibatches=8,
    hidden=(32, 32), normalise=True,
)  # fmt: skip
REACHER = reacher_task(varied=True)

CASES = {
    "cartpole": (
        CartPoleTask(masspole_range=0.0, length_range=0.0), wide_with, HYPER_PARAMETERS,
        {"steps": 300_000, "p": 0.001},
    ),
    "lane_keeping": (
        LaneKeepingTask(varied=True), lane_with, LANE_PPO, {"steps": 400_000, "p": 0.001},
    ),
    "mountain_car": (
        vj.Trainer(MountainCarTask(potential=10.0), safe_training.trainer.by_name["ppo"],
                   steps=262_144, nominal=MountainCarTask()),
        weak_with, None, {"p": 0.001},
    ),
    "hopper": (HopperTask(), upright_with, HOPPER_PPO, {"steps": 1_500_000, "p": 0.001}),
    "reacher": (
        REACHER, reach_with, REACHING, {"steps": 400_000, "p": 0.001,
         "further": vj.FurtherTraining(start=start_with(REACHER))},
    ),
}  # fmt: skip


FRESH = {"hopper": 2048, "reacher": 4096}
"""Fresh samples of the slow cases; of the others 40 000."""


def failures(problem, result, count, seed):
    """Return how often the policies before, after and of randomisation fail at the same samples."""
    randomised = result.policies["randomised", result.chosen["randomised"]]
    return [
        len(
            vj.falsify(
                problem(policy), "uniform", count, seed=10**6 + seed, confirm=False, progress=False
            ).table.violating
        )
        for policy in (result.start, result.policy, randomised)
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("case", choices=CASES)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--folder", type=Path)
    args = parser.parse_args()
    task, problem, algorithm, options = CASES[args.case]
    logs, seconds, count = [], 0.0, FRESH.get(args.case, 40_000)
    for seed in range(args.first, args.first + args.seeds):
        folder = None if args.folder is None else args.folder / args.case / str(seed)
        trainer = task if algorithm is None else vj.Trainer(task, algorithm)
        result = vj.harden(
            trainer, problem, seed=seed, baseline=True, folder=folder,
            progress=False, **options,
        )  # fmt: skip
        print(result, flush=True)
        found = failures(problem, result, count, seed)
        before, hardened, randomised = found
        print(
            f"  fresh samples that fail, of {count:,}: {before} before, {hardened} hardened, "
            f"{randomised} randomised", flush=True,
        )  # fmt: skip
        logs.append(np.log((np.array(found) + 0.5) / (count + 1)))
        seconds += result.seconds
    before, hardened, randomised = np.array(logs).T
    print(f"\n{args.case}: {args.seeds} seeds, {seconds / args.seeds:.0f} s each")
    named = (("hardened", before, hardened), ("randomised", before, randomised),
             ("hardened, not randomised", randomised, hardened))  # fmt: skip
    for name, one, other in named:
        gained = paired_difference(one, other, 0.95)
        low, mean, high = (np.exp(each) for each in (gained.low, gained.mean, gained.high))
        interval = f" (95 % t interval {low:.3g} to {high:.3g})" if args.seeds > 1 else ""
        print(
            f"  {name}: fails {mean:.3g} times less{interval}, "
            f"less in {(other < one).sum()} of {args.seeds} seeds"
        )


if __name__ == "__main__":
    main()
