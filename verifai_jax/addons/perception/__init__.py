"""A differentiable camera, and small networks for its images.

`abstract` falsifies a loop with such a network compositionally. It uses `vj.falsify`, so its
folder, `compositional`, is imported on first use.
"""

from typing import Any

from verifai_jax.addons.perception._detector import (
    Detection,
    Detector,
    DetectorFileError,
    detector,
    load_detector,
    save_detector,
)
from verifai_jax.addons.perception.camera import Camera, facing
from verifai_jax.addons.perception.conditions import Conditions
from verifai_jax.addons.perception.ground import Cross, Disc, Ground, Line, Rectangle, Ring
from verifai_jax.addons.perception.light import Sky, Sun, hsv
from verifai_jax.addons.perception.mujoco import mujoco_camera, mujoco_scene
from verifai_jax.addons.perception.scene import Scene
from verifai_jax.addons.perception.solids import Box, Cone, Cylinder, Sphere
from verifai_jax.addons.perception.training import Labels, Score, losses_of, score, train_detector
from verifai_jax.core.display.lazy import lazy_import

__all__ = [
    "Box", "Camera", "Compositional", "Conditions", "Cone", "Cross", "Cylinder", "Detection",
    "Detector", "DetectorFileError", "Disc", "Ground", "Labels", "Line", "Rectangle", "Ring",
    "Scene", "Score", "Sky", "Sphere", "Sun", "abstract", "detector", "facing", "hsv",
    "load_detector", "losses_of", "mujoco_camera", "mujoco_scene", "save_detector", "score",
    "train_detector",
]  # fmt: skip
# Given by `__getattr__`.
Compositional: Any
abstract: Any


def __getattr__(name: str) -> Any:
    if name in ("Compositional", "abstract"):
        return lazy_import("verifai_jax.addons.perception.compositional", name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return list(__all__)
