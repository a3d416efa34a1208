"""Counterexample-guided data augmentation of any network whose inputs are rendered from features.

task = SupervisedTask("rings", space, render, label, train, predict, wrongness)
print(vj.augment(task, arms="all"))
"""

from verifai_jax.addons.training.augmentation._augment import augment
from verifai_jax.addons.training.augmentation.arms import ARMS
from verifai_jax.addons.training.augmentation.examples import Examples
from verifai_jax.addons.training.augmentation.result import Augmentation
from verifai_jax.addons.training.augmentation.task import SupervisedTask, TaskError
from verifai_jax.addons.training.augmentation.transformations import (
    brightness,
    combine,
    contrast,
    flip,
    shift,
)

__all__ = [
    "ARMS", "Augmentation", "Examples", "SupervisedTask", "TaskError", "augment", "brightness",
    "combine", "contrast", "flip", "shift",
]  # fmt: skip


def __dir__() -> list[str]:
    return list(__all__)
