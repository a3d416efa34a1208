"""Searches that propose scenes to a runner of Scenic, which simulates and gives feedback.

    scenario = vj.scenic("pass.scenic").steered("cross_entropy", seed=1)
    scene, _ = scenario.generate(feedback=rho)          # as of Scenic's own scenario

    scenic.scenarioFromFile("pass.scenic", params={"externalSampler": scenic_sampler("bayes")})

The first proposes all random values of a program. The second is Scenic's interface of external
samplers, for programs with `VerifaiRange` and its kin.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Float

from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.errors import require
from verifai_jax.features import Box, Categorical, FeatureSpace
from verifai_jax.search import Search, named
from verifai_jax.search.proposals import Proposals

BATCH = 8
"""Scenes that a search proposes before it learns from their feedback."""


class Steps:
    """Points of a search, one at a time; each is answered by a feedback before the next."""

    def __init__(self, space: FeatureSpace, search: str | Search, seed: int, batch: int) -> None:
        chosen = named(search) if isinstance(search, str) else search
        wants = chosen.wants
        needs = {
            "derivatives": wants.derivatives, "traces": wants.traces is not None,
            "covered behaviour": wants.coverage_ids, "outcomes": wants.outcomes,
            "likelihoods": wants.likelihood,
        }  # fmt: skip
        if lacking := [name for name, needed in needs.items() if needed]:
            raise ValueError(
                f"search {chosen!r} learns from {lacking[0]}, and a feedback is one number: use "
                "cross_entropy, mutation, bayes, turbo or another that learns from the robustness"
            )
        check_count("batch", batch)
        key = run_keys(check_count("seed", seed, 0))[0]
        self._proposals = Proposals(chosen, space.cube, batch, key, space.constraint)
        self._batch, self._points, self._answers = batch, np.zeros((0, space.dim)), []
        self._waits = False

    def next(self, feedback: float | None) -> Float[np.ndarray, " d"]:
        """Return the next point; `feedback` is of the last one, None or NaN without a verdict."""
        if self._waits:
            self._answers.append(math.nan if feedback is None else float(feedback))
        if len(self._answers) == len(self._points):
            if len(self._points):
                rho = np.asarray(self._answers, np.float32)
                self._proposals.tell(rho, np.isfinite(rho), None)
            self._points, self._answers = self._round(), []
        self._waits = True
        return self._points[len(self._answers)]

    def _round(self) -> Float[np.ndarray, "n d"]:
        while not self._proposals.exhausted:
            points = np.asarray(self._proposals.next(self._batch))
            if len(points):
                return points
            self._proposals.tell_refused()
        raise ValueError("the search has no further point")


class SteeredScenario:
    """A Scenic program whose scenes a search proposes; `generate` is like that of Scenic."""

    def __init__(self, program: Any, search: str | Search, seed: int, batch: int) -> None:
        self.program, self._steps = program, Steps(program.space, search, seed, batch)
        self.features: dict[str, Any] | None = None
        """Features of the last scene, for `program.scene`."""

    def generate(
        self, maxIterations: int = 2000, verbosity: int = 0, feedback: float | None = None
    ) -> tuple[Any, int]:
        """Return the next scene, and the number of points that were tried for it.

        **Arguments:** those of Scenic's `Scenario.generate`; `feedback` is the robustness of the
        last scene, negative for a failure.
        **Raises:** `ValueError` if Scenic refuses so many scenes in a row.
        """
        refused: ValueError | None = None
        for count in range(1, maxIterations + 1):
            self.features = self.program.space.unflatten(self._steps.next(feedback))
            try:
                return self.program.scene(self.features), count
            except ValueError as error:
                refused, feedback = error, None
        raise ValueError(f"no scene in {maxIterations} iterations: {refused}") from refused


def scenic_sampler(
    search: str | Search = "cross_entropy", *, seed: int = 0, batch: int = BATCH
) -> type[Any]:
    """Return an external sampler for Scenic: a search of this package that proposes parameters.

        params = {"externalSampler": vj.scenic_sampler("cross_entropy", seed=1)}
        scenario = scenic.scenarioFromFile("pass.scenic", params=params)
        scene, _ = scenario.generate(feedback=rho)      # rho of the last scene, negative: a failure

    It proposes `VerifaiRange`, `VerifaiDiscreteRange` and `VerifaiOptions`; for all other random
    values see `ScenicProgram.steered`.

    **Arguments:**
    - `search`: a search that learns from the robustness alone, or its name.
    - `seed`: the seed of the search.
    - `batch`: number of scenes that it proposes before it learns from them.
    **Returns:** a subclass of Scenic's `ExternalSampler`.
    **Raises:** `MissingExtra` without Scenic; `ValueError` for a search that learns from more.
    """
    external = require("scenic.core.external_params", "scenic")
    Steps(FeatureSpace({"probe": Box(0.0, 1.0)}), search, seed, batch)

    class SearchSampler(external.ExternalSampler):
        """An external sampler that asks a search."""

        def __init__(self, params: Any, globalParams: Any) -> None:
            super().__init__(params, globalParams)
            if self.rejectionFeedback is None:
                self.rejectionFeedback = math.nan  # No verdict: the search learns nothing.
            self.params = tuple(params)
            for index, param in enumerate(self.params):
                if not isinstance(param, external.VerifaiParameter):
                    raise ValueError(f"scenic_sampler takes VerifAI's parameters; got {param!r}")
                param.sampler, param.index = self, index
            domains = {f"param{i}": _domain(each) for i, each in enumerate(self.params)}
            self.space = FeatureSpace(domains)
            self._steps = Steps(self.space, search, seed, batch)

        def nextSample(self, feedback: float | None) -> dict[str, Any]:
            return self.space.unflatten(self._steps.next(feedback))

        def valueFor(self, param: Any) -> tuple[float]:
            value = self.cachedSample[f"param{param.index}"]
            if _is_discrete(param):
                return (int(value),)
            ((low, high),) = param.domain.intervals
            share, probs = float(value), param.probs
            if probs is not None:
                ends = np.cumsum([0.0, *probs])
                share = float(np.interp(share, ends, np.linspace(0, 1, len(ends))))
            return (low + (high - low) * share,)

    return SearchSampler


def _is_discrete(param: Any) -> bool:
    return type(param).__name__ == "VerifaiDiscreteRange"


def _domain(param: Any) -> Box | Categorical:
    """Return the domain of a parameter: its values, or its share of the probability."""
    if not _is_discrete(param):
        return Box(0.0, 1.0)
    ((low, high),) = param.domain.intervals
    values = range(int(low), int(high) + 1)
    weights = [1 / len(values)] * len(values) if param.probs is None else param.probs
    kept = [(value, weight) for value, weight in zip(values, weights, strict=True) if weight > 0]
    total = math.fsum(weight for _, weight in kept)
    return Categorical(*(value for value, _ in kept), weights=[w / total for _, w in kept])
