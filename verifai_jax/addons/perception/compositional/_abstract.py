"""Compositional falsification: the loop without images, then single images, then the full loop.

    result = vj.perception.abstract(
        problem,                                        # the loop with its network
        lambda severity: loop(late(severity)),          # the same loop without images
        lambda features, sample: look(features, sample["x"]),
        "distance < 15 and estimate > 15",
    )
    print(result)
    result.replay().plot("failure.png")

Sources: Dreossi, Donze and Seshia, Compositional falsification of cyber-physical systems with
machine learning components, NFM 2017 and Journal of Automated Reasoning 63, 2019; Dreossi et al.,
VerifAI: a toolkit for the formal design and analysis of artificial intelligence-based systems, CAV
2019.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import pandas as pd
from jaxtyping import Array

from verifai_jax._version import __version__
from verifai_jax.addons.perception.compositional import result
from verifai_jax.addons.perception.compositional.region import (
    UNCERTAIN,
    Abstraction,
    AbstractLoop,
    sample_region,
)
from verifai_jax.core.compute.precision import reproducible_settings
from verifai_jax.core.display.progress import ProgressBar
from verifai_jax.core.messages.checks import check_count, options_of
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.core.values.trace import Trace
from verifai_jax.falsification import Run, falsify, resume, simulate
from verifai_jax.falsification.validation import check_search
from verifai_jax.features import FeatureSpace
from verifai_jax.mtl import Formula, parse
from verifai_jax.problem import Problem, ProblemError
from verifai_jax.search import Search
from verifai_jax.statistics.stopping import Stop
from verifai_jax.systems.base import Seed, System

Frame = Callable[[Any, Mapping[str, Array]], Mapping[str, Any]]
"""`(features, sample of a trace) -> signals` of the network's reading of one rendered image."""


@suggests_options
@reproducible_settings()
def abstract(
    problem: Problem,
    abstraction: Abstraction,
    frame: Frame,
    error: Formula | str,
    *,
    search: str | Search = "cross_entropy",
    budget: int = 2000,
    stop: Stop | None = None,
    samples: int = 4096,
    batch: int = 16,
    seed: int = 0,
    images_per_simulation: int | None = None,
    progress: bool | None = None,
) -> result.Compositional:
    """Find failures of a loop caused by its perception, while rendering few images.

    Three stages:

    1. The loop is simulated without images: once with a perfect perception, and once with the worst
    allowed one. The *region of uncertainty* contains the points that fail only with the worst one:
    only there can an error of the perception decide. For each of its points, bisection finds the
    smallest error with which the loop fails. 2. In the region, a search looks for images on which
    the network errs. One image is rendered for each point: from the last instant at which the
    perception must err for the loop to fail. 3. Points with such an image are simulated with the
    network in the loop, those with the largest error first. Only points that fail there are
    failures. After each batch of images, such simulations may use as many images as the batch, but
    at least one simulation is made.

    Failures outside the region, which need a larger error than allowed, are not searched for.
    Images that only fill up a compiled batch are not counted.

    **Arguments:**
    - `problem`: the loop with its network, one image at each sample of its traces.
    - `abstraction`: `severity -> system`, the same loop without images: its perception is the truth
      with an error of a severity from 0 (none) to 1 (the worst allowed); JAX traces it. All its
      simulations use one random key.
    - `frame`: `(features, sample) -> signals`: renders one image from the state in one sample of
      the abstraction's trace, and returns the signals that `error` uses.
    - `error`: a condition that the perception errs, on the signals of one instant, both of the
      abstraction and of `frame`. The search for images maximises its robustness, so continuous
      signals (a logit, a distance) work better than a decision.
    - `search`: the search for images: a name, or a search with its options.
    - `budget`: maximum number of rendered images.
    - `stop`: the number of confirmed failures after which it ends; 1 when left out.
    - `samples`: number of samples of the prior, to sample the region of uncertainty.
    - `batch`: number of images in a round.
    - `images_per_simulation`: number of images in a simulation; by default one for each sample of a
      trace.
    - all other arguments: as in `falsify`.
    **Returns:** the region, the images, the candidates and which of them fail in the loop, with the
    number of rendered images of each stage.
    **Raises:** before anything is rendered, `ProblemError` for parts that do not fit; `ValueError`
    for numbers out of range, or a search that cannot work on the space.
    """
    after = options_of("abstract", Stop, stop, "after").after or 1
    condition = _checked(problem, abstraction, error)
    for name, value in (("samples", samples), ("batch", batch)):
        check_count(name, value)
    check_count("seed", seed, 0)
    if images_per_simulation is not None:
        check_count("images_per_simulation", images_per_simulation)
    per = images_per_simulation or _images(problem)
    if check_count("budget", budget) < batch + per:
        raise ValueError(
            f"budget must be {batch + per} at least, for a batch of {batch} images and one "
            f"simulation with {per}; got {budget}"
        )
    problem = replace(problem, nominal=None)  # Its simulation would not be counted.
    loop = AbstractLoop(problem, abstraction, condition, seed)
    image = _image_problem(problem, loop, frame)
    image.check()
    check_search(replace(image, space=problem.space), search)
    stages = _Stages(problem, image, search, budget, after, batch, seed, per)
    with ProgressBar(progress) as bar:
        bar.begin(f"{problem.name}: region", samples, "samples")
        region = sample_region(loop, samples, seed)
        bar.end()
        bar.begin(f"{problem.name}: images", budget, "images")
        ended = stages.play(bar) if UNCERTAIN in set(region["kind"]) else result.NOTHING
    return result.Compositional(
        name=problem.name,
        error=str(condition),
        region=region,
        images=stages.images,
        simulations=tuple(stages.simulations),
        candidates=stages.candidates(problem.space.columns),
        images_per_simulation=per,
        budget=budget,
        search=repr((stages.images and stages.images.search) or search),
        seed=seed,
        ended=ended,
        version=__version__,
        problem=problem,
    )


def _checked(problem: Problem, abstraction: Abstraction, error: Formula | str) -> Formula:
    """Check the parts before anything compiles, and return the condition."""
    if not isinstance(problem, Problem):
        raise TypeError(f"abstract needs a Problem; got {type(problem).__name__}")
    if not callable(abstraction):
        raise TypeError(f"abstraction must be a function severity -> system; got {abstraction!r}")
    condition = parse(error) if isinstance(error, str) else error
    if condition.temporal_depth:
        raise ProblemError(
            f"error must be a condition on one instant, without temporal operators; got {condition}"
        )
    problem.check()
    # The same formulas and the error, on the traces of the abstraction.
    formulas = {**problem.formulas, "error": condition}
    system = abstraction(0.0)
    replace(problem, name=f"{problem.name}, abstracted", system=system, spec=formulas,
            nominal=None, priority=None).check()  # fmt: skip
    return condition


def _images(problem: Problem) -> int:
    form = problem.form()
    if form is None:
        raise ValueError(
            f"the number of images that a simulation of {problem.name!r} takes is not known in "
            "advance: give images_per_simulation"
        )
    return form.length


def _image_problem(problem: Problem, loop: AbstractLoop, frame: Frame) -> Problem:
    """Return the problem of one image: the network must not err where it decides."""
    given = problem.space.where

    def where(features: Any) -> Array:
        uncertain = loop.uncertain(features)
        return uncertain if given is None else uncertain & given(features)

    return Problem(
        f"{problem.name}, one image", FeatureSpace(problem.space.domains, where=where),
        DecisiveImage(loop, frame, problem.system.lanes), ~loop.error,
    )  # fmt: skip


class _Stages:
    """Images and simulations by turns, until something ends them."""

    def __init__(
        self, problem: Problem, image: Problem, search: str | Search, budget: int, wanted: int,
        batch: int, seed: int, per: int,
    ) -> None:  # fmt: skip
        self.problem, self.image, self.search = problem, image, search
        self.budget, self.wanted, self.batch = budget, wanted, batch
        self.seed, self.per = seed, per
        self.images: Run | None = None
        self.simulations: list[Run] = []
        self.rows: list[int] = []
        self.after: list[int] = []

    @property
    def rendered(self) -> int:
        """Images so far."""
        single = 0 if self.images is None else len(self.images.table)
        return single + self.per * len(self.rows)

    @property
    def confirmed(self) -> int:
        """Failures of the loop so far."""
        return sum(len(run.table.counterexamples) for run in self.simulations)

    def play(self, bar: ProgressBar) -> str:
        """Return what ended it."""
        while self.rendered < self.budget:
            before = self.rendered
            stopped = self._look(min(self.batch, self.budget - self.rendered))
            if stopped == result.INTERRUPTED:
                return result.INTERRUPTED
            for row in self._next_candidates(last=stopped != result.BUDGET):
                if self.rendered + self.per > self.budget:
                    return result.BUDGET
                if self._simulate(row) == result.INTERRUPTED:
                    return result.INTERRUPTED
                if self.confirmed >= self.wanted:
                    return result.FOUND
            if stopped != result.BUDGET:
                return stopped
            bar.advance(self.rendered - before, f"{self.confirmed} confirmed")
        return result.BUDGET

    def _look(self, count: int) -> str:
        """Render a batch of images in the region."""
        if self.images is None:
            self.images = falsify(
                self.image, self.search, count, batch=self.batch, seed=self.seed, confirm=False,
                progress=False,
            )  # fmt: skip
        else:
            budget = len(self.images.table) + count
            self.images = resume(self.images, budget=budget, progress=False)
        return self.images.stopped

    def _next_candidates(self, last: bool) -> list[int]:
        """Return rows of images on which the network errs, the worst first; all in a last round."""
        rows = [int(row) for row in self._erring().index if row not in self.rows]
        return rows if last else rows[: max(1, self.batch // self.per)]

    def _erring(self) -> pd.DataFrame:
        assert self.images is not None
        return self.images.table.counterexamples.sort_values("rho", kind="stable")

    def _simulate(self, row: int) -> str:
        """Simulate the loop with the network, where an image is wrong."""
        run = simulate(
            self.problem, self._erring().loc[[row]], batch=1, seed=self.seed, progress=False
        )
        if run.stopped != result.INTERRUPTED:
            self.simulations.append(run)
            self.rows.append(row)
            self.after.append(self.rendered)
        return run.stopped

    def candidates(self, columns: tuple[str, ...]) -> pd.DataFrame:
        """Return the images on which the network errs: those simulated first, as simulated."""
        if self.images is None:
            return pd.DataFrame(columns=[*columns, *CANDIDATE])
        erring = self._erring()
        rows = [*self.rows, *(row for row in erring.index if row not in self.rows)]
        table = erring.loc[rows, [*columns, "rho"]].rename(columns={"rho": "image"})
        missing = [pd.NA] * (len(rows) - len(self.rows))
        verdicts = [run.table.all.iloc[0] for run in self.simulations]
        failed = [len(run.table.counterexamples) > 0 for run in self.simulations]
        table["simulated"] = [*(v["status"] for v in verdicts), *([""] * len(missing))]
        table["rho"] = [*(float(v["rho"]) for v in verdicts), *([float("nan")] * len(missing))]
        table["fails"] = pd.array([*failed, *missing], "boolean")
        table["rendered"] = pd.array([*self.after, *missing], "Int64")
        return table.rename_axis("image row")


CANDIDATE = ("image", "simulated", "rho", "fails", "rendered")
"""Columns of a candidate in addition to its features."""


class DecisiveImage(System):
    """The network's output for the last image that must be wrong for the loop to fail.

    **Arguments:**
    - `loop`: the loop without images.
    - `frame`: renders one image, and returns the signals of the network's output.
    - `lanes`: number of images processed together.
    """

    exact_step = True

    def __init__(self, loop: AbstractLoop, frame: Frame, lanes: int) -> None:
        self.loop, self.frame, self.lanes = loop, frame, lanes
        self.dt = 1.0

    def __call__(self, features: Any, key: Seed = None) -> Trace:
        """Render one image; the trace has one sample."""
        seen = self.frame(features, self.loop.decisive(features).sample)
        if not isinstance(seen, Mapping):
            raise TypeError(f"frame must return a dictionary of signals; got {type(seen).__name__}")
        return Trace({name: jnp.asarray(value)[None] for name, value in seen.items()}, dt=1.0)
