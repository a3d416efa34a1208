"""Population-based training: at checkpoints the worst go on as changed copies of the best.

    sweep(study, Population(), configurations=16)                   # 16 trainings side by side
    sweep(study, Population(by="safety"), configurations=16, halving=Halving(1, until_safe=True))

Source: Jaderberg et al., Population based training of neural networks (2017): exploit by truncation
selection, explore by perturbing or drawing anew (section 4.1.1).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from verifai_jax.addons.training.sweeps.halving import RETURN, SAFETY
from verifai_jax.addons.training.sweeps.hyperparameters import Hyperparameters, values_at
from verifai_jax.addons.training.sweeps.trainer import Trainer
from verifai_jax.core.messages.checks import check_fraction
from verifai_jax.core.messages.errors import check_names
from verifai_jax.features import FeatureSpace
from verifai_jax.search import Search

TRIES = 16
"""Changes that are tried for one that the space accepts."""


@dataclass(frozen=True)
class Population:
    """Population-based training: the places of the worst are taken by changed copies of the best.

    All configurations train side by side. At each checkpoint those with the worst results end. As
    many of the best, drawn at random, go on a second time: from their policies and all else that
    their trainings had learnt, with changed hyper-parameters. Only hyper-parameters that change no
    shape are changed.

    **Arguments:**
    - `search`: the search for the first configurations.
    - `share`: the share of the configurations that end at a checkpoint, and the share of the best
      from which their successors are drawn; rounded down, at most a half.
    - `step`: how far a hyper-parameter moves, as a share of its range: up or down by as much. The
      range of a `LogUniform` is that of the logarithm.
    - `anew`: the probability with which it is drawn from its whole range instead.
    - `by`: the criterion, as in `Halving`.
    **Raises:** `ValueError` for shares out of range; `UnknownNameError` for another criterion.
    """

    search: str | Search = "halton"
    share: float = 0.25
    step: float = 0.1
    anew: float = 0.25
    by: str = RETURN

    def __post_init__(self) -> None:
        check_fraction("share", self.share)
        if self.share > 0.5:
            raise ValueError(f"share must be at most a half; got {self.share}")
        check_fraction("step", self.step)
        check_fraction("anew", self.anew, zero=True, one=True)
        check_names("criterion of a population", [self.by], (RETURN, SAFETY))

    def pairs(
        self, objective: Mapping[int, float], members: int, rng: np.random.Generator
    ) -> list[tuple[int, int]]:
        """Choose the configurations that end, each with the one that goes on in its place.

        **Arguments:**
        - `objective`: objectives by number; the smallest is best, and NaN and infinity worst.
        - `members`: configurations of the whole population.
        """
        known = {n: value if np.isfinite(value) else np.inf for n, value in objective.items()}
        ranked = sorted(known, key=lambda n: (known[n], n))
        count = min(int(self.share * members), len(ranked) // 2)
        best = [n for n in ranked[:count] if np.isfinite(known[n])]
        return [(n, best[rng.integers(len(best))]) for n in ranked[len(ranked) - count :] if best]

    def changed(
        self, values: Hyperparameters, space: FeatureSpace, trainer: Trainer,
        rng: np.random.Generator,
    ) -> Hyperparameters:  # fmt: skip
        """Return other hyper-parameters of the same structure, which the space accepts."""
        import pandas as pd

        # In a table, choices that are no numbers are texts.
        row = {name: values[name] for name in space.columns}
        row = {n: v if isinstance(v, bool | int | float) else str(v) for n, v in row.items()}
        shape, at = (TRIES, space.dim), space.points(pd.DataFrame([row]))[0]
        moved = np.abs(at + self.step * rng.choice([-1.0, 1.0], shape))
        # What would leave the range turns at its end: an unchanged copy would train the same again.
        points = np.where(rng.random(shape) < self.anew, rng.random(shape), 1 - np.abs(1 - moved))
        for candidate in values_at(space, points):
            found = _of_one_structure(values, candidate, trainer)
            accepted = space.where is None or bool(space.accepts(space.root.coerce(found)))
            if accepted and found != values:
                return found
        return dict(values)


def _of_one_structure(
    values: Hyperparameters, candidate: Hyperparameters, trainer: Trainer
) -> Hyperparameters:
    """Return the values with as much of a candidate as a training can go on with."""
    found, form = dict(values), trainer.structure(values)
    for name, value in candidate.items():
        try:
            other = {**found, name: value}
            trainer.configuration(other).check()
        except (ValueError, TypeError):
            continue
        if trainer.structure(other) == form:
            found = other
    return found
