"""Certificates of many policies: samples that name the safest, and the rate of wrong verdicts.

    python benchmarks/certification.py allocation [--runs 200]
    python benchmarks/certification.py verdicts [--runs 200]
    python benchmarks/certification.py policies [--runs 200] [--configurations 64]

`allocation` races 64 arms whose rates are known against uniform allocation: equal samples for all,
as many as it needs to name a safest arm in 95 % of runs (found by bisection: it stops at the
right time, as no one could who does not know the rates). `verdicts` counts the runs of the whole
allocation in which any of 64 verdicts is wrong. `policies` trains configurations of PPO on the
cart-pole, samples each heavily, and does both with what was sampled; it also times `certify`.
Ties count as right. None of it is timed but the last.
"""

import argparse
import time

import numpy as np

from verifai_jax.addons.estimation.certification import certify, race
from verifai_jax.addons.estimation.certification.allocation import Allocation
from verifai_jax.addons.estimation.simultaneous_interval import simultaneous_interval, verdict

PROFILES = {
    "facts": np.r_[0, 0, 0.004, 0.035, 0.299, 0.357, np.linspace(0.05, 0.9, 58)],
    "one clear best": np.r_[0.002, np.linspace(0.02, 0.8, 63)],
    "zero and three near": np.r_[0, 0.003, 0.004, 0.005, np.linspace(0.01, 0.6, 60)],
    "near ties": np.r_[0.01, 0.015, 0.015, 0.02, 0.02, 0.02, np.linspace(0.03, 0.7, 58)],
    "linear from zero": np.arange(64) / 160,
    "none is good": np.linspace(0.1, 0.9, 64),
    "half at zero": np.r_[np.zeros(32), np.geomspace(0.005, 1, 32)],
    "skewed": np.r_[0.0005, 0.0025, 0.004, 0.006, np.geomspace(0.01, 1, 60)],
}
TARGET = 0.95


def uniform_need(rates, runs=4000, seed=1):
    """Return the samples an arm with which the least failures name a safest one in 95 % of runs."""
    random = np.random.default_rng(seed)

    def success(n):
        counts = random.binomial(n, rates, (runs, len(rates)))
        named = np.argmin(counts + random.random(counts.shape) / 2, axis=1)
        return np.mean(rates[named] == rates.min())

    low, high = 0, 1
    while success(high) < TARGET:
        low, high = high, 2 * high
        if high > 2**24:
            return high
    while high - low > max(1, low // 50):
        middle = (low + high) // 2
        low, high = (low, middle) if success(middle) >= TARGET else (middle, high)
    return high


def bernoulli(rates, random):
    """Draws of independent arms."""
    return lambda arm, n: int(random.binomial(n, rates[arm]))


def races(rates, runs, draw_of=bernoulli, tie=0.001):
    """Return how often the race named a safest arm, one within the tie, and its samples by run."""
    right, near, cost = [], [], []
    for run in range(runs):
        random = np.random.default_rng([7, run])
        order = random.permutation(len(rates))
        draw = draw_of(rates, random)
        found = race(lambda arm, n, d=draw, o=order: d(o[arm], n), len(rates), tie=tie)
        rate = rates[order[found.arm]]
        right.append(rate == rates.min())
        near.append(rate <= rates.min() + tie)
        cost.append(int(found.simulations.sum()))
    return np.mean(right), np.mean(near), np.array(cost)


def compare(name, rates, runs, draw_of=bernoulli, tie=0.001):
    uniform = uniform_need(rates) * len(rates)
    right, near, cost = races(rates, runs, draw_of, tie)
    print(
        f"{name:20s} tie {tie:g}  uniform {uniform:9,d}  race {cost.mean():8,.0f} "
        f"(at most {cost.max():,})  share {cost.mean() / uniform:.3f}  "
        f"safest named {right:.3f}, up to the tie {near:.3f}",
        flush=True,
    )


def verdicts_of(rates, random, p, budget, draw_of=bernoulli, samples=512):
    """Return the verdicts of one run of the whole allocation, and its samples."""
    allocation, draw = Allocation(p=p, samples=samples, budget=budget), draw_of(rates, random)
    failures, simulations = np.zeros(len(rates), int), np.zeros(len(rates), int)
    while (blocks := allocation.next(failures, simulations)).any():
        for arm in np.flatnonzero(blocks):
            count = int(blocks[arm]) * allocation.block
            failures[arm] += draw(arm, count)
            simulations[arm] += count
    pairs = zip(failures, simulations, strict=True)
    return [
        verdict(simultaneous_interval(k, n, 0.95, len(rates)), p) for k, n in pairs
    ], simulations


def count_wrong(name, rates, runs, p, draw_of=bernoulli):
    wrong_safe = wrong_any = open_ = total = 0
    for run in range(runs):
        random = np.random.default_rng([3, run])
        found, simulations = verdicts_of(rates, random, p, 4 * 512 * len(rates), draw_of)
        safe = np.array([one.startswith("safe") for one in found])
        unsafe = np.array([one == "unsafe" for one in found])
        wrong_safe += bool((safe & (rates >= p)).any())
        wrong_any += bool((safe & (rates >= p)).any() or (unsafe & (rates <= p)).any())
        open_ += np.sum(~safe & ~unsafe)
        total += simulations.sum()
    print(
        f"{name:20s} p {p:g}: runs with a wrong safe@p {wrong_safe} of {runs}, with any wrong "
        f"verdict {wrong_any}; undecided {open_ / runs:.1f} of {len(rates)}; "
        f"{total / runs:,.0f} samples",
        flush=True,
    )


def trained(configurations):
    """Train policies of PPO with many learning rates, discounts and seeds."""
    from envs.cartpole_task import CartPoleTask
    from verifai_jax.addons.rl import PPO, BatchedTraining, Configuration

    random = np.random.default_rng(0)
    made = [
        Configuration(
            CartPoleTask(),
            PPO(
                learning_rate=float(10 ** random.uniform(-3.7, -2)),
                discount=float(1 - 10 ** random.uniform(-2.5, -1)),
            ),
            steps=32_768,
            seed=seed,
        )
        for seed in range(configurations)
    ]
    training = BatchedTraining(made)
    for _ in training.advance(dict.fromkeys(range(configurations), 32_768)):
        pass
    return [training.policy(number) for number in range(configurations)]


def policies(configurations, runs, heavy):
    from specs.cartpole import balance_with
    from verifai_jax.addons.estimation.certification.blocks import Blocks

    some = trained(configurations)
    for kind in ("first", "again"):
        started = time.perf_counter()
        found = certify(balance_with, some[:32])
        print(f"certify, {kind}: {time.perf_counter() - started:.1f} s")
    print(found)
    blocks = Blocks(balance_with, some, seed=1, lanes=64)
    pairs = [(i, block) for i in range(len(some)) for block in range(heavy // 64)]
    failing = np.zeros((len(some), heavy), bool)
    started = time.perf_counter()
    for (i, block), verdicts in blocks.certificate(pairs):
        failing[i, block * 64 : (block + 1) * 64] = verdicts.violated | ~verdicts.proper
    seconds = time.perf_counter() - started
    print(f"{failing.size:,} samples in {seconds:.1f} s, {failing.size / seconds:,.0f} a second")
    rates = failing.mean(axis=1)
    print("rates, sorted:", np.round(np.sort(rates)[:16], 5), "...")

    def replayed(rates, random):
        """Return a draw from the samples, in an order that is the same for all arms."""
        order, taken = random.permutation(heavy), np.zeros(len(rates), int)

        def draw(arm, n):
            indices = order[(taken[arm] + np.arange(n)) % heavy]
            taken[arm] += n
            return int(failing[arm, indices].sum())

        return draw

    for tie in (0.001, 0.0001):  # That of `certify` is the second, for 64 policies.
        compare("cart-pole", rates, runs, replayed, tie)
    for p in (0.01, 0.05):
        count_wrong("cart-pole", rates, runs, p, replayed)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("what", choices=["allocation", "verdicts", "policies"])
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--configurations", type=int, default=64)
    parser.add_argument("--heavy", type=int, default=20_480, help="samples that give known rates")
    given = parser.parse_args()
    if given.what == "allocation":
        for name, rates in PROFILES.items():
            compare(name, rates, given.runs)
    elif given.what == "verdicts":
        for name, rates in PROFILES.items():
            count_wrong(name, rates, given.runs, 0.01)
        at_p = np.r_[np.full(32, 0.01), np.linspace(0, 0.05, 32)]
        count_wrong("half exactly at p", at_p, given.runs, 0.01)
    else:
        policies(given.configurations, given.runs, given.heavy)


if __name__ == "__main__":
    main()
