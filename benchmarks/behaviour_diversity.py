"""Behaviours found in a budget: plain searches, diverse in their inputs, diverse in what happens.

python benchmarks/behaviour_diversity.py            # everything, 10 seeds: some minutes
python benchmarks/behaviour_diversity.py --seeds 3 --budget 500

Three problems with behaviours that are counted from the inputs or the traces, not by the search's
own numbers: `bands` (two features, nine planted behaviours, eight of them in a band of 1.5 % of the
space), `boxes` (six features, twelve planted behaviours, a half-space of 30 % and eleven boxes of
0.1 % to 1 %) and `balance` of `specs/cartpole.py` (which of four bounds is crossed first, in which
eighth of the time). `stages` has no behaviours to count: its robustness says nothing before the
alarm of one in 16 000 samples, and the simulations to the first failure are counted.
"""

import argparse
from collections.abc import Callable, Hashable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import verifai_jax as vj
from specs import cartpole

Kinds = Callable[[vj.Run], set[Hashable]]
"""A function of a run to the behaviours of its failures."""


def bands() -> tuple[vj.Problem, Kinds]:
    """Return a wide region where all fails alike, and a thin one where a feature decides when."""

    def system(f, key):
        time, a, b = jnp.arange(16), f["a"], f["b"]
        wide = b > 0.6
        thin = (b > 0.585) & ~wide
        x = jnp.where(wide, 2.0, b) * jnp.ones(16)
        y = jnp.where(thin & (time // 2 == jnp.floor(8 * a)), 2.0, 0.5)
        return vj.Trace({"x": x, "y": y}, dt=1.0)

    def kinds(run: vj.Run) -> set[Hashable]:
        rows = run.table.violating
        return {-1 if row.b > 0.6 else int(8 * row.a) for row in rows.itertuples()}

    space = {"a": vj.Box(0, 1), "b": vj.Box(0, 1)}
    return vj.Problem("bands", space, system, "always (x < 1 & y < 1)"), kinds


def boxes() -> tuple[vj.Problem, Kinds]:
    """Return a half-space that fails in one way, and boxes that fail each in one of its own."""
    rng = np.random.default_rng(3)
    sides = np.geomspace(0.001, 0.01, 11) ** (1 / 6)
    low = np.column_stack([rng.uniform(0, 1 - sides) for _ in range(6)])
    # Outside of the half-space, which is the last 30 % of the first feature.
    low[:, 0] *= (0.7 - sides) / (1 - sides)
    lows, widths = jnp.asarray(low, jnp.float32), jnp.asarray(sides, jnp.float32)

    def system(f, key):
        u, time = f["u"], jnp.arange(24)
        outside = jnp.max(jnp.abs(u - lows - widths[:, None] / 2) - widths[:, None] / 2, axis=1)
        number = jnp.argmin(outside)
        lowest = outside[number]
        x = jnp.where(u[0] > 0.7, 0.5, 0.0) * jnp.ones(24)
        # Each box at a time, and on a side, of its own.
        spike = jnp.where(time // 4 == number % 6, 0.5 - lowest, 0.0)
        up = jnp.where(number < 6, spike, 0.0)
        down = jnp.where(number < 6, 0.0, spike)
        return vj.Trace({"x": x, "up": up, "down": down}, dt=1.0)

    def kinds(run: vj.Run) -> set[Hashable]:
        rows = run.table.violating
        u = rows[[f"u[{i}]" for i in range(6)]].to_numpy()
        inside = np.all((u[:, None] >= low) & (u[:, None] <= low + sides[:, None]), axis=2)
        found = set(np.flatnonzero(inside.any(axis=0)).tolist())
        return found | ({-1} if np.any((u[:, 0] > 0.7) & ~inside.any(axis=1)) else set())

    space = {"u": vj.Array(vj.Box(0, 1), 6)}
    formula = "always (x < 0.4 & up < 0.5 & down < 0.5)"
    return vj.Problem("boxes", space, system, formula), kinds


def balance() -> tuple[vj.Problem, Kinds]:
    """Return the cart-pole with its trained controller."""
    problem = cartpole.balance

    @jax.jit
    @jax.vmap
    def crossing(features):
        trace = problem.system(features, jax.random.key(0)).hold()
        x, theta = trace["x"], trace["theta"]
        margins = jnp.stack([2.4 - x, 2.4 + x, 0.20944 - theta, 0.20944 + theta])
        crossed = margins < 0
        first = jnp.where(jnp.any(crossed, axis=1), jnp.argmax(crossed, axis=1), trace.length)
        return jnp.argmin(first), jnp.min(first) * 8 // trace.length

    def kinds(run: vj.Run) -> set[Hashable]:
        rows = run.table.violating
        if not len(rows):
            return set()
        features = problem.space.features_of({name: rows[name].to_numpy() for name in rows})
        which, when = crossing(features)
        return set(zip(np.asarray(which).tolist(), np.asarray(when).tolist(), strict=True))

    return problem, kinds


def stages() -> vj.Problem:
    """Return six conditions one after the other; the alarm alone is in the formula."""

    def system(f, key):
        u = f["u"]
        depth = jnp.sum(jnp.cumprod((u > 0.3) & (u < 0.5)))
        alarm = jnp.where(depth == 6, 1.0, 0.0) * jnp.ones(8)
        return vj.Trace({"alarm": alarm, "depth": 1.0 * depth * jnp.ones(8)}, dt=1.0)

    return vj.Problem("stages", {"u": vj.Array(vj.Box(0, 1), 6)}, system, "always alarm < 0.5")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--budget", type=int, default=1000)
    arguments = parser.parse_args()
    settings = {"plain": None, "inputs": "inputs", "behaviour": "behaviour"}
    searches = ("cross_entropy", "portfolio")

    def looking(search: str, by: Any) -> vj.search.Search:
        inner = vj.search.named(search)
        return inner if by is None else vj.search.Diverse(inner, by=by)

    print(f"| problem | search | {' | '.join(settings)} |")
    print(f"|---|---|{'---|' * len(settings)}")
    for make in (bands, boxes, balance):
        problem, kinds = make()
        for search in searches:
            cells = []
            for diverse in settings.values():
                counts = []
                for seed in range(arguments.seeds):
                    # In batches of 16 as the others, which learn once a round.
                    run = vj.falsify(
                        problem, looking(search, diverse), arguments.budget, batch=16, seed=seed,
                        confirm=False, progress=False,
                    )  # fmt: skip
                    counts.append(len(kinds(run)))
                cells.append(f"{np.mean(counts):.1f} ({min(counts)} to {max(counts)})")
            print(f"| `{problem.name}` | {search} | {' | '.join(cells)} |", flush=True)
    problem, maximum = stages(), 5 * arguments.budget
    for search in searches:
        cells = []
        for diverse in settings.values():
            runs = [
                vj.falsify(
                    problem, looking(search, diverse), maximum, batch=16, seed=seed,
                    stop=vj.Stop(after=1), confirm=False, progress=False,
                )
                for seed in range(arguments.seeds)
            ]  # fmt: skip
            found = [run.simulations for run in runs if run.table.counts.violating]
            mean = f", mean {np.mean(found):.0f}" if found else ""
            cells.append(f"{len(found)} of {len(runs)}{mean}")
        print(f"| `stages` | {search} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
