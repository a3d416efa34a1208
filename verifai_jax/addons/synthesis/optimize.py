"""Optimisation of parameters over a fixed set of environments.

The value of parameters is their least robustness over the set. The `Archive` holds all evaluated
parameters. A `merit` orders choices: for a synthesis by value alone, for a repair by value and then
by distance from the nominal parameters.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from verifai_jax.addons.synthesis.budget import Budget
from verifai_jax.addons.synthesis.parametric import Pairs, Parametric, accepted

ACTIVE = 16
"""Environments, the least robust ones, that decide a step; its result is evaluated in all."""
FIRST = 6
"""Hardest environments, in which candidates are evaluated before the others."""
EXPLORED = 0.2
"""Share of the candidates of cross-entropy that are drawn from anywhere."""
MIN_BATCH = 8
"""Candidates below which a round of cross-entropy is not made."""
MIN_RADIUS = 1e-5
"""Share of the first radius below which a climb ends."""
MAX_DIFFERENCES = 12
"""Parameters up to which differences take the place of gradients."""
MAX_REFUSED = 1000
"""Draws in a row without one that the constraint accepts, after which no more are made."""
Thetas: TypeAlias = Float[np.ndarray, "k p"] | Sequence[Float[np.ndarray, " p"]]
Environments: TypeAlias = Float[np.ndarray, "n d"]
Merit = Callable[[np.ndarray, float], tuple[float, ...]]
Propose = Callable[[np.ndarray, np.ndarray, np.ndarray, float], list[np.ndarray]]


class Choice(NamedTuple):
    """Parameters, with their least robustness and the number of environments for it."""

    theta: Float[np.ndarray, " p"]
    value: float
    environments: int


class Archive:
    """All parameters that were evaluated, newest last."""

    def __init__(self) -> None:
        self.choices: list[Choice] = []

    def add(self, thetas: Thetas, values: Iterable[float], environments: int) -> None:
        """Add choices of parameters `[k, p]` with their values `[k]`."""
        for theta, value in zip(np.asarray(thetas), values, strict=True):
            self.choices.append(Choice(theta, float(value), environments))

    def best(self, count: int, merit: Merit, apart: float = 0.0) -> list[Choice]:
        """Return the best distinct choices, at least `apart` from each other in some coordinate."""
        taken: list[Choice] = []
        names: set[bytes] = set()
        for choice in sorted(self.choices, key=lambda c: merit(c.theta, c.value), reverse=True):
            if (name := choice.theta.tobytes()) in names:
                continue
            names.add(name)
            if not apart or all(np.abs(choice.theta - t.theta).max() > apart for t in taken):
                taken.append(choice)
            if len(taken) == count:
                break
        return taken


def value_merit(theta: np.ndarray, value: float) -> tuple[float, ...]:
    """Return the merit of choices in a synthesis, which is their value."""
    return (value,)


def worst_case(pairs: Pairs) -> Float[np.ndarray, " k"]:
    """Return the value of each choice of parameters; negative if it fails in an environment.

    It is minus infinity if a simulation has no verdict in an environment where other parameters
    have one, or if no environment is possible.
    """
    known = np.any(pairs.proper, axis=0)
    rho = np.where(pairs.proper, pairs.rho, -np.inf)[:, known]
    # At exactly zero the Boolean semantics have decided.
    rho = np.where(pairs.failing[:, known] & (rho >= 0), -np.finfo(np.float32).tiny, rho)
    value = np.min(rho, axis=1, initial=np.inf)
    return np.where(np.isposinf(value), -np.inf, value)


def typical_size(rho: Sequence[float]) -> float:
    """Return a typical size of the robustness, which is positive."""
    sizes = np.abs(np.asarray(rho, float))
    sizes = sizes[np.isfinite(sizes) & (sizes > 0)]
    return float(np.median(sizes)) if len(sizes) else 1.0


def evaluate(
    loop: Parametric, thetas: Thetas, environments: Environments, archive: Archive | None = None
) -> Float[np.ndarray, " k"]:
    """Evaluate parameters `[k, p]` over the set; return their values."""
    values = worst_case(loop.evaluate(thetas, environments))
    if archive is not None:
        archive.add(thetas, values, len(environments))
    return values


def explore(
    loop: Parametric, environments: Environments, archive: Archive, limits: Budget, *, merit: Merit,
    batch: int, rng: np.random.Generator,
) -> None:  # fmt: skip
    """Evaluate parameters over their whole space, then around the best ones."""
    size, half = max(1, len(environments)), limits.slice(limits.left // 2)
    refused = 0
    while half.left >= size and refused < MAX_REFUSED:
        # One in each of as many slices of every coordinate: a Latin hypercube.
        cells = np.argsort(rng.random((batch, loop.dim)), axis=0)
        thetas = (cells + rng.random(cells.shape)) / batch
        if loop.environment is None:
            thetas = thetas[accepted(loop.problem.space, thetas.astype(np.float32))]
        refused = 0 if len(thetas) else refused + 1
        thetas = thetas[: half.left // size]
        if len(thetas):
            known = archive.best(max(4, batch // 5), merit)
            level = merit(known[-1].theta, known[-1].value) if len(known) > 3 else (-np.inf,)
            _screen(loop, thetas, np.asarray(environments), archive, merit, level)
    best = archive.best(max(4, batch // 5), merit)
    if best:
        cross_entropy(
            loop, [c.theta for c in best], environments, archive, limits,
            merit=merit, batch=batch, rng=rng, rounds=1000,
        )  # fmt: skip


def climb(
    loop: Parametric, thetas: Thetas, environments: Environments, archive: Archive, limits: Budget,
    *, propose: Propose, merit: Merit, scale: float, radius: float, steps: int = 40,
) -> list[Choice]:  # fmt: skip
    """Follow the gradients of the least robust environments from all starts in parallel.

    **Arguments:**
    - `propose(theta, rho, gradients, radius)`: returns candidates for a step, the largest first.

    A step is taken if simulations show an improvement; the radius adapts to its success.
    """
    thetas = np.array(thetas, np.float64)[: limits.left // max(1, len(environments))]
    if not len(thetas):
        return []
    rho = loop.evaluate(thetas, environments)
    now = [Choice(t, v, len(environments)) for t, v in zip(thetas, worst_case(rho), strict=True)]
    rhos = [np.where(ok, r, np.inf) for r, ok in zip(rho.rho, rho.proper, strict=True)]
    archive.add(thetas, [choice.value for choice in now], len(environments))
    radii = np.full(len(now), radius)
    for _ in range(steps):
        alive = [
            i for i, r in enumerate(radii) if r >= MIN_RADIUS * radius and now[i].value > -np.inf
        ]
        if not alive:
            break
        for i in alive:
            hardest = np.asarray(environments)[np.argsort(rhos[i], kind="stable")[:ACTIVE]]
            tries = 8 if loop.differentiable else 9 + int(loop.free.sum())
            if limits.left < tries * len(hardest) + len(environments):
                return now
            # Cooler as steps get shorter: the kinks of the robustness matter then.
            warmth = scale * max(0.001, 0.02 * min(1.0, radii[i] / radius))
            values, gradients = _gradients(loop, now[i].theta, hardest, warmth, 0.1 * radii[i])
            candidates = propose(now[i].theta, values, gradients, radii[i])
            candidates = [c for c in candidates if np.any(c != now[i].theta)]
            if not candidates:
                radii[i] = 0.0
                continue
            tried = evaluate(loop, candidates, hardest)
            order = sorted(
                range(len(candidates)), key=lambda j: merit(candidates[j], tried[j]), reverse=True
            )
            winner = candidates[order[0]]
            whole = loop.evaluate(winner[None], environments)
            value = float(worst_case(whole)[0])
            archive.add([winner], [value], len(environments))
            before, after = merit(now[i].theta, now[i].value), merit(winner, value)
            if after > before:
                now[i] = Choice(winner, value, len(environments))
                rhos[i] = np.where(whole.proper[0], whole.rho[0], np.inf)
                gain = max(abs(a - b) for a, b in zip(after, before, strict=True))
                radii[i] *= 2.0 if order[0] == 0 else 0.7
                if gain < 1e-5 * scale:
                    radii[i] /= 20
            else:
                radii[i] /= 10
            radii[i] = min(radii[i], 4 * radius)
    return now


def has_gradients(loop: Parametric) -> bool:
    """Return whether there are gradients, or few enough parameters for finite differences."""
    return loop.differentiable or (loop.bounded and 0 < int(loop.free.sum()) <= MAX_DIFFERENCES)


def _gradients(
    loop: Parametric, theta: np.ndarray, environments: Environments, warmth: float, gap: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return robustness `[n]`, infinite without a verdict, and gradients `[n, p]`, zero there."""
    if loop.differentiable:
        pairs = loop.evaluate(theta[None], environments, warmth)
        assert pairs.by_parameters is not None
        return np.where(pairs.proper[0], pairs.rho[0], np.inf), pairs.by_parameters[0]
    indices = np.flatnonzero(loop.free)
    # Away from the nearer end of the cube; wide enough that float32 has digits left.
    gaps = np.where(theta[indices] > 0.5, -1.0, 1.0) * np.clip(gap, 1e-3, 0.02)
    shifted = np.repeat(theta[None], len(indices), axis=0)
    shifted[np.arange(len(indices)), indices] += gaps
    pairs = loop.evaluate(np.concatenate([theta[None], shifted]), environments)
    rho = np.where(pairs.proper & np.isfinite(pairs.rho), pairs.rho, np.nan)
    gradients = np.zeros((len(environments), loop.dim))
    gradients[:, indices] = np.nan_to_num((rho[1:] - rho[0]) / gaps[:, None]).T
    return np.where(np.isnan(rho[0]), np.inf, rho[0]), gradients


def cross_entropy(
    loop: Parametric, thetas: Thetas, environments: Environments, archive: Archive, limits: Budget,
    *, merit: Merit, batch: int, rng: np.random.Generator, rounds: int = 8,
) -> None:  # fmt: skip
    """Search around good parameters without gradients by sampling, elites and narrowing.

    De Boer, Kroese, Mannor, Rubinstein, A tutorial on the cross-entropy method (2005), algorithm
    3.3, with the elite kept over the rounds. Discrete coordinates are inherited or drawn anew.
    """
    environments, size = np.asarray(environments), max(1, len(environments))
    affordable = limits.left // size
    if affordable < MIN_BATCH:
        return
    points = np.array(thetas, np.float64)[: max(1, affordable // 3)]
    pairs = loop.evaluate(points, environments)
    values = worst_case(pairs)
    archive.add(points, values, len(environments))
    # What is hard for the best is hard for most: with these first, few are simulated in all.
    best = max(range(len(points)), key=lambda j: merit(points[j], values[j]))
    rho = np.where(pairs.proper[best], pairs.rho[best], np.inf)
    environments = environments[np.argsort(rho, kind="stable")]
    maximum, std = max(4, batch // 5), np.full(loop.dim, 0.1)
    for _ in range(rounds):
        affordable = limits.left // size
        if affordable < MIN_BATCH:
            return
        order = sorted(range(len(points)), key=lambda j: merit(points[j], values[j]), reverse=True)
        points, values = points[order[:maximum]], values[order[:maximum]]
        if len(points) == maximum:
            std = np.clip(1.5 * points.std(axis=0), 1e-4, 0.2)
            if np.all(std[loop.free] == 1e-4) and loop.free.all():
                return
        count = min(batch, max(MIN_BATCH, affordable // 3))
        level = merit(points[-1], values[-1]) if len(points) == maximum else (-np.inf,)
        parents = points[rng.integers(0, len(points), 4 * count)]
        drawn = parents + std * rng.normal(size=parents.shape)
        # A few anywhere: what was best in the old set need not be near what is in this one.
        anywhere = rng.random((len(parents), 1)) < EXPLORED
        parents = np.where(anywhere, rng.random(parents.shape), parents)
        anew = rng.random(parents.shape) < 0.1
        other = np.where(anew, rng.random(parents.shape), parents)
        drawn = np.clip(np.where(loop.free, drawn, other), 0.0, 1.0)
        # Some are too far from the nominal parameters, whatever their value.
        drawn = drawn[[merit(theta, np.inf) > level for theta in drawn]][:count]
        if not len(drawn):
            return
        drawn, fresh = _screen(loop, drawn, environments, archive, merit, level)
        points, values = np.concatenate([points, drawn]), np.concatenate([values, fresh])


def _screen(
    loop: Parametric, thetas: np.ndarray, environments: np.ndarray, archive: Archive, merit: Merit,
    level: tuple[float, ...],
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return parameters whose merit may exceed `level` after the first environments, and values."""
    if len(environments) < 2 * FIRST:
        return thetas, evaluate(loop, thetas, environments, archive)
    bounds = evaluate(loop, thetas, environments[:FIRST])
    left = [j for j, pair in enumerate(zip(thetas, bounds, strict=True)) if merit(*pair) > level]
    thetas, bounds = thetas[left], bounds[left]
    if not left:
        return thetas, bounds
    values = np.minimum(bounds, evaluate(loop, thetas, environments[FIRST:]))
    archive.add(thetas, values, len(environments))
    return thetas, values
