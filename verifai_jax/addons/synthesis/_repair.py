"""Repair of a failing controller by the smallest sufficient change of its parameters.

    repair(problem, ["k_theta", "k_theta_dot"])          # from the problem's nominal features
    repair(run, ["k_theta"])                              # with the counterexamples of a run
    repair(problem, weights, system_of=closed_loop)       # a pytree of arrays, by gradients

Falsification and repair alternate: attack the present parameters by the environment; add the
counterexamples to a set; go to the parameters nearest to the nominal ones that satisfy the formula
on the whole set. With gradients this is a sequence of least-distance problems (sequential quadratic
programming: Nocedal and Wright, Numerical optimization, 2006, chapter 18), without them a
cross-entropy search. It ends when an attack finds nothing. As this proves nothing, failure rates
before and after are measured on fresh samples.
"""

import time
from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from verifai_jax.addons.synthesis import arguments, optimize
from verifai_jax.addons.synthesis.adversary import attack
from verifai_jax.addons.synthesis.aim import Aim, as_aim
from verifai_jax.addons.synthesis.budget import Budget, split_budget
from verifai_jax.addons.synthesis.failure_counts import FailureCounts
from verifai_jax.addons.synthesis.held_out import held_out
from verifai_jax.addons.synthesis.linear_steps import max_min_step, smallest_change
from verifai_jax.addons.synthesis.parametric import FeatureParameters, Parametric
from verifai_jax.addons.synthesis.region import Region, region_of
from verifai_jax.addons.synthesis.results import Repair, Round
from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.messages.checks import check_count, check_options, options_of
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.core.user_code.source_collection import sources_of
from verifai_jax.evaluation.run_on import RunOn
from verifai_jax.falsification.run import Run
from verifai_jax.falsification.validation import usual_batch
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Search
from verifai_jax.statistics.stopping import Stop

ADDED = 8
"""Counterexamples that a round adds to the set at most."""
CANDIDATES = 32
SLACK = 0.05
"""How far above the margin a repair aims, in ordinary robustnesses: the next worst case is near."""


@suggests_options
@shows_progress("repairing")
def repair(
    problem: Problem | Run,
    parameters: Any,
    budget: int = 20_000,
    *,
    nominal: Mapping[str, Any] | None = None,
    system_of: Callable[[Any], Any] | None = None,
    aim: Aim | Literal["robustness", "probability"] = "robustness",
    rounds: int = 30,
    gradient: bool | None = None,
    batch: int = 256,
    seed: int = 0,
    stop: Stop | None = None,
    precision: str = "float32",
    run_on: RunOn | None = None,
    progress: bool | None = None,
) -> Repair:
    """Change parameters as little as possible so that the formula holds in all counterexamples.

    **Arguments:**
    - `problem`: the problem that fails, or a run of it, whose counterexamples are used first.
    - `parameters`: names of features; or, with `system_of`, a pytree of arrays.
    - `budget`: maximum number of simulations, without those of the final check.
    - `nominal`: values of the parameters to start from; the problem's own when left out.
    - `system_of(parameters) -> system`: a pure function, traced by JAX. All features then belong to
      the environment.
    - `aim`: what the parameters are chosen for, and how that is checked: `"robustness"`,
      `"probability"`, or an `Aim` with its options.
    - `rounds`: maximum number of rounds, each an attack and a repair.
    - `gradient`: whether to follow gradients; by default if the present backend has them.
    - `stop`: the seconds of the work, a fifth of which is reserved for the check.
    - `run_on`: the backend of the simulations.
    - all other arguments: as in `falsify`.
    **Returns:** a `Repair`; after Ctrl-C the finished part, without the check.
    **Raises:** `ValueError` before anything compiles for unknown features, parameters without a
    nominal value, a problem without an environment, options out of range, or arrays of a system
    without gradients.
    """
    started = time.perf_counter()
    run = problem if isinstance(problem, Run) else None
    whole: Any = problem.problem if isinstance(problem, Run) else problem
    if whole is None:
        assert run is not None
        raise ValueError(f"the run of {run.name!r} has no problem: use vj.load(path, problem)")
    check_options(budget, batch, seed)
    max_seconds = options_of("repair", Stop, stop, "seconds").seconds
    backend = options_of("repair", RunOn, run_on, "backend").backend
    check_count("rounds", rounds)
    aim = as_aim(aim)
    margin = aim.margin
    if aim.of == "probability" and system_of is not None:
        raise ValueError(
            "arrays of parameters are repaired by gradients, for their robustness; "
            "aim='probability' needs features as parameters"
        )
    loop: Parametric
    if system_of is not None:
        loop = arguments.repaired_arrays(
            whole, parameters, system_of, nominal, gradient, batch, precision, seed
        )
        start = loop.start
    else:
        loop, start = arguments.repaired_features(
            whole, parameters, nominal, gradient, batch, budget, precision, backend, seed
        )
    search = arguments.attack_search(whole, aim.attack, loop)
    sources = sources_of(whole, system_of, made=whole.made_in or ())
    limits, checking = split_budget(lambda: loop.simulations, budget, started, max_seconds)
    region = region_of(loop, aim.mass)
    if aim.of == "probability":
        region = region_of(loop, 1.0)  # Samples are of the whole prior.
    assert region is not None
    work = _Repair(loop, start, search, limits, margin, seed, region)
    if aim.of == "probability":
        assert isinstance(loop, FeatureParameters)
        work.counts = FailureCounts(loop, margin, limits, seed, start)
    try:
        if run is not None:
            work.add_run(run)
        work.run(rounds)
        stopped = work.stopped
    except KeyboardInterrupt:
        stopped = "interrupted"
    before = after = None
    searched = loop.simulations
    if stopped != "interrupted" and aim.held_out:
        before, after = _check(loop, start, work.now.theta, aim.held_out, margin, seed, checking)
    robustness = work.robustness
    if after is not None and after.lowest is not None:
        robustness = min(robustness, after.lowest)
    theta = work.now.theta
    return Repair(
        name=whole.name,
        before=loop.values(start),
        parameters=loop.values(theta),
        rounds=tuple(work.turns),
        held_out_before=before,
        held_out_after=after,
        robustness=robustness,
        environments=len(work.environments),
        margin=margin,
        change=float(np.linalg.norm(theta - start)),
        found=stopped == "repaired",
        simulations=searched,
        without_verdict=loop.without_verdict,
        seconds=time.perf_counter() - started,
        stopped=stopped,
        seed=seed,
        arrays=system_of is not None,
        counted=None if work.counts is None else (work.counts.failing, work.counts.samples),
        notes=tuple(work.notes),
        make=lambda: loop.with_parameters(theta),
        make_nominal=lambda: loop.with_parameters(start),
        sources=sources.to_json(),
        changed="" if run is None else run.changed_since(),
    )


def _check(
    loop: Any, start: Any, theta: Any, count: int, margin: float, seed: int, limits: Budget
) -> Any:
    try:
        # What was repaired first: it matters more where time is short.
        after = held_out(loop, theta, count, margin, (seed, 1), limits)
        return held_out(loop, start, count, margin, (seed, 1), limits), after
    except KeyboardInterrupt:
        return None, None


class _Repair:
    """State of a repair, from which a result can be made at any time."""

    def __init__(
        self, loop: Parametric, start: Float[np.ndarray, " p"], search: Search, limits: Budget,
        margin: float, seed: int, region: Region,
    ) -> None:  # fmt: skip
        assert loop.environment is not None
        self.region = region
        self.loop, self.start, self.search, self.limits = loop, start, search, limits
        self.margin, self.seed = margin, seed
        self.rng = np.random.default_rng((seed, 2))
        # An attack that finds nothing costs a tenth of the budget; one that does costs less.
        self.share = min(arguments.ATTACK, max(64, limits.maximum // 10))
        self.batch = min(128, usual_batch(search, self.share))
        self.environments = np.zeros((0, loop.environment.dim), np.float32)
        self.now = optimize.Choice(start, np.inf, 0)
        self.robustness = np.inf
        self.deficit: float | None = None
        self.slack = 0.0
        self.archive = optimize.Archive()
        self.turns: list[Round] = []
        self.notes: list[str] = [region.describe()]
        self.counts: FailureCounts | None = None
        self.stopped = "rounds"

    def add_run(self, run: Run) -> None:
        """Begin with the environments of a run in which the nominal parameters fail."""
        rows = run.table.counterexamples
        space = self.loop.environment
        assert space is not None
        if len(rows):
            order = np.argsort(rows["rho"].to_numpy(), kind="stable")[: 4 * ADDED]
            points = space.points(rows.iloc[order])
            pairs = self.loop.evaluate(self.start[None], points)
            failing = pairs.violates(self.margin)[0]
            far = failing & ~self.region.contains(points)
            if far.any():
                self.notes.append(
                    f"{int(far.sum())} counterexamples of the run of {run.name!r} lie farther out "
                    "in the tails of the prior, and were left out"
                )
            failing &= ~far
            self.environments = points[failing][: 2 * ADDED].astype(np.float32)
            if failing.any():
                self.set_aim(pairs.rho[0])
        self.notes.append(
            f"{len(self.environments)} counterexamples came from the run of {run.name!r}"
        )

    def set_aim(self, rho: Float[np.ndarray, " n"]) -> None:
        """Set how far above the margin to aim, by the robustness of the nominal parameters."""
        if self.deficit is not None:
            return
        rho = rho[np.isfinite(rho)] - self.margin
        positive = rho[rho > 0]
        self.deficit = max(-float(np.min(rho, initial=0.0)), 1e-6)
        # A pole that has fallen has a deficit far beyond any margin that can be had.
        self.slack = SLACK * min(
            self.deficit, float(np.median(positive)) if len(positive) else np.inf
        )

    @property
    def aim(self) -> float:
        """Robustness that a repair aims for."""
        return self.margin + self.slack

    @property
    def enough(self) -> float:
        """Robustness that is enough."""
        return self.margin + 0.5 * self.slack

    def run(self, rounds: int) -> None:
        """Attack and repair in turn, or count failures."""
        if (counts := self.counts) is not None:
            try:
                counts.run()
            finally:
                self.now = optimize.Choice(counts.theta, counts.value, counts.samples)
                self.robustness, self.environments = counts.value, counts.environments
            self.stopped = "fewest failures" if counts.failing else "repaired"
            return
        if len(self.environments) and not self.repair_set():
            return
        for number in range(1, rounds + 1):
            if self.limits.exhausted:
                break
            result = attack(
                self.loop, self.now.theta, self.margin, self.limits.slice(self.share),
                search=self.search, batch=self.batch, seed=self.seed + 7919 * number,
                region=self.region,
                scale=self.deficit or 1.0,
            )  # fmt: skip
            count = int(result.violating.sum())
            change = float(np.linalg.norm(self.now.theta - self.start))
            self.turns.append(Round(len(result.rho), count, result.worst, change))
            self.robustness = min(result.worst, self.now.value)
            if not count:
                # What a handful of simulations does not find says nothing.
                thorough = not self.limits.exhausted or len(result.rho) >= self.share // 2
                self.stopped = "repaired" if thorough else self.limits.stopped_by
                if not np.isfinite(result.rho).any():
                    self.stopped = "no verdict"
                return
            self.set_aim(result.rho)
            self.environments = np.concatenate([self.environments, result.select(ADDED)])
            self.environments = self.environments.astype(np.float32)
            if not self.repair_set():
                return
        self.stopped = self.limits.stopped_by if self.limits.exhausted else "rounds"

    def repair_set(self) -> bool:
        """Move to the nearest parameters that keep the whole set; return whether there are any."""
        # What was near and what was robust in the old set may still be in this one.
        old = self.archive.best(4, self.merit) + self.archive.best(
            8, optimize.value_merit, apart=0.05
        )
        self.archive = archive = optimize.Archive()
        if self.limits.left < optimize.MIN_BATCH * len(self.environments):
            self.archive, self.stopped = archive, self.limits.stopped_by
            return False
        starts = np.stack([self.start, self.now.theta, *(choice.theta for choice in old)])
        affordable = max(2, self.limits.left // 4 // len(self.environments))
        optimize.evaluate(self.loop, starts[:affordable], self.environments, archive)
        scale = self.deficit or 1.0
        if optimize.has_gradients(self.loop):
            # From where it is now, and from the start anew: the nearest may lie elsewhere.
            starts = [self.now.theta] if np.all(self.now.theta == self.start) else [
                self.now.theta, self.start
            ]  # fmt: skip
            optimize.climb(
                self.loop, starts, self.environments, archive,
                self.limits.slice(self.limits.left // 3), propose=self.propose, merit=self.merit,
                scale=scale, radius=0.1 if self.loop.bounded else 0.1 * self.size,
            )  # fmt: skip
        best = archive.best(1, self.merit)[0]
        followed = optimize.has_gradients(self.loop) and self.loop.free.all()
        if self.loop.bounded and (best.value < self.enough or not followed):
            best = self.without_gradients(archive)
        if self.margin <= best.value < self.enough:
            # More than the margin is not to be had; the nearest that keeps it will do.
            self.slack = 0.0
            best = archive.best(1, self.merit)[0]
        self.now = best
        self.robustness = best.value
        if best.value >= self.enough:
            return True
        if self.limits.left < optimize.MIN_BATCH * len(self.environments):
            self.stopped = self.limits.stopped_by
            return False
        self.stopped = "no parameters"
        if not self.loop.bounded:
            self.notes.append(
                "gradients found no further improvement; nothing else is tried for arrays"
            )
        return False

    @property
    def size(self) -> float:
        """Size of an ordinary number in the arrays."""
        return float(np.sqrt(np.mean(self.start**2))) or 1.0

    def merit(self, theta: np.ndarray, value: float) -> tuple[float, ...]:
        """Return the merit of a repair: first enough robustness, then the nearer the better."""
        far = float(np.linalg.norm(theta - self.start))
        return (1.0, -far) if value >= self.enough else (0.0, value)

    def propose(
        self, theta: np.ndarray, rho: np.ndarray, gradients: np.ndarray, radius: float
    ) -> list[np.ndarray]:
        loop = self.loop
        step = smallest_change(
            theta, self.start, rho, gradients, self.aim, free=loop.free, bounded=loop.bounded
        )
        steps = [] if step is None else [step * share for share in (1.0, 0.5, 0.2, 0.05)]
        if np.min(rho, initial=np.inf) < self.enough:
            if loop.dim <= 64:
                steps.append(
                    max_min_step(
                        theta, rho, gradients, radius, free=loop.free, bounded=loop.bounded
                    )
                )
            else:
                worst = gradients[int(np.argmin(rho))]
                size = np.linalg.norm(worst)
                if size > 0:
                    steps.append(radius * np.sqrt(loop.dim) * worst / size)
        moved = [theta + step for step in steps]
        return [np.clip(m, 0.0, 1.0) for m in moved] if loop.bounded else moved

    def without_gradients(self, archive: optimize.Archive) -> optimize.Choice:
        """Search by cross-entropy, over the whole space where nothing is known, then nearer."""
        limits = self.limits.slice(max(self.limits.maximum // 8, self.limits.left // 8))
        if archive.best(1, self.merit)[0].value < self.enough:
            optimize.explore(
                self.loop, self.environments, archive, limits.slice(limits.left // 2),
                merit=self.merit, batch=CANDIDATES, rng=self.rng,
            )  # fmt: skip
        best = archive.best(6, self.merit)
        optimize.cross_entropy(
            self.loop, [c.theta for c in best], self.environments, archive,
            limits.slice(limits.left // 2),
            merit=self.merit, batch=CANDIDATES, rng=self.rng, rounds=40,
        )  # fmt: skip
        best = archive.best(1, self.merit)[0]
        if best.value >= self.enough:
            self.move_to_nominal(best.theta, archive, limits)
        return archive.best(1, self.merit)[0]

    def move_to_nominal(
        self, theta: Float[np.ndarray, " p"], archive: optimize.Archive, limits: Budget
    ) -> None:
        """Move towards the nominal parameters: each coordinate alone first, then all together."""
        blocks = [np.arange(self.loop.dim) == i for i in range(self.loop.dim)]
        for block in [*blocks, np.ones(self.loop.dim, bool)]:
            block = block & self.loop.free if block.sum() > 1 else block
            low, high = 0.0, 1.0  # Shares of the way that are kept: `high` is known to be enough.
            for _ in range(3):
                shares = low + (high - low) * np.arange(8) / 8
                fractions = [np.where(block, self.start + s * (theta - self.start), theta)
                        for s in shares]  # fmt: skip
                if limits.left < len(fractions) * len(self.environments) or high - low < 1e-3:
                    return
                values = optimize.evaluate(self.loop, fractions, self.environments, archive)
                good = values >= self.enough
                # Nearest above which all are good, so that it is not an island.
                upper = len(good) - int(np.argmin(np.append(good[::-1], False)))
                if upper == 0:
                    high = 0.0
                    break
                low, high = shares[upper - 1], shares[upper] if upper < len(shares) else high
            theta = np.where(block, self.start + high * (theta - self.start), theta)
