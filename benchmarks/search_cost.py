"""The cost of a search beside the simulations: microseconds of ask and tell for each point.

    python benchmarks/search_cost.py [--searches bayes,bandit]

Batches of 1024 points in 4 dimensions, compiled, 40 rounds after 10 to warm up; the median of the
rounds. Bayesian optimisation is measured as it is used: in batches of 8, from 500 observations on.
k-closest of 100 000 rows is measured at the end.
"""

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np

import verifai_jax as vj
from verifai_jax.core.values.cube import Cube
from verifai_jax.search import Observations

CUBE = Cube((0, 0, 0, 0))


def rounds(search, batch, warm, count):
    """Return the seconds of each round of ask and tell, after `warm` rounds."""
    init = jax.jit(search.init, static_argnums=(1, 2))
    ask = jax.jit(search.ask, static_argnums=(1, 2))
    tell = jax.jit(search.tell, static_argnums=1)
    rho = jax.jit(lambda u: jnp.linalg.norm(u - 0.3, axis=1) - 0.05)
    state, seconds = init(jax.random.key(0), CUBE, batch), []
    for _ in range(warm + count):
        started = time.perf_counter()
        u, state = jax.block_until_ready(ask(state, CUBE, batch))
        ask_seconds = time.perf_counter() - started
        gradient = 2 * (u - 0.3) if search.wants.gradient else None
        observations = Observations(u, rho(u), jnp.ones(batch, bool), gradient)
        observations = jax.block_until_ready(observations)
        started = time.perf_counter()
        state = jax.block_until_ready(tell(state, CUBE, observations))
        seconds.append(ask_seconds + time.perf_counter() - started)
    return np.array(seconds[warm:])


def main():
    """Measure and print one line a search."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--searches", default="", help="names, comma-separated")
    options = parser.parse_args()
    chosen = options.searches.split(",") if options.searches else vj.search.names()
    for name in chosen:
        if name == "bayes":
            continue
        seconds = rounds(vj.search.named(name), 1024, 10, 40)
        print(f"{name:<16}{np.median(seconds) / 1024 * 1e6:>9.3f} us a point, batch 1024")
    if "bayes" in chosen:
        for batch in (8, 16, 1):
            before = -(-500 // batch)
            seconds = rounds(vj.search.named("bayes"), batch, before, 40 if batch > 1 else 80)
            print(
                f"{'bayes':<16}{np.mean(seconds) / batch * 1e3:>9.3f} ms a point, batch {batch}, "
                "from 500 observations on (mean, refits included)"
            )
    if not options.searches:
        import pandas as pd

        table = pd.DataFrame(np.random.default_rng(0).random((100_000, 4)), columns=list("abcd"))
        table["rho"] = -1.0
        started = time.perf_counter()
        vj.analysis.k_closest(table, 10)
        print(f"{'k-closest':<16}{time.perf_counter() - started:>9.2f} s for 100 000 rows, k = 10")


if __name__ == "__main__":
    main()
