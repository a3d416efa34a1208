"""Counterexample-guided data augmentation of any network whose inputs are rendered from features.

task = SupervisedTask("rings", space, render, label, train, predict, wrongness)
print(vj.augment(task, arms="all"))
"""

from verifai_jax.augmentation._augment import augment as augment
from verifai_jax.augmentation.arms import ARMS as ARMS
from verifai_jax.augmentation.examples import Examples as Examples
from verifai_jax.augmentation.result import Augmentation as Augmentation
from verifai_jax.augmentation.task import SupervisedTask as SupervisedTask
from verifai_jax.augmentation.task import TaskError as TaskError
from verifai_jax.augmentation.transformations import brightness as brightness
from verifai_jax.augmentation.transformations import combine as combine
from verifai_jax.augmentation.transformations import contrast as contrast
from verifai_jax.augmentation.transformations import flip as flip
from verifai_jax.augmentation.transformations import shift as shift

__all__ = [
    "ARMS",
    "Augmentation",
    "Examples",
    "SupervisedTask",
    "TaskError",
    "augment",
    "brightness",
    "combine",
    "contrast",
    "flip",
    "shift",
]


def __dir__() -> list[str]:
    return list(__all__)
