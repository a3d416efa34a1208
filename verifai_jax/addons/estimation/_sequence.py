"""The failure probability of a sequence of scenarios from those of its parts.

    whole = sequence([approach, overtake], {"gap0": "gap", "v0": "v"})
    print(whole); whole.counterexamples

A part begins where the previous part ended. The sequence succeeds if all parts do, so its
probability of success is the product of the parts' conditional probabilities.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int

from verifai_jax.addons.estimation.sequence_result import PartEstimate, SequenceEstimate
from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.messages.checks import check_count, check_fraction
from verifai_jax.core.messages.errors import check_names, suggests_options
from verifai_jax.core.values.trace import Trace
from verifai_jax.evaluation.evaluator import Evaluator
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.falsification.run import Run
from verifai_jax.problem.problem import Problem, ProblemError
from verifai_jax.statistics.binomial import exact_interval

Handover = Mapping[str, str]
"""Features of a part, with the signals, or features, of the part before that they come from."""
TRIES = 32
"""Maximum draws of a part's own features until its constraint accepts them with a start."""
CONFIRMED = 16
"""Failures of weighted rows that are simulated from where the part before has ended."""
FAR = 0.1
"""Distance, as a share of a range, beyond which the nearest row of a run is not used."""


@suggests_options
@shows_progress("simulating the parts of the sequence")
def sequence(
    parts: Sequence[Problem | Run],
    handover: Handover | Sequence[Handover],
    *,
    samples: int = 10_000,
    confidence: float = 0.95,
    seed: int = 0,
    batch: int = 512,
    precision: str = "float32",
    progress: bool | None = None,
) -> SequenceEstimate:
    """Estimate the failure probability of a sequence of scenarios, part by part.

    Samples of the first part come from its prior. Each sample that does not fail starts one sample
    of the next part: features named in `handover` take their values from it, and all others are
    drawn from their own prior. So the samples of a part are independent. Each part has the exact
    interval of Clopper and Pearson, and the product of the intervals covers the whole sequence
    (Bonferroni).

    The verdicts of a `Run` are reused. Rows of the first part are already samples of it. Rows of
    the last part have other initial values, so each sample that reaches it takes the verdict of the
    row with the nearest initial values. The interval is then approximate, and a note says so. Rows
    of the first part are simulated again to obtain their final states, which are not stored; parts
    in between are always simulated.

    **Arguments:**
    - `parts`: problems, or runs with `search="uniform"`, in their order.
    - `handover`: a dictionary from a feature of a part to the signal of the previous part whose
      last value it takes (`"x"`, or `"position[1]"`), or to the feature of that part whose value it
      keeps. Give one dictionary for all transitions, or one for each.
    - `samples`: samples of the first part.
    - `confidence`: the confidence of all intervals together.
    - all other arguments: as in `falsify`.
    **Returns:** a `SequenceEstimate`.
    **Raises:** before anything is simulated, `ValueError` for fewer than two parts, for a run whose
    rows are not samples of the prior and for numbers out of range; `UnknownNameError` for features
    and signals that do not exist.
    """
    check_count("samples", samples)
    check_count("batch", batch)
    check_count("seed", seed, 0)
    check_fraction("confidence", confidence)
    stages = _stages(parts, handover, batch, precision, seed)
    each = 1 - (1 - confidence) / len(stages)
    estimates, failed, notes = list[PartEstimate](), list[dict[str, Any]](), list[str]()
    arrivals: _Arrivals | None = None
    for stage in stages:
        if arrivals is not None and not len(arrivals.paths):
            notes.append(f"no sample reaches {stage.name}: its probability is not known")
            break
        reuse = stage.run is not None and stage is stages[-1]
        if reuse and arrivals is not None:
            estimate, counterexamples, said = stage.weighted(arrivals, each)
            notes += said
        else:
            estimate, counterexamples, arrivals = stage.simulated(arrivals, samples, each)
        estimates.append(estimate)
        failed += counterexamples
    lost = len(estimates) < len(stages)
    return SequenceEstimate(
        parts=tuple(estimates),
        low=1 - float(np.prod([1 - part.low for part in estimates])),
        high=1.0 if lost else 1 - float(np.prod([1 - part.high for part in estimates])),
        confidence=confidence,
        counterexamples=pd.DataFrame(failed),
        simulations=sum(stage.evaluate.simulations for stage in stages),
        seed=seed,
        notes=tuple(notes),
    )


@dataclass(frozen=True)
class _Arrivals:
    """Samples that a part has not failed in.

    - `ends`: what the next part begins with, `[n, ...]` by the name of its feature.
    - `paths`: the features of each of them in all parts so far, as columns.
    """

    ends: dict[str, np.ndarray]
    paths: list[dict[str, Any]]


class _Stage:
    """A part, its number, and the values that the next part takes from its end."""

    def __init__(
        self, part: Problem | Run, number: int, begins: Handover, hands: Handover,
        options: Mapping[str, Any],
    ) -> None:  # fmt: skip
        self.run = part if isinstance(part, Run) else None
        problem = part.problem if isinstance(part, Run) else part
        assert problem is not None
        self.problem, self.begins, self.hands = problem, begins, hands
        self.name, self.number = problem.name, number
        again = self.run is not None and not number
        self.seed = self.run.seed if self.run is not None and again else options["seed"] + number
        kept = dict.fromkeys(
            _signal(v)[0] for v in hands.values() if v not in problem.space.domains
        )
        self.evaluate = Evaluator(
            problem, options["batch"], seed=self.seed, precision=options["precision"],
            keep_traces=tuple(kept),
        )  # fmt: skip

    def simulated(
        self, arrivals: _Arrivals | None, samples: int, confidence: float
    ) -> tuple[PartEstimate, list[dict[str, Any]], _Arrivals]:
        """Simulate samples, and return the estimate, the failures and who arrives at the end."""
        if arrivals is None and self.run is not None:
            rows = self.run.table.all
            u = self.problem.space.points(rows.head(samples))
            inside = np.ones(len(u), bool)
        else:
            u, inside = self.points(arrivals, samples)
        verdicts = self.evaluate(u)
        proper = verdicts.proper & inside
        failing = verdicts.violated & proper
        paths = self.paths(u, arrivals)
        failures, without, count = int(failing.sum()), int((~proper).sum()), len(u)
        if arrivals is None and self.run is not None:
            counts = self.run.table.counts
            failures, without = counts.violating, counts.without_verdict
            count = self.run.simulations
        estimate = _estimate(self.name, failures, without, count, count, confidence)
        going = np.flatnonzero(proper & ~failing)
        reached = _Arrivals(self.ends(verdicts, u, going), [paths[i] for i in going])
        return estimate, [{"part": self.name, **paths[i]} for i in np.flatnonzero(failing)], reached

    def points(
        self, arrivals: _Arrivals | None, samples: int
    ) -> tuple[Float[np.ndarray, "n d"], Bool[np.ndarray, " n"]]:
        """Draw points that begin where the previous part ended, and flags of those in the space."""
        space = self.problem.space
        rng = np.random.default_rng([self.seed, self.number])
        count = samples if arrivals is None else len(arrivals.paths)
        u, accepted = np.zeros((count, space.dim), np.float32), np.zeros(count, bool)
        for _ in range(TRIES):
            drawn = rng.random((count, space.dim)).astype(np.float32)
            if arrivals is not None:
                features = dict(space.features_at(drawn)) | arrivals.ends
                begins = np.asarray(space.points_at(features))[:, self.columns]
                drawn[:, self.columns] = begins
            u = np.where(accepted[:, None], u, drawn)
            accepted |= np.asarray(space.accepts_points(np.clip(u, 0, 1)))
            if accepted.all():
                break
        # A number that rounding has moved over the end is inside.
        return np.clip(u, 0, 1), accepted & np.all((u > -1e-5) & (u < 1 + 1e-5), axis=1)

    def weighted(
        self, arrivals: _Arrivals, confidence: float
    ) -> tuple[PartEstimate, list[dict[str, Any]], list[str]]:
        """Weight the rows of the run by the number of sequence samples that start near them."""
        from scipy.spatial import KDTree

        assert self.run is not None
        rows = self.run.table.all
        known = rows["status"].eq("ok").to_numpy()
        starts = self.problem.space.points(rows)
        u, inside = self.points(arrivals, 0)
        gaps, near = map(
            np.asarray, KDTree(starts[:, self.columns]).query(u[:, self.columns], p=np.inf)
        )
        proper = inside & known[near]
        failing = rows["violated"].to_numpy(bool)[near] & proper
        count, without = len(u), int((~proper).sum())
        shares = np.bincount(near[inside]) / max(int(inside.sum()), 1)
        # The variances of the beginnings and of the weighted rows add up.
        effective = 1 / (1 / count + float(np.sum(shares**2))) if inside.any() else 0.0
        failures = int(failing.sum())
        estimate = _estimate(self.name, failures, without, count, effective, confidence)
        notes = [
            f"the interval of {self.name} is approximate: it weights rows of a run that started "
            f"elsewhere, {self.run.simulations:,} of them"
        ]
        far = float(np.quantile(gaps[inside], 0.95)) if inside.any() else 0.0
        if far > FAR:
            notes.append(
                f"rows of {self.name} start {far:.0%} of a range away from where the sequence "
                "reaches it: run it from there, or give its problem instead of its run"
            )
        tried = np.flatnonzero(failing)[:CONFIRMED]
        if not len(tried):
            return estimate, [], notes
        u[tried] = np.where(self.columns, u[tried], starts[near[tried]])
        again = self.evaluate(u[tried])
        paths = self.paths(u[tried], _Arrivals({}, [arrivals.paths[i] for i in tried]))
        found = np.flatnonzero(again.violated & again.proper)
        return estimate, [{"part": self.name, **paths[i]} for i in found], notes

    @property
    def columns(self) -> Bool[np.ndarray, " d"]:
        """The coordinates of the features that the part before hands over."""
        return np.concatenate(
            [np.full(d.size, name in self.begins) for name, d in self.problem.space.root.fields]
        )

    def paths(
        self, u: Float[np.ndarray, "n d"], arrivals: _Arrivals | None
    ) -> list[dict[str, Any]]:
        """Return the features of points as columns, after those of the parts before."""
        space = self.problem.space
        columns = {f"{self.name}.{n}": v for n, v in space.rows(space.features_at(u)).items()}
        own = pd.DataFrame(columns).to_dict("records")
        before = [{}] * len(own) if arrivals is None else arrivals.paths
        return [
            {**b, **{str(n): v for n, v in o.items()}} for b, o in zip(before, own, strict=True)
        ]

    def ends(
        self, verdicts: Verdicts, u: Float[np.ndarray, "n d"], going: Int[np.ndarray, " m"]
    ) -> dict[str, np.ndarray]:
        """Return what the next part begins with."""
        if not len(going) or not self.hands:
            return {}
        features, found = self.problem.space.features_at(u), dict[str, np.ndarray]()
        for name, source in self.hands.items():
            if source in self.problem.space.domains:
                found[name] = np.asarray(features[source])[going]
            else:
                assert verdicts.traces is not None
                found[name] = np.stack([_last(verdicts.traces[i], source) for i in going])
        return found


def _estimate(
    name: str, failures: int, without: int, count: int, effective: float, confidence: float
) -> PartEstimate:
    """Return a part with the interval of Clopper and Pearson for a number of effective samples."""
    known, share = count - without, effective / count
    low, high = exact_interval(
        share * failures, share * (failures + without), effective, confidence
    )
    return PartEstimate(
        name=name, probability=failures / known if known else float("nan"), low=low, high=high,
        samples=count, without=without, effective=effective,
    )  # fmt: skip


def _signal(source: str) -> tuple[str, int | None]:
    """Return a signal and the index of its entry: `"x"` or `"position[1]"`."""
    name, bracket, index = source.partition("[")
    return name, int(index.rstrip("]")) if bracket else None


def _last(trace: Trace | None, source: str) -> np.ndarray:
    """Return the last value of a signal."""
    assert trace is not None
    name, index = _signal(source)
    if name not in trace.signals:
        known = ", ".join(trace.signals)
        raise ProblemError(f"handover names a signal {name!r}; the trace has {known}")
    valid = -1 if trace.valid is None else int(np.asarray(trace.valid)) - 1
    value = np.asarray(trace.signals[name])[valid]
    return np.asarray(value if index is None else value[index])


def _stages(
    parts: Sequence[Problem | Run], handover: Handover | Sequence[Handover], batch: int,
    precision: str, seed: int,
) -> list[_Stage]:  # fmt: skip
    """Check the parts and how they are joined."""
    if not isinstance(parts, Sequence) or len(parts) < 2:
        raise ValueError("a sequence has two parts or more, in a list")
    joints = len(parts) - 1
    joined = [handover] * joints if isinstance(handover, Mapping) else list(handover)
    if len(joined) != joints or not all(joined):
        raise ValueError(f"handover is a dictionary, or a list of {joints} that are not empty")
    problems = [_problem(part, i) for i, part in enumerate(parts)]
    names = [problem.name for problem in problems]
    if len(set(names)) < len(names):
        raise ValueError(f"the parts need different names; got {', '.join(names)}")
    for before, after, one in zip(problems[:-1], problems[1:], joined, strict=True):
        check_names(f"feature of {after.name}", one, after.space.domains)
        form = before.form()
        if form is not None:
            known: Iterable[str] = (*form.signals, *before.space.domains)
            sources = [v if v in before.space.domains else _signal(v)[0] for v in one.values()]
            check_names(f"signal or feature of {before.name}", sources, known)
    options = {"batch": batch, "precision": precision, "seed": seed}
    begins, hands = [{}, *joined], [*joined, {}]
    return [
        _Stage(part, i, begin, hand, options)
        for i, (part, begin, hand) in enumerate(zip(parts, begins, hands, strict=True))
    ]


def _problem(part: Problem | Run, number: int) -> Problem:
    problem = part.problem if isinstance(part, Run) else part
    if not isinstance(problem, Problem):
        raise TypeError(f"part {number + 1} must be a Problem, or a Run that has its problem")
    if isinstance(part, Run) and part.failure_rate is None:
        raise ValueError(
            f"the rows of {problem.name} are no samples of its prior: run it with search='uniform'"
        )
    problem.check()
    return problem
