"""Model-parameter synthesis: values of features for which the formula holds robustly.

    synthesize(problem, ["gain", "damping"])             # for all values of the other features
    synthesize(problem)                                   # all features are parameters

Without an environment the robustness is maximised: by a search over the whole space, then along
gradients. With one it is the least robustness over a set of environments that grows
(counterexample-guided inductive synthesis: Solar-Lezama, Program synthesis by sketching, 2008,
chapter 5; for robust optimisation Blankenship and Falk, Infinitely constrained optimization
problems, 1976, algorithm 2.1): choose parameters for the set, attack them, add the environments in
which they do worse than in all of the set, and repeat. The result is checked on fresh samples.
"""

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float

from verifai_jax.addons.synthesis import arguments, optimize
from verifai_jax.addons.synthesis.adversary import attack
from verifai_jax.addons.synthesis.aim import Aim, as_aim
from verifai_jax.addons.synthesis.budget import Budget, split_budget
from verifai_jax.addons.synthesis.failure_counts import FailureCounts
from verifai_jax.addons.synthesis.held_out import HeldOut, draw, held_out
from verifai_jax.addons.synthesis.linear_steps import max_min_step
from verifai_jax.addons.synthesis.parametric import FeatureParameters, Parametric, rows_of
from verifai_jax.addons.synthesis.region import Region, region_of
from verifai_jax.addons.synthesis.results import Synthesis
from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.messages.checks import check_count, check_options, check_positive, options_of
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.evaluation.run_on import RunOn
from verifai_jax.falsification.validation import usual_batch
from verifai_jax.problem.dependence import depends_on_key
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Search
from verifai_jax.statistics.stopping import Stop

if TYPE_CHECKING:
    import pandas as pd
CANDIDATES = 32
"""Choices of parameters at a time, and at most in the table at the end."""
STARTS = 4
"""Choices from which gradients are followed."""
ADDED = 6
"""Environments that a round adds to the set at most."""
EXPLORED = 20_000
"""Simulations of the first look at the parameters at most, where there is no environment."""


@suggests_options
@shows_progress("synthesizing parameters of")
def synthesize(
    problem: Problem,
    parameters: Sequence[str] | str | None = None,
    budget: int = 10_000,
    *,
    aim: Aim | Literal["robustness", "probability"] = "robustness",
    environments: int = 16,
    prove: float | None = None,
    gradient: bool | None = None,
    batch: int = 256,
    seed: int = 0,
    stop: Stop | None = None,
    precision: str = "float32",
    run_on: RunOn | None = None,
    progress: bool | None = None,
) -> Synthesis:
    """Find values of some features for which the formula holds robustly for all others.

    **Arguments:**
    - `problem`: the system, its features and formulas.
    - `parameters`: names of the features to choose; all when left out. The others are the
      environment, which varies.
    - `budget`: maximum number of simulations, without those of the final check.
    - `aim`: what the parameters are chosen for, and how that is checked: `"robustness"`,
      `"probability"`, or an `Aim` with its options.
    - `environments`: number of environments in the initial set.
    - `prove`: approximate seconds to prove a box of parameters around the best ones, with the
      method of `verify`: for all parameters in it, and all environments of that part of the prior,
      the formula holds. No proof when left out.
    - `gradient`: whether to follow gradients; by default if the present backend has them.
    - `stop`: the seconds of the work, a fifth of which is reserved for the check.
    - `run_on`: the backend of the simulations.
    - all other arguments: as in `falsify`.
    **Returns:** a `Synthesis`; after Ctrl-C the finished part, without the check.
    **Raises:** `ValueError` before anything compiles for unknown features and options out of range.
    """
    started = time.perf_counter()
    check_options(budget, batch, seed)
    max_seconds = options_of("synthesize", Stop, stop, "seconds").seconds
    backend = options_of("synthesize", RunOn, run_on, "backend").backend
    check_count("environments", environments)
    aim = as_aim(aim)
    margin = aim.margin
    if prove is not None:
        check_positive("prove", prove)
    loop = arguments.feature_parameters(
        problem, parameters, gradient, batch, budget, precision, backend, seed
    )
    search = arguments.attack_search(problem, aim.attack, loop)
    enclosed = None
    if prove is not None:
        from verifai_jax.addons.verification.enclosure import enclosable

        enclosed = enclosable(loop.problem, precision)
    sources = problem.sources()
    limits, checking = split_budget(lambda: loop.simulations, budget, started, max_seconds)
    region = region_of(loop, aim.mass)
    if aim.of == "probability":
        region = region_of(loop, 1.0)  # Samples are of the whole prior.
    work = _Synthesis(loop, search, limits, margin, environments, seed, region)
    if aim.of == "probability":
        work.counts = FailureCounts(loop, margin, limits, seed)
    try:
        work.run()
        stopped = work.stopped
    except KeyboardInterrupt:
        stopped = "interrupted"
    if stopped != "interrupted":
        try:
            work.conclude()
        except KeyboardInterrupt:
            stopped = "interrupted"
    best, robustness = work.best, work.robustness
    searched = loop.simulations
    checked = None
    if (
        stopped != "interrupted"
        and aim.held_out
        and (loop.environment is not None or depends_on_key(problem))
    ):
        checked = _check(loop, best.theta, aim.held_out, margin, seed, checking)
    if checked is not None and checked.lowest is not None:
        robustness = min(robustness, checked.lowest)
    proved = None
    if enclosed is not None and prove is not None and stopped != "interrupted":
        from verifai_jax.addons.synthesis.proved_parameters import prove_around

        point, chosen = np.full(enclosed.space.dim, 0.5), np.zeros(enclosed.space.dim, bool)
        point[loop.mine], chosen[loop.mine] = best.theta, True
        low, high = np.zeros(len(point)), np.ones(len(point))
        if region is not None:
            low[loop.theirs], high[loop.theirs] = region.ends
        proved = prove_around(enclosed, point, chosen, low, high, prove, precision, seed)
    return Synthesis(
        problem=problem,
        parameters=loop.values(best.theta),
        robustness=robustness,
        margin=margin,
        candidates=work.table(),
        environments=work.environment_table(),
        held_out=checked,
        attacks=work.attacks.get(best.theta.tobytes(), 0) + len(work.environments),
        converged=work.stopped == "converged",
        simulations=searched,
        without_verdict=loop.without_verdict,
        seconds=time.perf_counter() - started,
        stopped=stopped,
        seed=seed,
        varied="" if region is None else region.describe(),
        counted=None if work.counts is None else (work.counts.failing, work.counts.samples),
        sources=sources.to_json(),
        proved=proved,
        proof_seconds=prove,
    )


def _check(
    loop: Parametric, theta: Float[np.ndarray, " p"], count: int, margin: float, seed: int,
    limits: Budget,
) -> HeldOut | None:  # fmt: skip
    try:
        return held_out(loop, theta, count, margin, (seed, 1), limits)
    except KeyboardInterrupt:
        return None


class _Synthesis:
    """State of a synthesis, from which a result can be made at any time."""

    def __init__(
        self, loop: FeatureParameters, search: Search, limits: Budget, margin: float,
        environments: int, seed: int, region: Region | None,
    ) -> None:  # fmt: skip
        self.region = region
        self.loop, self.search, self.limits, self.seed = loop, search, limits, seed
        self.margin = margin
        # One shape for all attacks: a twentieth of what one may cost.
        self.batch = min(128, usual_batch(search, max(256, limits.maximum // 4)))
        self.archive = optimize.Archive()
        self.rng = np.random.default_rng((seed, 2))
        self.scale = 1.0
        self.stopped = "budget"
        self.attacked: list[optimize.Choice] = []
        self.attacks: dict[bytes, int] = {}
        self.counts: FailureCounts | None = None
        self.final: list[optimize.Choice] = []
        self.rho: Any = None  # Of the best, in each environment of the set.
        self.environments: Any = np.zeros((1, 0), np.float32)
        if loop.environment is not None:
            environments = max(1, min(environments, limits.left // 4))
            self.environments = draw(loop, np.full(loop.dim, 0.5), environments, (seed, 3))
            if not len(self.environments):
                # The constraint wants other parameters: it is asked with each of them.
                rng = np.random.default_rng((seed, 3))
                self.environments = rng.random((environments, loop.environment.dim), np.float32)
            assert region is not None
            self.environments = region.project(self.environments)

    def run(self) -> None:
        if self.counts is not None:
            self.counts.run()
            self.stopped = self.limits.stopped_by
            return
        whole = self.limits
        if self.loop.environment is not None:
            # A tenth is kept for comparing the candidates over the whole set at last.
            self.limits = whole.slice(int(0.9 * whole.left))
        try:
            self.rounds()
        finally:
            self.limits = whole

    def rounds(self) -> None:
        """Choose parameters and attack them in turn."""
        total = self.limits.left
        alone = self.loop.environment is None
        maximum = EXPLORED if alone else 1000 * len(self.environments)
        first = self.limits.slice(min(maximum, int((0.5 if alone else 0.15) * total)))
        optimize.explore(
            self.loop, self.environments, self.archive, first,
            merit=optimize.value_merit, batch=CANDIDATES, rng=self.rng,
        )  # fmt: skip
        if not self.archive.choices:
            # Not even one choice fits into the share: at least one is evaluated.
            optimize.evaluate(
                self.loop, np.full((1, self.loop.dim), 0.5), self.environments, self.archive
            )
        self.scale = optimize.typical_size([choice.value for choice in self.archive.choices])
        if self.loop.environment is None:
            self.improve(self.limits, 2 * STARTS)
            self.stopped = self.limits.stopped_by if self.limits.exhausted else "converged"
            return
        number = 0
        while not self.limits.exhausted:
            number += 1
            # A quarter of what is left: later sets deserve as much as the first.
            self.improve(self.limits.slice(self.limits.left // 4), STARTS if number == 1 else 1)
            choice = self.best_in_archive()
            if not np.isfinite(choice.value):
                break
            level = choice.value - 1e-3 * self.scale
            share = max(self.limits.left // 4, min(self.limits.left, 256))
            share = min(share, arguments.ATTACK)
            assert self.region is not None
            result = attack(
                self.loop, choice.theta, level, self.limits.slice(share), search=self.search,
                batch=self.batch, seed=self.seed + 7919 * number,
                region=self.region, scale=self.scale,
            )  # fmt: skip
            worst = min(choice.value, result.worst)
            name = choice.theta.tobytes()
            self.attacks[name] = self.attacks.get(name, 0) + len(result.rho)
            self.attacked.append(choice._replace(value=worst))
            if not result.violating.any():
                # What a handful of simulations does not find says nothing.
                thorough = len(result.rho) >= min(
                    arguments.ATTACK // 2, max(32, self.limits.maximum // 20)
                )
                self.stopped = "converged" if thorough else self.limits.stopped_by
                return
            self.extend(result.select(ADDED))
        self.stopped = self.limits.stopped_by if self.limits.exhausted else "no verdict"

    def improve(self, limits: Budget, starts: int) -> None:
        best = self.archive.best(starts, optimize.value_merit, apart=1e-3)
        if optimize.has_gradients(self.loop):
            part = limits if self.loop.differentiable else limits.slice(limits.left // 2)
            optimize.climb(
                self.loop, [c.theta for c in best], self.environments, self.archive, part,
                propose=self.propose, merit=optimize.value_merit, scale=self.scale, radius=0.1,
            )  # fmt: skip
        if not self.loop.free.all() or not self.loop.differentiable:
            best = self.archive.best(2, optimize.value_merit) + self.archive.best(
                6, optimize.value_merit, apart=0.05
            )
            optimize.cross_entropy(
                self.loop, [c.theta for c in best], self.environments, self.archive, limits,
                merit=optimize.value_merit, batch=CANDIDATES, rng=self.rng, rounds=1000
                if self.loop.environment is None else 12,
            )  # fmt: skip

    def propose(
        self, theta: np.ndarray, rho: np.ndarray, gradients: np.ndarray, radius: float
    ) -> list[np.ndarray]:
        def step(radius: float) -> np.ndarray:
            moved = theta + max_min_step(
                theta, rho, gradients, radius, free=self.loop.free, bounded=True
            )
            return np.clip(moved, 0.0, 1.0)

        return [step(radius), step(radius / 3), step(radius / 10)]

    def extend(self, points: Float[np.ndarray, "n d"]) -> None:
        """Add environments `[n, d]` to the set, and evaluate the best choices over the new one."""
        self.environments = np.concatenate([self.environments, points]).astype(np.float32)
        best = self.archive.best(4, optimize.value_merit, apart=1e-3)
        best += self.archive.best(12, optimize.value_merit, apart=0.1)
        affordable = min(len(best), self.limits.left // len(self.environments))
        again, self.archive = best[:affordable], optimize.Archive()
        if again:
            optimize.evaluate(self.loop, [c.theta for c in again], self.environments, self.archive)
            return
        # Old values bound the new ones from above; the attacked ones are known best.
        self.archive.choices = best

    def best_in_archive(self) -> optimize.Choice:
        return self.archive.best(1, optimize.value_merit)[0]

    @property
    def best(self) -> optimize.Choice:
        """The choice of parameters with the greatest least robustness in all attacks."""
        if (counts := self.counts) is not None:
            return optimize.Choice(counts.theta, counts.value, len(counts.environments))
        if self.attacked:
            known: dict[bytes, optimize.Choice] = {}
            for choice in self.attacked:
                name = choice.theta.tobytes()
                if name not in known or choice.value < known[name].value:
                    known[name] = choice
            return max(known.values(), key=lambda choice: choice.value)
        if self.archive.choices:
            return self.best_in_archive()
        return optimize.Choice(np.full(self.loop.dim, 0.5), -np.inf, 0)

    @property
    def robustness(self) -> float:
        """Least robustness of the best choice."""
        return self.best.value

    def conclude(self) -> None:
        """Evaluate the attacked and the best other choices over the whole set."""
        if (counts := self.counts) is not None:
            self.environments, self.rho, self.final = counts.environments, counts.rho, counts.final
            return
        if self.loop.environment is None:
            return
        pool = optimize.Archive()
        pool.choices = [
            *self.attacked,
            *self.archive.best(CANDIDATES, optimize.value_merit, apart=1e-3),
        ]
        thetas: dict[bytes, Any] = {}
        for choice in pool.best(len(pool.choices), optimize.value_merit):
            thetas.setdefault(choice.theta.tobytes(), choice)
        affordable = max(0, self.limits.maximum - self.loop.simulations) // len(self.environments)
        chosen = list(thetas.values())[: min(CANDIDATES, affordable)]
        if not chosen:
            return
        pairs = self.loop.evaluate(np.stack([c.theta for c in chosen]), self.environments)
        values = optimize.worst_case(pairs)
        self.final = [
            optimize.Choice(c.theta, float(v), len(self.environments))
            for c, v in zip(chosen, values, strict=True)
        ]
        values_by_name = {c.theta.tobytes(): c.value for c in self.final}
        self.attacked = [
            c._replace(value=min(c.value, values_by_name.get(c.theta.tobytes(), c.value)))
            for c in self.attacked
        ]
        names = [c.theta.tobytes() for c in self.final]
        if (name := self.best.theta.tobytes()) in names:
            self.rho = pairs.rho[names.index(name)]

    def table(self) -> "pd.DataFrame":
        """Return the candidates, best first."""
        if self.loop.environment is None:
            pool = self.archive.best(len(self.archive.choices), optimize.value_merit)
            chosen = [c for i, c in enumerate(pool) if c.value >= self.margin or i < CANDIDATES]
        else:
            chosen = sorted(self.final or [self.best], key=lambda c: c.value, reverse=True)
        thetas = np.array([c.theta for c in chosen]).reshape(len(chosen), self.loop.dim)
        frame = rows_of(self.loop.space, thetas)
        return frame.assign(
            rho=[c.value for c in chosen], environments=[c.environments for c in chosen]
        )

    def environment_table(self) -> "pd.DataFrame":
        """Return the set, with the robustness of the best parameters where it is known."""
        rho = self.rho if self.rho is not None else np.full(len(self.environments), np.nan)
        return rows_of(self.loop.environment, self.environments).assign(rho=rho)
