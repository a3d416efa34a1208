"""A differentiable camera, and small networks that look through it.

`abstract` falsifies a loop with such a network compositionally. It stands on `vj.falsify`, so it
lies in the room `compositional`, above this one, and is imported when it is first used.
"""

from typing import Any

from verifai_jax.core.lazy import late
from verifai_jax.perception._detector import Detection as Detection
from verifai_jax.perception._detector import Detector as Detector
from verifai_jax.perception._detector import DetectorFileError as DetectorFileError
from verifai_jax.perception._detector import detector as detector
from verifai_jax.perception._detector import load_detector as load_detector
from verifai_jax.perception._detector import save_detector as save_detector
from verifai_jax.perception.camera import Camera as Camera
from verifai_jax.perception.camera import facing as facing
from verifai_jax.perception.conditions import Conditions as Conditions
from verifai_jax.perception.ground import Cross as Cross
from verifai_jax.perception.ground import Disc as Disc
from verifai_jax.perception.ground import Ground as Ground
from verifai_jax.perception.ground import Line as Line
from verifai_jax.perception.ground import Rectangle as Rectangle
from verifai_jax.perception.ground import Ring as Ring
from verifai_jax.perception.light import Sky as Sky
from verifai_jax.perception.light import Sun as Sun
from verifai_jax.perception.light import hsv as hsv
from verifai_jax.perception.mujoco import mujoco_camera as mujoco_camera
from verifai_jax.perception.mujoco import mujoco_scene as mujoco_scene
from verifai_jax.perception.scene import Scene as Scene
from verifai_jax.perception.solids import Box as Box
from verifai_jax.perception.solids import Cone as Cone
from verifai_jax.perception.solids import Cylinder as Cylinder
from verifai_jax.perception.solids import Sphere as Sphere
from verifai_jax.perception.training import Labels as Labels
from verifai_jax.perception.training import Score as Score
from verifai_jax.perception.training import losses_of as losses_of
from verifai_jax.perception.training import score as score
from verifai_jax.perception.training import train_detector as train_detector

__all__ = [
    "Box",
    "Camera",
    "Compositional",
    "Conditions",
    "Cone",
    "Cross",
    "Cylinder",
    "Detection",
    "Detector",
    "DetectorFileError",
    "Disc",
    "Ground",
    "Labels",
    "Line",
    "Rectangle",
    "Ring",
    "Scene",
    "Score",
    "Sky",
    "Sphere",
    "Sun",
    "abstract",
    "detector",
    "facing",
    "hsv",
    "load_detector",
    "losses_of",
    "mujoco_camera",
    "mujoco_scene",
    "save_detector",
    "score",
    "train_detector",
]

# Given by `__getattr__`.
Compositional: Any
abstract: Any


def __getattr__(name: str) -> Any:
    if name in ("Compositional", "abstract"):
        return late("verifai_jax.compositional", name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return list(__all__)
