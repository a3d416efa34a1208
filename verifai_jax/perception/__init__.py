"""A differentiable camera, and small networks that look through it."""

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
from verifai_jax.perception.scene import Scene as Scene
from verifai_jax.perception.solids import Box as Box
from verifai_jax.perception.solids import Cone as Cone
from verifai_jax.perception.solids import Cylinder as Cylinder
from verifai_jax.perception.solids import Sphere as Sphere

__all__ = [
    "Box",
    "Camera",
    "Conditions",
    "Cone",
    "Cross",
    "Cylinder",
    "Disc",
    "Ground",
    "Line",
    "Rectangle",
    "Ring",
    "Scene",
    "Sky",
    "Sphere",
    "Sun",
    "facing",
    "hsv",
]


def __dir__() -> list[str]:
    return list(__all__)
