"""Planted modes of failure: how many `vj.modes` finds, and how right their numbers are.

python benchmarks/modes.py                          # everything, 20 seeds: one hour
python benchmarks/modes.py --seeds 3 --dims 2 10 --shapes half-spaces

Half-spaces in directions at right angles, balls in normal space, balls inside a box of uniform
features, which no corner and no tail leads to, cells: failures that need three of the features
near certain values, other ones in every mode, and any values of the rest; slabs, which are narrow
in two directions oblique to the features, and corners, which lie beyond limits in two of them. The
robustness falls to them at different speeds, so that a population that follows it gathers in few of
them. Masses and distances are known. A line says in how many runs every mode of at least 0.5 % of
the probability was found, how many 95 % intervals hold the true mass, and the greatest ratio of the
distance of a likeliest point to the true one, which uniform features do not have.
"""

import argparse
import math
import time
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.stats import ncx2, norm

import verifai_jax as vj

MIN_MASS = 0.005
"""Part of the probability from which a mode has to be found."""


class Planted(NamedTuple):
    """A problem with modes: their masses, distances (None: as probable everywhere), and margins."""

    problem: vj.Problem
    masses: np.ndarray
    distances: np.ndarray | None
    margins: Callable[[np.ndarray], np.ndarray]  # from features [d] to the margin of each mode


def posed(name: str, domain: vj.Box | vj.Normal, dim: int, robustness) -> vj.Problem:
    """A system of one sample, whose only signal is the robustness."""

    def system(features, key):
        return vj.Trace({"margin": robustness(features["x"])[None]}, dt=1.0)

    return vj.Problem(name, {"x": vj.Array(domain, dim)}, system, "margin >= 0")


def half_spaces(dim: int, count: int) -> Planted:
    """Half-spaces at right angles, whose robustness falls at speeds up to fifty times apart."""
    random = np.random.default_rng(1000 * dim + count)
    axes = np.linalg.qr(random.standard_normal((dim, dim)))[0].T
    directions = np.concatenate([axes, -axes])[:count]
    distances = np.sort(random.uniform(3.7, 4.6, count))
    speeds = np.exp(random.uniform(-2, 2, count))
    normals, offsets = jnp.asarray(directions, jnp.float32), jnp.asarray(distances, jnp.float32)
    factors = jnp.asarray(speeds, jnp.float32)
    problem = posed(
        f"half_spaces_{dim}_{count}",
        vj.Normal(0.0, 1.0),
        dim,
        lambda x: jnp.min((offsets - normals @ x) * factors),
    )
    return Planted(problem, norm.sf(distances), distances, lambda x: distances - directions @ x)


def islands(
    name: str, domain: vj.Box | vj.Normal, centres, radii, speeds, masses, distances
) -> Planted:
    """Balls of these centres and radii."""
    middles, reach = jnp.asarray(centres, jnp.float32), jnp.asarray(radii, jnp.float32)
    factors = jnp.asarray(speeds, jnp.float32)
    problem = posed(
        name,
        domain,
        centres.shape[1],
        lambda x: jnp.min((jnp.linalg.norm(x - middles, axis=1) - reach) * factors),
    )
    return Planted(
        problem, masses, distances, lambda x: np.linalg.norm(x - centres, axis=1) - radii
    )


def balls(dim: int, count: int) -> Planted:
    """Balls in normal space, 3.3 to 4.2 from the origin, with speeds up to four times apart."""
    random = np.random.default_rng(2000 * dim + count)
    axes = np.linalg.qr(random.standard_normal((dim, dim)))[0].T
    far = random.uniform(3.3, 4.2, count)
    centres = np.concatenate([axes, -axes])[:count] * far[:, None]
    wanted = 10 ** random.uniform(-5.3, -4, count)
    radii = np.sqrt(ncx2.ppf(wanted, dim, far**2))
    speeds = np.exp(random.uniform(-0.7, 0.7, count))
    masses = ncx2.cdf(radii**2, dim, far**2)
    name = f"balls_{dim}_{count}"
    return islands(name, vj.Normal(0.0, 1.0), centres, radii, speeds, masses, far - radii)


def balls_in_a_box(dim: int, count: int) -> Planted:
    """Balls inside the unit cube of uniform features, apart from one another and the faces."""
    random = np.random.default_rng(3000 * dim + count)
    masses = 10 ** random.uniform(-5, -4, count)
    radii = (masses * math.gamma(dim / 2 + 1) / math.pi ** (dim / 2)) ** (1 / dim)
    speeds = np.exp(random.uniform(-0.7, 0.7, count))
    while True:
        centres = np.stack([random.uniform(r, 1 - r, dim) for r in radii])
        gaps = np.linalg.norm(centres[:, None] - centres, axis=2) - radii - radii[:, None]
        if np.all(gaps[~np.eye(count, dtype=bool)] > 0.05):
            break
    name = f"balls_in_a_box_{dim}_{count}"
    return islands(name, vj.Box(0.0, 1.0), centres, radii, speeds, masses, None)


def cells(dim: int, count: int) -> Planted:
    """Boxes in three of the uniform features each, as wide as the space in all others."""
    random = np.random.default_rng(4000 * dim + count)
    centres, reach = np.full((count, dim), 0.5), np.full((count, dim), 1.0)
    masses = 10 ** random.uniform(-5, -4, count)
    for centre, half, mass in zip(centres, reach, masses, strict=True):
        own = random.choice(dim, 3, replace=False)
        sides = np.exp(random.uniform(-0.5, 0.5, 3))
        sides *= (mass / sides.prod()) ** (1 / 3)
        centre[own], half[own] = random.uniform(sides / 2, 1 - sides / 2), sides / 2
    middles, widths = jnp.asarray(centres, jnp.float32), jnp.asarray(reach, jnp.float32)
    factors = jnp.asarray(np.exp(random.uniform(-0.7, 0.7, count)), jnp.float32)
    problem = posed(
        f"cells_{dim}_{count}",
        vj.Box(0.0, 1.0),
        dim,
        lambda x: jnp.min(jnp.max(jnp.abs(x - middles) - widths, axis=1) * factors),
    )
    return Planted(problem, masses, None, lambda x: np.max(np.abs(x - centres) - reach, axis=1))


def pairs_of_axes(random: np.random.Generator, dim: int, count: int) -> np.ndarray:
    """Two oblique directions `[count, 2, dim]` for each mode, all of them at right angles."""
    axes = np.linalg.qr(random.standard_normal((dim, dim)))[0].T[: 2 * count]
    return axes.reshape(count, 2, dim)


def slabs(dim: int, count: int) -> Planted:
    """Normal features within an interval in two directions oblique to them, other ones each."""
    random = np.random.default_rng(5000 * dim + count)
    axes = pairs_of_axes(random, dim, count)
    centres = random.uniform(2.2, 3.0, (count, 2)) * random.choice([-1, 1], (count, 2))
    reach = random.uniform(0.15, 0.4, (count, 2))
    masses = np.prod(norm.cdf(centres + reach) - norm.cdf(centres - reach), axis=1)
    directions, middles, widths = (jnp.asarray(a, jnp.float32) for a in (axes, centres, reach))
    factors = jnp.asarray(np.exp(random.uniform(-0.7, 0.7, count)), jnp.float32)
    problem = posed(
        f"slabs_{dim}_{count}",
        vj.Normal(0.0, 1.0),
        dim,
        lambda x: jnp.min(jnp.max(jnp.abs(directions @ x - middles) - widths, axis=1) * factors),
    )
    distances = np.linalg.norm(np.abs(centres) - reach, axis=1)
    return Planted(
        problem, masses, distances, lambda x: np.max(np.abs(axes @ x - centres) - reach, axis=1)
    )


def corners(dim: int, count: int) -> Planted:
    """Normal features beyond limits in two directions oblique to them at once, other ones each."""
    random = np.random.default_rng(6000 * dim + count)
    axes = pairs_of_axes(random, dim, count)
    limits = random.uniform(2.0, 2.7, (count, 2))
    directions, offsets = jnp.asarray(axes, jnp.float32), jnp.asarray(limits, jnp.float32)
    factors = jnp.asarray(np.exp(random.uniform(-0.7, 0.7, count)), jnp.float32)
    problem = posed(
        f"corners_{dim}_{count}",
        vj.Normal(0.0, 1.0),
        dim,
        lambda x: jnp.min(jnp.max(offsets - directions @ x, axis=1) * factors),
    )
    masses, distances = np.prod(norm.sf(limits), axis=1), np.linalg.norm(limits, axis=1)
    return Planted(problem, masses, distances, lambda x: np.max(limits - axes @ x, axis=1))


SHAPES = {
    "half-spaces": half_spaces,
    "balls": balls,
    "balls in a box": balls_in_a_box,
    "cells": cells,
    "slabs": slabs,
    "corners": corners,
}

DIMENSIONS = {
    "half-spaces": (2, 50),
    "balls": (2, 10),
    "balls in a box": (2, 5),
    "cells": (5, 50),
    "slabs": (10, 50),
    "corners": (10, 50),
}
"""Least and most of a shape: in more dimensions nothing but luck finds a ball."""
OBLIQUE = ("slabs", "corners")
"""Shapes of which a mode takes two dimensions, so that at most half as many fit."""


def measure(shape: str, dim: int, count: int, budget: int, seeds: int) -> str:
    """One line of the table."""
    planted = SHAPES[shape](dim, count)
    masses = planted.masses
    wanted = np.flatnonzero(masses >= MIN_MASS * masses.sum())
    complete = covered = intervals = extra = 0
    farthest, started = 1.0, time.perf_counter()
    for seed in range(seeds):
        found = vj.modes(planted.problem, budget, seed=seed, progress=False)
        own: dict[int, vj.Mode] = {}
        for mode in found:
            x = np.array([mode.features[f"x[{i}]"] for i in range(dim)])
            number = int(np.argmin(planted.margins(x)))
            extra += number in own
            own.setdefault(number, mode)
        complete += all(number in own for number in wanted)
        for number in set(wanted.tolist()) & set(own):
            mode = own[number]
            intervals += 1
            covered += mode.low <= masses[number] <= mode.high
            if planted.distances is not None:
                farthest = max(farthest, mode.distance / planted.distances[number])
    seconds = (time.perf_counter() - started) / seeds
    ratio = "" if planted.distances is None else f"{farthest:.4f}"
    return (
        f"| {shape} | {dim} | {count} | {complete}/{seeds} | {extra} | {covered}/{intervals} | "
        f"{ratio} | {seconds:.0f} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--budget", type=int, default=50_000)
    parser.add_argument("--dims", type=int, nargs="+", default=[2, 5, 10, 20, 50])
    parser.add_argument("--counts", type=int, nargs="+", default=[2, 4, 8])
    parser.add_argument("--shapes", nargs="+", choices=[*SHAPES], default=[*SHAPES])
    options = parser.parse_args()
    columns = "modes are", "d", "modes", "all found", "split", "masses", "distance", "s"
    print(f"| {' | '.join(columns)} |")
    print("|---|---|---|---|---|---|---|---|")
    for shape in options.shapes:
        for dim in options.dims:
            for count in options.counts:
                lowest, maximum = DIMENSIONS[shape]
                if count <= dim * (0.5 if shape in OBLIQUE else 2) and lowest <= dim <= maximum:
                    print(measure(shape, dim, count, options.budget, options.seeds), flush=True)


if __name__ == "__main__":
    main()
