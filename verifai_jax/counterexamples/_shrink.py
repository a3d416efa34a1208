"""Shrinking of a counterexample to the smallest departure from nominal that still fails.

    small = shrink(run, 17, by="distance", budget=5000)

It minimises first the number of departures, then the distance, in batches and along gradients
(MacIver and Donaldson, Test-case reduction via test-case generation, ECOOP 2020).
"""

import math
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from jaxtyping import Array, Float, Key

from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.display.extensions import verb
from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.errors import suggests_options, unknown_name
from verifai_jax.counterexamples import selection
from verifai_jax.counterexamples.candidates import Candidates
from verifai_jax.counterexamples.fixed_key import fix_key, note_on_key
from verifai_jax.counterexamples.minimize_count import grow, minimize_count, revert_features
from verifai_jax.counterexamples.minimize_distance import minimize_distance
from verifai_jax.counterexamples.nominal import Likeliest, Nominal
from verifai_jax.counterexamples.remove_items import remove_items
from verifai_jax.counterexamples.shrunk import LogDensities, Shrunk, Step
from verifai_jax.evaluation.replay import Replay, replay
from verifai_jax.falsification.run import Run
from verifai_jax.features.density import log_density
from verifai_jax.features.domain import as_scalar
from verifai_jax.problem.problem import Problem

ORDERS = ("count", "distance", "likelihood")
OTHERS = 32
"""Other counterexamples of the run to begin with, at most."""
FOLLOWED = 5
"""Points that are followed along the boundary at once."""
DESCENTS = 8
"""Descents at once towards a failure elsewhere."""
AWAY = 0.002
"""Share by which the result is farther than the nearest failing point, for rounding's sake."""


@suggests_options
@shows_progress("shrinking a counterexample of")
def shrink(
    run: Run,
    row: selection.Row = None,
    *,
    nominal: Mapping[str, Any] | None = None,
    by: Literal["count", "distance", "likelihood"] = "count",
    budget: int = 2000,
    seed: int = 0,
    others: bool = True,
    stay: bool = False,
    progress: bool | None = None,
) -> Shrunk:
    """Find the smallest departure from the nominal features that still fails.

    **Arguments:**
    - `run`: a run of a problem, with a counterexample.
    - `row`: the number of a counterexample, or its row of the table; by default the worst, or the
      likeliest with `by="likelihood"`.
    - `nominal`: nominal features, instead of those of the problem, if any.
    - `by`: the measure to minimise. `"count"`: first the difference in the number of items of
      arrays of variable length, such as events; then the number of coordinates that are not exactly
      nominal, among them those of items that nominal does not have; then the distance. The result
      never departs in more coordinates than the row. `"distance"`: the distance alone. It is
      Euclidean in unit coordinates: each is 1 over its whole range (by probability, for a
      distribution), 1 between two choices, and measured by indices for integers. Every control
      point of a signal and every component of a vector is a coordinate. `"likelihood"`: it
      maximises the density of the prior, or the probability of choices. The likeliest features then
      replace the nominal ones, and the distance is the number of standard deviations at which a
      normal distribution is as improbable.
    - `budget`: maximum number of simulations; a gradient counts as one.
    - `seed`: the seed of the random candidates.
    - `others`: whether to start from other counterexamples of the run as well.
    - `stay`: whether every real feature stays on the row's side of nominal, so that failures of
      different kinds are shrunk separately.
    - `progress`: whether to show one line of progress; see `core.display.progress` for the default.

    All simulations use the random key of the row. The result was simulated alone and failed in the
    precision of the run, and also in float64 unless the system draws random numbers or is a black
    box. It is 0.2 % farther away than the nearest failing point, as a margin for rounding. Ctrl-C
    ends the search and returns the best result so far.

    **Raises:** `ValueError` for a run without a problem or a counterexample, a row that is not a
    counterexample or does not fail when simulated again, and a feature without a nominal value.
    """
    problem = selection.problem_of(run)
    if by not in ORDERS:
        raise unknown_name("order", by, ORDERS)
    check_count("budget", budget)
    at = _origin(problem, by, nominal)
    if row is None and isinstance(at, Likeliest) and len(failing := run.table.counterexamples):
        density = run.improbability(failing)["log_density"].to_numpy(float)
        row = int(failing.index.to_numpy()[np.argmax(density)])
    number, first = selection.select_row(run, row)
    about_key = note_on_key(problem, number)
    problem = fix_key(problem, run, number)
    key = run_keys(run.seed)[1]
    original = run.compared(replay(problem, first, key, number, run.precision))
    if not original.violated:
        reason = (
            f"robustness {min(original.rho.values()):z.4g}"
            if original.status == 0
            else original.status.name
        )
        refusal = (
            f"row {number} of the run of {run.name!r} does not fail when it is simulated again "
            f"({reason}); see what confirm says of it, and shrink another."
        )
        raise ValueError(" ".join([refusal, *original.warnings]))
    u = np.asarray(problem.space.point_of(problem.space.from_row(first)))
    start = at.settle(u[None])
    if stay:
        at = at.restrict_to_side(start[0])
    candidates = Candidates(problem, at, int(budget), run.precision)
    search = _Search(candidates, by, np.random.default_rng(seed), start)
    count = 4 * OTHERS if by == "likelihood" else OTHERS
    points = start
    if others:
        points = np.concatenate([start, selection.select_others(run, at, number, count)])
    notes, stopped = [], None
    try:
        search.search(points)
    except KeyboardInterrupt:
        stopped = "interrupted"
        notes.append("interrupted: the smallest departure so far")
    verified = _verified(problem, search, key, number, run.precision)
    u = start[0] if verified is None else verified[0]
    replayed = original if verified is None else verified[1]
    notes += [*candidates.notes, *about_key]
    return Shrunk(
        problem=problem,
        row=number,
        features=replayed.features,
        u=u,
        rho=min(replayed.rho.values()),
        changed=_changed(at, u),
        distance=float(at.distance(u[None])[0]),
        nominal=at.u,
        start_count=int(at.count(start)[0]),
        start_distance=float(at.distance(start)[0]),
        simulations=candidates.simulations,
        by=by,
        precision=run.precision,
        history=tuple(search.history),
        notes=tuple(notes),
        key=key,
        duration=original.duration,
        broken=_broken(replayed),
        start_broken=_broken(original),
        log_densities=_log_densities(at, u, start[0]),
        model_changed=original.changed,
        finding=original.finding,
        stopped=stopped,
    )


def _origin(problem: Problem, by: str, nominal: Mapping[str, Any] | None) -> Nominal:
    """Return the point from which failures depart: the nominal one, or the likeliest."""
    if by != "likelihood":
        return Nominal.of(problem, nominal)
    if nominal is not None:
        raise ValueError(
            "by='likelihood' measures departures from the likeliest features; leave out nominal="
        )
    verb("likelier")  # Without its add-on, which the search needs, it is refused here.
    return Likeliest.in_space(problem.space)


class _Search:
    """The order of a shrinking: fewer coordinates, a smaller distance, then other failures."""

    def __init__(
        self, candidates: Candidates, by: str, rng: np.random.Generator,
        start: Float[np.ndarray, "1 d"],
    ) -> None:  # fmt: skip
        self.candidates, self.by, self.rng = candidates, by, rng
        self.max_changed = int(candidates.nominal.count(start)[0])
        self.history: list[Step] = []

    def order(self, points: Float[np.ndarray, "n d"]) -> np.ndarray:
        """Return the order of points, the least departure first."""
        count, length = (
            self.candidates.nominal.count(points),
            self.candidates.nominal.distance(points),
        )
        if self.by == "count":
            return np.lexsort((length, count, self.candidates.nominal.items(points)))
        return np.lexsort((count, length))

    def failures(self) -> Float[np.ndarray, "n d"]:
        """Return all failing points so far, the least departure first."""
        points = self.candidates.points[self.candidates.failing]
        if self.by == "count":
            # However few its items, what departs in more than the row does is no smaller.
            points = points[self.candidates.nominal.count(points) <= self.max_changed]
        return points[self.order(points)]

    def note(self) -> None:
        points = self.failures()[:1]
        if len(points):
            nominal = self.candidates.nominal
            step = (int(nominal.count(points)[0]), float(nominal.distance(points)[0]))
            if not self.history or self.history[-1][1:] != step:
                self.history.append(Step(self.candidates.simulations, *step))

    def search(self, points: Float[np.ndarray, "n d"]) -> None:
        """Spend the budget; all failing points are in `candidates` afterwards."""
        candidates, nominal = self.candidates, self.candidates.nominal
        rho, _ = candidates(np.concatenate([nominal.u[None], points]))
        self.note()
        failures = self.failures()
        if not len(failures) or not nominal.count(failures[:1])[0]:
            return
        spread = [abs(r) for r in rho if math.isfinite(r)]
        # Smooth enough for a gradient where several instants compete, and near the hard value.
        candidates.temperature = max(0.02 * max(spread, default=1.0), 1e-6)
        # Half for what decides where to go, so that some is left to go there.
        candidates.limit = candidates.budget // 2
        if self.by == "count" and nominal.space.items:
            points = self.without_needless_items()
        if self.by == "count":
            own = points[:1][candidates(points[:1])[1]]
            minimize_count(candidates, self.starts(own, alike=False), self.rng)
        else:
            if self.by == "distance":
                grow(candidates, failures[:1], 1)
            revert_features(candidates, failures[0])
        likelier = verb("likelier") if self.by == "likelihood" else None
        if likelier is not None:
            if len(nominal.cube.continuous):
                # Slopes lead farther than samples do.
                half, spent = candidates.limit, candidates.simulations
                if candidates.differentiable:
                    candidates.limit = min(half, spent + candidates.budget // 8)
                likelier.draw_around_elite(candidates, self.rng)
                candidates.limit = half
            if len(nominal.cube.discrete):
                likelier.exchange_cells(candidates, self.rng)
        self.note()
        self.follow(self.starts(), rounds=15 if likelier else 60)
        candidates.limit = candidates.budget - 2 * nominal.space.dim
        self.follow(self.starts()[:1], rounds=15 if likelier else 60)
        # A boundary of many pieces has a nearest point on each: some of those next to this one.
        search_alongside(candidates, self.failures()[0], self.rng)
        for _ in range(8 if likelier else 1):
            before = self.failures()[0]
            if likelier is not None:
                likelier.shift_in_time(candidates, before)
            self.follow(self.starts(self.failures()[:1], cosine=0.97)[1:], rounds=10)
            if np.array_equal(self.failures()[0], before):
                break
        for _ in range(2):
            if candidates.left < candidates.budget // 20:
                break
            before = self.failures()[0]
            search_elsewhere(candidates, before, self.by == "count", self.rng)
            self.note()
            if not np.array_equal(self.failures()[0], before):
                self.follow(self.failures()[:1])
        self.follow(self.failures()[:1])
        # What departs by next to nothing need not depart.
        candidates.limit = candidates.budget
        revert_features(candidates, self.failures()[0])
        self.note()

    def without_needless_items(self) -> Float[np.ndarray, "1 d"]:
        """Return the failure with the fewest items, such as events; from now on none has more."""
        candidates = self.candidates
        lowest = remove_items(candidates, self.failures()[0])
        if int(candidates.nominal.count(lowest[None])[0]) > self.max_changed:
            return self.failures()[:1]
        candidates.max_items = int(candidates.nominal.items(lowest[None])[0])
        self.note()
        return lowest[None]

    def starts(
        self, first: Float[np.ndarray, "m d"] | None = None, *, alike: bool = True,
        cosine: float = 0.7,
    ) -> Float[np.ndarray, "n d"]:  # fmt: skip
        """Return the least failures in different directions, after those of `first`.

        **Arguments:**
        - `first` `[m, d]`: points that are returned at any rate.
        - `alike`: whether only failures with as few departures as the least one count.
        - `cosine`: the cosine of the angle between directions, at most.
        """
        failures, nominal = self.failures(), self.candidates.nominal
        if self.by == "count" and alike:
            count = nominal.count(failures)
            failures = failures[count == count[0]]
        chosen = [] if first is None else list(first)
        for u in failures:
            if len(chosen) >= FOLLOWED:
                break
            v, *departures = nominal.departure(np.stack([u, *chosen]))
            if all(v @ w < cosine * np.linalg.norm(v) * np.linalg.norm(w) for w in departures):
                chosen.append(u)
        return np.array(chosen)

    def follow(self, starts: Float[np.ndarray, "n d"], rounds: int = 60) -> None:
        """Move points along the boundary towards nominal."""
        if len(starts):
            minimize_distance(
                self.candidates, starts, self.rng, keep_nominal=self.by == "count", rounds=rounds
            )
            self.note()


def search_alongside(
    candidates: Candidates, u: Float[np.ndarray, " d"], rng: np.random.Generator
) -> None:
    """Search for failures in the same coordinates, slightly farther away in other directions."""
    nominal = candidates.nominal
    v = nominal.departure(u[None])[0]
    v[np.array(nominal.cube.levels) > 0] = 0
    reach = float(np.linalg.norm(v))
    moved = v * (1 + 0.6 * rng.standard_normal((64, len(v))))
    moved *= reach * rng.uniform(1, 1.2, (64, 1)) / _length(moved)
    points = np.repeat(u[None].astype(np.float64), 64, axis=0)
    candidates(np.where(v != 0, nominal.point_at(moved), points))


def search_elsewhere(
    candidates: Candidates, u: Float[np.ndarray, " d"], keep_count: bool, rng: np.random.Generator
) -> None:
    """Search for a failure nearer than `u` in other directions.

    With `keep_count` it departs in no more coordinates than `u`.

    It descends on the robustness from random nearer points, each on its own, so that they are not
    all drawn to the known failure.
    """
    nominal = candidates.nominal
    free = np.flatnonzero(np.array(nominal.cube.levels) == 0)
    maximum = min(int(nominal.count(u[None])[0]), len(free)) if keep_count else len(free)
    reach = 0.98 * float(nominal.distance(u[None])[0])
    if not maximum or not reach:
        return
    moved = np.zeros((40, nominal.space.dim))
    for row in moved:
        row[rng.permutation(free)[:maximum]] = rng.standard_normal(maximum)
    moved *= nominal.scale
    moved *= reach * rng.uniform(0.3, 1, (len(moved), 1)) / _length(moved)
    points = nominal.settle(nominal.point_at(moved))
    rho, failing = candidates(points)
    if failing.any():
        return
    order = np.argsort(rho)[:DESCENTS]
    here, level = points[order].astype(np.float64), rho[order]
    for turn in range(5):
        if candidates.left <= 0:
            return
        children = []
        for point, tangent in zip(here, candidates.tangents(here), strict=True):
            same = (point != nominal.u) | (not keep_count)
            noise = rng.standard_normal((5, len(point))) * same
            noise[:, np.array(nominal.cube.levels) > 0] = 0
            steps = 0.3 * 0.6**turn * reach * noise / _length(noise)
            slope = nominal.slope(point[None])[0]
            if tangent is not None and (gradient := tangent.gradient / slope * same).any():
                # To where the tangent is zero, half and twice as far.
                full = -max(tangent.value, 1e-9) * gradient / (gradient @ gradient)
                steps[:3] = np.outer([1.05, 0.5, 2.0], full)
            away = nominal.departure(point[None]) + steps
            nearer = nominal.point_at(away * np.minimum(1, reach / _length(away)))
            children.append(np.where(np.array(nominal.cube.levels) > 0, point, nearer))
        points = nominal.settle(np.concatenate(children))
        rho, failing = candidates(points)
        if failing.any():
            return
        best = rho.reshape(len(here), -1).argmin(axis=1) + 5 * np.arange(len(here))
        better = rho[best] < level
        here[better], level[better] = points[best][better], rho[best][better]


def _length(rows: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n 1"]:
    return np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)


def _verified(
    problem: Problem, search: _Search, key: Key[Array, ""], number: int, precision: str
) -> tuple[np.ndarray, Replay] | None:
    """Return the least failure that fails alone too, in float64 as well; None if none does.

    It is taken a little farther from nominal than the boundary, where rounding would decide.
    """
    nominal = search.candidates.nominal
    # In float64 other random numbers would be drawn, and a black box does not compute in it.
    exact = not problem.black_box and not problem.draws()
    for u in search.failures()[:20]:
        farther = nominal.point_at((1 + AWAY) * nominal.departure(u[None]))
        farther[:, nominal.cube.discrete] = u[nominal.cube.discrete]
        # By likelihood each bit counts.
        tried = (u,) if isinstance(nominal, Likeliest) else (nominal.settle(farther)[0], u)
        for point in tried:
            if not nominal.space.accepts_points(point[None])[0]:
                continue
            columns = selection.columns_at(problem, point)
            again = replay(problem, columns, key, number, precision)
            if again.violated and (
                not exact or replay(problem, columns, key, number, "float64").violated
            ):
                return point, again
    return None


def _changed(nominal: Nominal, u: Float[np.ndarray, " d"]) -> dict[str, tuple[Any, Any]]:
    """Return the coordinates that depart: the nominal value of each and that at `u`."""
    # One at a time, for which there is a program already.
    pair = [nominal.space.rows(nominal.space.features_at(v[None])) for v in (nominal.u, u)]
    columns = {name: (pair[0][name][0], pair[1][name][0]) for name in pair[0]}
    names = list(columns) if len(columns) == len(u) else []
    changed = {}
    for i in np.flatnonzero(nominal.departs(u[None])[0]):
        name = nominal.names[i]
        column = columns.get(name)
        if column is None and names:
            column = columns[names[i]]
        values = (nominal.u[i], u[i]) if column is None else column
        changed[name] = (None if nominal.lacks[i] else as_scalar(values[0]), as_scalar(values[1]))
    return changed


def _log_densities(at: Nominal, u: np.ndarray, start: np.ndarray) -> LogDensities | None:
    """Return the logarithms of the density of the result, its start, and the likeliest features."""
    if not isinstance(at, Likeliest):
        return None
    rows = at.space.rows(at.space.features_at(np.stack([u, start, at.u])))
    return LogDensities(*log_density(at.space, rows).tolist())


def _broken(replayed: Replay) -> tuple[str, ...]:
    """Return the names of the formulas that a simulation breaks, the worst one first."""
    broken = {name: rho for name, rho in replayed.rho.items() if rho < 0}
    # At exactly zero the Boolean semantics decide, and the least one is the one that they break.
    return tuple(sorted(broken, key=broken.__getitem__)) or (replayed.worst,)
