"""Failure modes and effects of faults: each alone, and in pairs where neither fails alone.

print(fmea(problem, [vj.faults.Dropout("gyro", onset=vj.Box(0, 3), duration=vj.Box(0, 1))]))

All faults are features of one problem, so that one program simulates every row; all but the
faults of a row are off.
"""

import itertools
import shutil
import time
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from verifai_jax.core.checks import check_count, check_fraction, is_number
from verifai_jax.core.errors import check_names, suggests_options
from verifai_jax.core.progress import shows_progress
from verifai_jax.counterexamples import confirm
from verifai_jax.counterexamples.nominal import Nominal
from verifai_jax.estimation import estimate
from verifai_jax.evaluation.backends import resolved
from verifai_jax.evaluation.evaluator import Evaluator
from verifai_jax.failure_table.effects import Found, effect_of
from verifai_jax.failure_table.result import FailureTable
from verifai_jax.falsification import falsify, load, simulate
from verifai_jax.falsification.run import Run
from verifai_jax.faults.fault import AtMost, Fault, FaultFeatures
from verifai_jax.problem.dependence import depends_on_key
from verifai_jax.problem.problem import Problem
from verifai_jax.statistics.binomial import clopper_pearson
from verifai_jax.store.cache import Cache, locked_cache

if TYPE_CHECKING:
    from verifai_jax.core.executors import Executor

LEVELS = 33
"""Severities of one line at once; two lines, one within the other, tell a thousandth apart."""
FOLLOWED = 6
"""Failing samples of a fault whose severity is lowered."""
FEW = 10
"""Failing samples below which importance sampling or splitting estimates the probability."""
AGAIN = 64
"""Failing points that are simulated again with other random keys, where chance decides."""
Points = Float[np.ndarray, "n d"]


@suggests_options
@shows_progress("tabling the faults of")
def fmea(
    problem: Problem,
    faults: Sequence[Fault] = (),
    *,
    rate: float | Mapping[str, float] | None = None,
    mission_time: float | None = None,
    samples: int = 512,
    budget: int = 2000,
    pairs: bool = True,
    confidence: float = 0.95,
    seed: int = 0,
    folder: str | Path | None = None,
    executor: "Executor | None" = None,
    target: str | None = None,
    progress: bool | None = None,
) -> FailureTable:
    """Make the failure table of a system: what each fault does, and how probable that is.

    **Arguments:**

    - `problem`: a problem, whose own features stay nominal.
    - `faults`: of `vj.faults`, in addition to those that the problem has. Each has to have a number
      at which it is off, such as `duration=vj.Box(0, 2)`.
    - `rate`: occurrences in an hour, of each fault or by its name; `mission_time` in hours. A fault
      then happens with probability `1 - exp(-rate * mission_time)`, one independent of the other.
      Without them probabilities are those given that it happens.
    - `samples`: of each fault, and of each pair, from the prior of its numbers.
    - `budget`: of the search for a failure where no sample fails, and of the estimate where few do;
      0 for neither.
    - `pairs`: whether pairs are tried of those faults that never fail alone.
    - `confidence`: of each interval.
    - `seed`: of all chance.
    - `folder`: that keeps the counterexamples as a run, and what is simulated: a table that was cut
      off goes on there.
    - `executor`: whose workers simulate, as in `falsify`.
    - `target`: `FILE.py:NAME` of the problem with its faults, for the commands that replay.
    - `progress`: whether to show one line of progress; see `core.progress` for the default.

    **Returns:** the table, the most probable failure first.

    **Raises:** `ValueError` for no fault, one that cannot be off, rates out of range or without a
    mission time; as `Problem.with_faults`.
    """
    started = time.perf_counter()
    faulty = problem.with_faults(*faults) if faults else problem
    known = _faults_of(faulty)
    rates = _rates(rate, mission_time, known)
    check_fraction("confidence", confidence)
    check_count("samples", samples)
    for name, count in (("budget", budget), ("seed", seed)):
        check_count(name, count, 0)
    faulty = resolved(faulty, batch=samples, budget=samples * len(known)).problem
    faulty.check()
    options = {"samples": samples, "budget": budget, "seed": seed}
    features = {name: repr(domain) for name, domain in faulty.space.domains.items()}
    formulas = {name: str(formula) for name, formula in faulty.formulas.items()}
    with locked_cache(folder, "fmea") as cache:
        work = {"problem": faulty.name, "features": features, "formulas": formulas, **options}
        cache.claim(work, faulty.sources())
        rows = _Rows(faulty, known, cache, seed, executor)
        healthy = not rows("healthy", rows.nominal.u[None]).violated[0]
        found = [_try(rows, (name,), samples, budget) for name in known]
        if pairs:
            safe = [each.faults[0] for each in found if not len(each.candidates)]
            both = [_try(rows, pair, samples, 0) for pair in itertools.combinations(safe, 2)]
            found += [each for each in both if len(each.candidates)]
        run = _run_of(rows, found, folder, target)
        verdicts = {} if run is None else confirm(run, progress=False).table["verdict"].to_dict()
        graded = {name: number for name, (number, _) in rows.severities.items()}
        effects = []
        for each in found:
            low, high, probability = _probability(rows, each, confidence, budget)
            chance = 1.0
            for name in each.faults:
                chance *= 1.0 if rates is None else float(-np.expm1(-rates[name] * mission_time))
            effect = effect_of(run, each, known, graded, verdicts)
            effects.append(
                replace(
                    effect, occurrence=chance, probability=chance * probability,
                    low=chance * low, high=chance * high,
                )
            )  # fmt: skip
    effects.sort(key=lambda effect: (-effect.fails, -effect.probability, effect.faults))
    seconds = time.perf_counter() - started
    return FailureTable(
        faulty.name, tuple(effects), run, rates, mission_time, confidence, bool(healthy), seconds
    )


@dataclass(frozen=True)
class _Verdicts:
    violated: Bool[np.ndarray, " n"]
    proper: Bool[np.ndarray, " n"]


class _Rows:
    """Simulations of one problem with all faults, remembered by their points."""

    def __init__(
        self,
        problem: Problem,
        faults: Mapping[str, Fault],
        cache: Cache,
        seed: int,
        executor: "Executor | None",
    ) -> None:
        self.problem, self.faults, self.cache = problem, faults, cache
        self.rng, self.seed, self.executor = np.random.default_rng(seed), seed, executor
        self.nominal = Nominal.of(problem)
        self.groups: dict[str, Int[np.ndarray, " k"]] = dict(self.nominal.groups)
        self.draws = depends_on_key(problem)
        self._evaluate = Evaluator(problem, 512, seed=seed, executor=executor)
        self._count = 0

    @property
    def severities(self) -> dict[str, tuple[str, int]]:
        """For each fault the number that grades it, and its coordinate."""
        graded = {}
        for name, fault in self.faults.items():
            wanted = (fault.severity, "duration", "onset")
            number = next(n for n in wanted if n in fault.domains)
            graded[name] = number, int(self.groups[name][list(fault.domains).index(number)])
        return graded

    def sample(self, names: Sequence[str], count: int) -> Points:
        """Return points with these faults, drawn from their priors."""
        points = np.repeat(self.nominal.u[None], count, axis=0)
        for name in names:
            points[:, self.groups[name]] = self.rng.random((count, len(self.groups[name])))
        return points

    def __call__(self, what: str, points: Points) -> _Verdicts:
        """Simulate points; what was simulated before is remembered."""
        points = self.nominal.settle(points)
        first, self._count = self._count, self._count + len(points)

        def compute() -> dict[str, np.ndarray]:
            verdicts = self._evaluate(points, first=first)
            return {
                "violated": np.asarray(verdicts.violated),
                "proper": np.asarray(verdicts.proper),
            }

        arrays = self.cache.remember(f"rows/{what}/{zlib.crc32(points.tobytes())}", compute)
        return _Verdicts(arrays["violated"], arrays["proper"])


def _try(rows: _Rows, names: tuple[str, ...], samples: int, budget: int) -> Found:
    """Sample a fault or a pair, search where nothing fails, and lower what fails to its least."""
    label = "+".join(names)
    points = rows.sample(names, samples)
    verdicts = rows(f"samples of {label}", points)
    failing = points[verdicts.violated]
    if not len(failing) and budget:
        failing = _searched(rows, names, budget)
    if len(failing):
        lowered = _lowered(rows, names, failing)
        # Under other random keys they may not fail, so that some have to be tried.
        again = np.resize(failing, (AGAIN, failing.shape[1]))
        failing = np.concatenate([lowered, again]) if rows.draws else lowered
    failures, without = int(verdicts.violated.sum()), int((~verdicts.proper).sum())
    return Found(names, failing, failures, without, samples)


def _searched(rows: _Rows, names: tuple[str, ...], budget: int) -> Points:
    """Return failing points that a search finds where no sample fails."""

    def compute() -> dict[str, np.ndarray]:
        view = rows.problem.only(*names)
        run = falsify(
            view, "cross_entropy", budget, seed=rows.seed, confirm=False, progress=False,
            executor=rows.executor,
        )  # fmt: skip
        worst = run.table.counterexamples.sort_values("rho").head(FOLLOWED)
        whole = rows.problem.space
        return {"points": whole.points(worst) if len(worst) else np.zeros((0, whole.dim))}

    points = rows.cache.remember(f"search/{'+'.join(names)}", compute)["points"]
    return np.asarray(points, np.float32)


def _lowered(rows: _Rows, names: tuple[str, ...], failing: Points) -> Points:
    """Return failing points with their severity as low as it still fails, the least first."""
    home, label = rows.nominal.u, "+".join(names)
    graded = [rows.severities[name] for name in names]
    index = np.array([i for _, i in graded])
    away = np.abs(failing[:, index] - home[index]).sum(axis=1)
    starts = failing[np.argsort(away)[:FOLLOWED]]
    # With the longest duration they may fail at less.
    longest = starts.copy()
    for name in names:
        domains = list(rows.faults[name].domains)
        if "duration" in domains and rows.severities[name][0] != "duration":
            longest[:, rows.groups[name][domains.index("duration")]] = 1.0
    starts = np.unique(np.concatenate([starts, longest]), axis=0)
    low, high = np.zeros(len(starts)), np.ones(len(starts))
    fails = np.zeros(len(starts), bool)
    for turn in range(2):
        shares = low[:, None] + (high - low)[:, None] * np.linspace(0, 1, LEVELS)
        points = np.repeat(starts[:, None], LEVELS, axis=1)
        points[:, :, index] = home[index] + shares[:, :, None] * (
            starts[:, None, index] - home[index]
        )
        verdicts = rows(f"severity of {label}, {turn}", points.reshape(-1, len(home)))
        violated = verdicts.violated.reshape(len(starts), LEVELS)
        fails = violated.any(axis=1) & (violated[:, 1:].any(axis=1) | (turn > 0))
        first = np.argmax(violated, axis=1)
        each = np.arange(len(starts))
        high = np.where(fails, shares[each, first], high)
        low = np.where(fails, shares[each, np.maximum(first - 1, 0)], low)
    starts = starts.copy()
    starts[:, index] = home[index] + high[:, None] * (starts[:, index] - home[index])
    starts = starts[fails] if fails.any() else failing[:1]
    return starts[np.argsort(np.abs(starts[:, index] - home[index]).sum(axis=1), kind="stable")]


def _run_of(
    rows: _Rows, found: list[Found], folder: str | Path | None, target: str | None
) -> Run | None:
    """Simulate the candidates of all faults as one run, and number them in `found`."""
    first = 0
    for i, each in enumerate(found):
        found[i] = each._replace(first=first)
        first += len(each.candidates)
    points = [each.candidates for each in found if len(each.candidates)]
    if not points:
        return None
    space = rows.problem.space
    features = space.features_at(np.asarray(rows.nominal.settle(np.concatenate(points))))
    import pandas as pd

    frame = pd.DataFrame(space.rows(features))
    if folder is None:
        return simulate(rows.problem, frame, seed=rows.seed, progress=False)
    path = Path(folder) / "counterexamples"
    if rows.cache.note("counterexamples") is None:
        # A run that was cut off is made again: it takes seconds.
        shutil.rmtree(path, ignore_errors=True)
        simulate(rows.problem, frame, seed=rows.seed, folder=path, target=target, progress=False)
        rows.cache.note("counterexamples", len(frame))
    return load(path, rows.problem)


def _probability(
    rows: _Rows, found: Found, confidence: float, budget: int
) -> tuple[float, float, float]:
    """Return the interval and the probability of a failure, given that the faults happen."""
    rate = clopper_pearson(found.failures, found.simulations, confidence, found.without)
    if not len(found.candidates) or found.failures >= FEW or not budget or len(found.faults) > 1:
        return rate.low, rate.high, rate.estimate

    def compute() -> dict[str, np.ndarray]:
        view = rows.problem.only(*found.faults)
        seen = estimate(
            view, budget=10 * budget, confidence=confidence, seed=rows.seed, progress=False,
            executor=rows.executor,
        )  # fmt: skip
        chance = rate.estimate if seen.probability is None else seen.probability
        return {"interval": np.array([seen.low, seen.high, chance])}

    low, high, chance = rows.cache.remember(f"estimate/{'+'.join(found.faults)}", compute)[
        "interval"
    ]
    return float(low), float(high), float(chance)


def _faults_of(problem: Problem) -> dict[str, Fault]:
    """Return the faults of a problem by name.

    **Raises:** `ValueError` for none, and for one that cannot be off.
    """
    known: dict[str, Fault] = {}
    for name, domain in problem.space.domains.items():
        if not isinstance(domain, FaultFeatures):
            continue
        if domain.fault is None:
            raise ValueError(f"fmea takes faults one by one; {name!r} is {AtMost.__name__}")
        fault = domain.fault
        weakest = {number: fault.weakest(number) for number in fault.domains}
        off = weakest.get("duration") == 0 or weakest.get(fault.severity) == fault.off
        if not off:
            raise ValueError(
                f"fault {name!r} cannot be off, at its weakest "
                f"({', '.join(f'{n} {v:zg}' for n, v in weakest.items())}) neither: let it be "
                "short, with duration=vj.Box(0, ...)"
            )
        known[name] = fault
    if not known:
        raise ValueError(
            f"problem {problem.name!r} has no faults that vary: give fmea(problem, faults), each "
            "with a domain such as duration=vj.Box(0, 1)"
        )
    return known


def _rates(
    rate: float | Mapping[str, float] | None, mission_time: float | None, known: Mapping[str, Fault]
) -> Mapping[str, float] | None:
    if (rate is None) != (mission_time is None):
        raise ValueError(
            f"rate (in an hour) and mission_time (in hours) go together; got ({rate=}, "
            f"{mission_time=})"
        )
    if rate is None:
        return None
    rates = dict(rate) if isinstance(rate, Mapping) else dict.fromkeys(known, rate)
    check_names("fault", rates, known)
    for name in known:
        if not is_number(rates.get(name)) or not 0 <= rates[name] < np.inf:
            raise ValueError(
                f"rate of fault {name!r} must be a number of occurrences in an hour, 0 or more; "
                f"got {rates.get(name)!r}"
            )
    if not is_number(mission_time) or not 0 <= mission_time < np.inf:
        raise ValueError(f"mission_time must be a number of hours; got {mission_time!r}")
    return rates
