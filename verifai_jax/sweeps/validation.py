"""Checks of the options of a sweep, before anything trains."""

from verifai_jax.core.checks import check_count, check_fraction, check_positive
from verifai_jax.sweeps.halving import Halving
from verifai_jax.sweeps.study import Study, StudyError
from verifai_jax.sweeps.trainer import STEPS


def check_options(
    study: object,
    *,
    configurations: int,
    seed: int,
    samples: int,
    confidence: float,
    budget: int | None,
    attack_simulations: int,
    halving: object,
    batch: int | None,
    episodes: int,
    max_seconds: float | None,
) -> None:
    """Check the options of a sweep, alone and with its study.

    **Raises:** `TypeError` for something that is not a study or a `Halving`; `ValueError` for a
    number out of range, or a budget that cannot sample all policies; `StudyError` for halving
    without checkpoints or of trainings of several lengths.
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
        policies = count_policies(
            study, configurations, halving if isinstance(halving, Halving) else None
        )
        if budget < policies * samples:
            raise ValueError(
                f"{policies} policies with {samples} samples each need a budget of at least "
                f"{policies * samples}; got {budget}"
            )


def count_policies(study: Study, configurations: int, halving: Halving | None) -> int:
    """Return the greatest number of rows that a sweep can have."""
    several_lengths = STEPS in study.space.domains
    checkpoints = 1 + sum(several_lengths or at < study.trainer.steps for at in study.checkpoints)
    left, total = configurations, 0
    for _ in range(checkpoints):
        total += left
        left = left if halving is None else halving.survivors(left)
    return total * len(study.training_seeds)


def _check_halving(study: Study, halving: object) -> None:
    if not isinstance(halving, Halving):
        raise TypeError(f"halving must be a Halving; got {halving!r}")
    if STEPS in study.space.domains:
        raise StudyError(
            "halving compares trainings of one length at their checkpoints; "
            "take steps out of the space"
        )
    if not [at for at in study.checkpoints if at < study.trainer.steps]:
        raise StudyError(
            "halving stops trainings at checkpoints; the study has none before the end at "
            f"{study.trainer.steps} steps"
        )
