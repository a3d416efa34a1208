"""Branch and bound over boxes of the feature space: `verify`."""

import time
from copy import deepcopy
from pathlib import Path

from verifai_jax._version import __version__
from verifai_jax.addons.verification.boxes import Boxes
from verifai_jax.addons.verification.branch_and_bound import BranchAndBound
from verifai_jax.addons.verification.continuous import between_samples
from verifai_jax.addons.verification.enclosure import Enclosure, enclosable
from verifai_jax.addons.verification.result import Verification, as_verification, described
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.messages.checks import check_count, check_fraction, options_of
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.features.continuous import OUTERMOST
from verifai_jax.problem.problem import Problem
from verifai_jax.problem.silent_mistakes import formula_notes
from verifai_jax.statistics.stopping import Stop

REST = 0.08
"""Share of the seconds that is kept for the samples of what stays undecided."""
CONTRADICTED = (
    "boxes have a simulation outside of their bounds, and stay undecided: this is a mistake of "
    "verifai_jax, please report it"
)


@suggests_options
@shows_progress("verifying")
def verify(
    problem: Problem, *, boxes: int | None = None, stop: Stop | None = None, samples: int = 4096,
    confidence: float = 0.95, seed: int = 0, precision: str = "float32", continuous: bool = False,
    resume: Verification | str | Path | None = None, progress: bool | None = None,
) -> Verification:  # fmt: skip
    """Divide the feature space into boxes that are proved, broken, or undecided.

    Each box is simulated with sets of numbers. It is *proved* if the robustness is at least zero
    for all of them, in real arithmetic and with the rounding of the simulation; *broken* if it
    contains a point whose robustness is certainly negative. Other boxes are split where the
    robustness changes most, the largest first. The subject of the proof is the discrete-time system
    as it is simulated, with its steps; or, if `continuous`, the differential equation itself.

    **Arguments:**
    - `problem`: a problem whose system JAX traces, without random numbers of its own.
    - `boxes`: maximum number of boxes to examine.
    - `stop`: the approximate seconds; 60 if `boxes` is left out too. Ctrl-C stops it at any time.
    - `samples`: simulations from the prior of the undecided part, to bound how often it fails.
    - `confidence`: the confidence of that bound, which holds whenever one stops.
    - `continuous`: verify the differential equation of a system made by `vj.ode`, in real
      arithmetic and at all times, with the controller's output held between its samples. Its
      dynamics must be smooth, without switches or an early end, its formulas without until, since
      and next. Nothing is sampled, and searches and estimates, which simulate steps, cannot use the
      result.
    - `resume`: an earlier result for the same problem, or its file, to continue.
    - all other arguments: as in `falsify`.
    **Returns:** the result: the three volumes, the three probabilities, the boxes.
    **Raises:** `ProblemError` for a black box, for a system that draws random numbers, and for
    systems and formulas that `continuous` does not support; `MissingRule` for an operation without
    a rule for sets, with its name and line; `ValueError` for options out of range, and for the
    result of another problem.
    """
    started = time.perf_counter()
    if not isinstance(problem, Problem):
        raise TypeError(f"verify needs a Problem; got {type(problem).__name__}")
    if boxes is not None:
        check_count("boxes", boxes)
    check_count("samples", samples, 0)
    check_fraction("confidence", confidence)
    in_precision(precision)
    seconds = options_of("verify", Stop, stop, "seconds").seconds
    seconds = 60.0 if seconds is None and boxes is None else seconds
    precision = "float64" if continuous else precision
    problem = enclosable(problem, precision)
    about = between_samples(problem) if continuous else problem
    before = None if resume is None else as_verification(resume)
    if before is not None:
        before.check_same(problem, precision, continuous)
    sources = problem.sources()
    enclosure = Enclosure(about, precision)
    found = Boxes.whole(enclosure) if before is None else deepcopy(before.boxes)
    work = BranchAndBound(problem, enclosure, found, seed)
    end = None if seconds is None else started + seconds * (1 - REST)
    stopped = work.go_on(end, boxes)
    work.confirm()
    work.sample(0 if continuous else samples)
    seconds = time.perf_counter() - started
    return Verification(
        **described(problem), columns=problem.space.coordinates, boxes=work.boxes,
        shares=enclosure.ranges.shares(work.boxes.low),
        upper_shares=enclosure.ranges.shares(work.boxes.high),
        scales=tuple(enclosure.ranges.scales()), constraint=problem.space.where is not None,
        tails={name: 2 * OUTERMOST * sum(domain.tailed)
               for name, domain in problem.space.domains.items() if any(domain.tailed)},
        precision=precision, confidence=confidence, continuous=continuous, version=__version__,
        looked_at=work.looked_at + (0 if before is None else before.looked_at),
        simulations=work.evaluator.simulations + (0 if before is None else before.simulations),
        seconds=seconds + (0 if before is None else before.seconds), stopped=stopped,
        notes=(*([f"{work.contradicted} {CONTRADICTED}"] if work.contradicted else []),
               *formula_notes(problem)),
        sources=sources.to_json(),
    )  # fmt: skip
