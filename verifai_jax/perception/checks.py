"""Checks of a scene before it is rendered."""

import dataclasses
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from verifai_jax.perception.camera import Camera
from verifai_jax.perception.conditions import Conditions
from verifai_jax.perception.ground import Cross, Disc, Line, Rectangle, Ring
from verifai_jax.perception.solids import Box, Cone, Cylinder, Sphere

VECTORS = {
    "position": 3,
    "colour": 3,
    "axis": 3,
    "horizon": 3,
    "zenith": 3,
    "fog_colour": 3,
    "glare_at": 2,
}
LENGTHS = ("radius", "height", "size", "width", "dash", "field_of_view")
MARKINGS = (Line, Rectangle, Disc, Ring, Cross)
SOLIDS = (Box, Cone, Cylinder, Sphere)


def check_scene(scene: Any, camera: Camera, conditions: Conditions | None) -> Conditions:
    """Check a scene, a camera and conditions; None stands for a clear day.

    **Raises:** `ValueError` or `TypeError` that names the description, its field and what it should
    be.
    """
    conditions = Conditions() if conditions is None else conditions
    if not isinstance(camera, Camera):
        raise TypeError(f"a scene is rendered by a Camera; got {type(camera).__name__}")
    if not isinstance(conditions, Conditions):
        raise TypeError(f"conditions must be Conditions; got {type(conditions).__name__}")
    for number, solid in enumerate(scene.solids):
        if not isinstance(solid, SOLIDS):
            raise TypeError(
                f"solids[{number}] is a {type(solid).__name__}; solids are Box, Cone, Cylinder, "
                "Sphere"
            )
        _check(solid, f"solids[{number}] (a {type(solid).__name__})", 3)
    if scene.ground is not None:
        _check(scene.ground, "the ground", 3)
        for number, marking in enumerate(scene.ground.markings):
            if not isinstance(marking, MARKINGS):
                raise TypeError(
                    f"markings[{number}] is a {type(marking).__name__}; markings are Line, "
                    "Rectangle, Disc, Ring, Cross"
                )
            _check(marking, f"markings[{number}] (a {type(marking).__name__})", 2)
        height = _known(camera.position)
        if height is not None and height.shape == (3,) and height[2] <= 0:
            raise ValueError(
                f"the camera is at a height of {height[2]:zg} m; it must be above the ground, z > 0"
            )
    _check(scene.sky, "the sky", 3)
    _check(camera, "the camera", 3)
    _check(conditions, "the conditions", 3)
    return conditions


def _check(description: Any, name: str, dimensions: int) -> None:
    for field in dataclasses.fields(description):
        value = getattr(description, field.name)
        size = VECTORS.get(field.name)
        if field.name == "position":
            size = dimensions
        if field.name == "size" and isinstance(description, Box | Rectangle):
            size = dimensions
        if size is not None and _shape(value) != (size,):
            raise ValueError(
                f"{field.name} of {name} must have {size} numbers; got shape {_shape(value)}"
            )
        known = _known(value) if field.name in LENGTHS else None
        if known is not None and (known <= 0).any():
            raise ValueError(f"{field.name} of {name} must be positive; got {value}")
        if field.name == "rotation" and value is not None and _shape(value) != (3, 3):
            raise ValueError(f"rotation of {name} must be a matrix (3, 3); got {_shape(value)}")


def _shape(value: Any) -> tuple[int, ...]:
    if isinstance(value, tuple | list):
        return (len(value), *{np.shape(entry) for entry in value}.pop()) if value else (0,)
    return np.shape(value)


def _known(value: Any) -> np.ndarray | None:
    """Return numbers that are not traced; None if any is."""
    leaves = jax.tree.leaves(value)
    if not leaves or any(isinstance(leaf, Tracer) for leaf in leaves):
        return None
    try:
        return np.asarray(leaves if isinstance(value, tuple | list) else value, float)
    except (TypeError, ValueError):
        return None
