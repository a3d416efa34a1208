"""Compiled scenes against Scenic's own sampler, side by side, and a search against sampling.

    .venv/bin/python benchmarks/scenes.py           # needs the extra: make .venv/scenic

Scenes: the cones program of the tests' gallery. Both sides draw scenes that keep all requirements;
rates are per second of CPU time of this process, sides alternating. Search: the braking problem of
`examples/scenic`, whose failure rate is measured first; simulations up to the first failure, by
`vj.falsify` with all defaults and by Scenic's own sampler.
"""

import random
import statistics
import sys
import time
import warnings
from pathlib import Path

import jax
import numpy as np
import pandas as pd

import verifai_jax as vj

warnings.simplefilter("ignore")

ROOT = Path(__file__).parent.parent
CONES = ROOT / "tests" / "scenes" / "gallery" / "cones.scenic"
ROUNDS, BATCH, CALLS, THEIRS = 5, 32_768, 4, 60
SEEDS, SAMPLED, MAX_SIMULATIONS, PRIOR = 10, 3, 30_000, 500_000


def scenes_per_second() -> None:
    """Print accepted scenes a second of CPU time, compiled and by Scenic."""
    program = vj.scenic(CONES)
    space = program.space

    @jax.jit
    def draw(key):
        u = jax.random.uniform(key, (BATCH, space.dim))
        features = jax.vmap(space.unflatten)(u)
        return jax.vmap(program.scenes)(features), jax.vmap(space.accepts)(features)

    begun = time.perf_counter()
    jax.block_until_ready(draw(jax.random.key(0)))
    print(f"compile: {time.perf_counter() - begun:.1f} s")
    ours, theirs, ratios = [], [], []
    for i in range(ROUNDS):
        begun, count = time.process_time(), 0
        for call in range(CALLS):
            scenes, accepted = draw(jax.random.fold_in(jax.random.key(i), call))
            jax.block_until_ready(scenes)
            count += int(np.sum(accepted))
        ours.append(count / (time.process_time() - begun))
        random.seed(i)
        begun = time.process_time()
        for _ in range(THEIRS):
            program.scenario.generate(maxIterations=10_000)
        theirs.append(THEIRS / (time.process_time() - begun))
        ratios.append(ours[-1] / theirs[-1])
    print(f"compiled: {statistics.median(ours):,.0f} scenes/s of CPU time")
    print(f"Scenic:   {statistics.median(theirs):,.0f} scenes/s of CPU time")
    print(f"ratio:    {statistics.median(ratios):,.0f} ({min(ratios):,.0f} to {max(ratios):,.0f})")


def simulations_to_a_failure() -> None:
    """Print simulations up to the first failure, by a search and by Scenic's sampler."""
    sys.path.insert(0, str(ROOT))
    from examples.scenic.cones import braking, scene

    space = braking.space
    fails = jax.jit(
        jax.vmap(lambda f: vj.robustness(braking.formulas["spec"], braking.system(f)) < 0)
    )
    failed = total = 0
    for start in range(0, PRIOR, BATCH):
        u = np.random.default_rng(start).random((BATCH, space.dim), np.float32)
        accepted = np.asarray(space.accepts_points(u))
        failed += int(np.sum(np.asarray(fails(space.features_at(u)))[accepted]))
        total += int(accepted.sum())
    rate = vj.clopper_pearson(failed, total)
    print(f"failure rate: {failed / total:.2e} ({rate}) of {total:,} scenes")
    searched = []
    for seed in range(SEEDS):
        run = vj.falsify(
            braking, budget=MAX_SIMULATIONS, stop=vj.Stop(after=1), seed=seed, confirm=False
        )
        rows = run.table.all
        broken = np.flatnonzero(rows["violated"].to_numpy(bool))
        searched.append(int(broken[0]) + 1 if len(broken) else len(rows))
        spent = len(rows)
        print(f"seed {seed}: row {searched[-1]} of {spent} simulations", flush=True)
        searched[-1] = spent
    sampled = []
    random.seed(0)
    block = 250
    for _ in range(SAMPLED):
        count = 0
        while count < MAX_SIMULATIONS:
            drawn = [scene.scenario.generate(maxIterations=10_000)[0] for _ in range(block)]
            rows = pd.DataFrame([scene.features_of(one) for one in drawn])
            features = space.features_of({name: rows[name].to_numpy() for name in rows})
            broken = np.flatnonzero(np.asarray(fails(features)))
            if len(broken):
                count += int(broken[0]) + 1
                break
            count += block
        sampled.append(count)
    print(
        f"search:  mean {statistics.mean(searched):,.0f}, median {statistics.median(searched):,.0f}"
    )
    print(f"Scenic:  mean {statistics.mean(sampled):,.0f}; by its rate {total / failed:,.0f}")
    print(f"ratio of means, by the rate: {total / failed / statistics.mean(searched):.1f}")


if __name__ == "__main__":
    scenes_per_second()
    simulations_to_a_failure()
