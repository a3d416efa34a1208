"""What a sweep is asked for, refused before anything trains."""

from typing import Any

from verifai_jax.core.checks import check_count, check_fraction, check_positive
from verifai_jax.sweeps.halving import Halving
from verifai_jax.sweeps.study import Study, StudyError
from verifai_jax.sweeps.trainer import STEPS


def check_asked(
    study: Any,
    *,
    configurations: int,
    seed: int,
    samples: int,
    confidence: float,
    budget: int | None,
    attack_simulations: int,
    halving: Any,
    batch: int | None,
    episodes: int,
    max_seconds: float | None,
) -> None:
    """Refuse options of a sweep that make no sense, alone or with this study.

    **Raises:** `TypeError` for something that is no study or no `Halving`; `ValueError` for a
    number out of range, or a budget that not all policies can be sampled with; `StudyError` for
    halving without snapshots or of trainings of several lengths.
    """
    if not isinstance(study, Study):
        raise TypeError(f"sweep needs a Study; got {study!r}")
    counts = {"configurations": configurations, "samples": samples, "episodes": episodes}
    if batch is not None:
        counts["batch"] = batch
    for name, value in counts.items():
        check_count(name, value)
    for name, value in {"seed": seed, "attack_simulations": attack_simulations}.items():
        check_count(name, value, 0)
    check_fraction("confidence", confidence)
    if max_seconds is not None:
        check_positive("max_seconds", max_seconds)
    if halving is not None:
        _check_halving(study, halving)
    if budget is not None:
        most = most_policies(study, configurations, halving)
        if budget < most * samples:
            raise ValueError(
                f"{most} policies with {samples} samples each need a budget of at least "
                f"{most * samples}; got {budget}"
            )


def most_policies(study: Study, configurations: int, halving: Halving | None) -> int:
    """How many rows a sweep has at most."""
    lengths = STEPS in study.space.domains
    rungs = 1 + sum(lengths or at < study.trainer.steps for at in study.snapshots)
    going, total = configurations, 0
    for _ in range(rungs):
        total += going
        going = going if halving is None else halving.count(going)
    return total * len(study.training_seeds)


def _check_halving(study: Study, halving: Any) -> None:
    if not isinstance(halving, Halving):
        raise TypeError(f"halving must be a Halving; got {halving!r}")
    if STEPS in study.space.domains:
        raise StudyError(
            "halving compares trainings of one length at their snapshots; "
            "take steps out of the space"
        )
    if not [at for at in study.snapshots if at < study.trainer.steps]:
        raise StudyError(
            "halving stops trainings at snapshots; the study has none before the end at "
            f"{study.trainer.steps} steps"
        )
