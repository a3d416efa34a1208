"""The camera for MuJoCo models: their geoms as solids, their cameras as ours.

    scene = mujoco_scene(model, data)                         # MjModel; MjData or mjx.Data
    camera = mujoco_camera(model, data, "eye", height=24, width=48)
    image = scene.render(camera)                              # traced with an mjx.Data

Only `geom_xpos`, `geom_xmat`, `cam_xpos` and `cam_xmat` of the data are read, so any object with
these arrays will do.
"""

import math
from typing import Protocol

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from verifai_jax.addons.perception.camera import Camera
from verifai_jax.addons.perception.ground import Ground
from verifai_jax.addons.perception.light import Sky, Sun
from verifai_jax.addons.perception.scene import Scene
from verifai_jax.addons.perception.solids import Box, Cylinder, Solid, Sphere
from verifai_jax.core.messages.errors import missing_name

PLANE, SPHERE, CAPSULE, CYLINDER, BOX = 0, 2, 3, 5, 6
"""Values of `mjtGeom`."""
NAMES = {1: "hfield", 4: "ellipsoid", 7: "mesh", 8: "sdf"}
"""Geoms that cannot be drawn."""


class Model(Protocol):
    """The fields of an `MjModel` that are used."""

    geom_type: Int[np.ndarray, " geoms"]
    geom_size: Float[np.ndarray, "geoms 3"]
    geom_rgba: Float[np.ndarray, "geoms 4"]
    cam_fovy: Float[np.ndarray, " cameras"]
    ncam: int
    ngeom: int

    def geom(self, number: int) -> object: ...
    def camera(self, number: int) -> object: ...


class Data(Protocol):
    """The fields of an `MjData` or an `mjx.Data` that are used."""

    geom_xpos: Float[Array, "geoms 3"] | np.ndarray
    geom_xmat: Float[Array, "geoms ..."] | np.ndarray
    cam_xpos: Float[Array, "cameras 3"] | np.ndarray
    cam_xmat: Float[Array, "cameras ..."] | np.ndarray


def mujoco_scene(
    model: Model, data: Data, *, sky: Sky | None = None, sun: Sun | None = None
) -> Scene:
    """Return the scene of a model's geoms in the state of `data`.

    Boxes, spheres and cylinders are drawn exactly, capsules as a cylinder and two spheres. The
    first plane is the ground, which must be level at z = 0. Invisible geoms and textures are not
    drawn.

    **Raises:** `ValueError` for geoms of other kinds, with their name.
    """
    solids: list[Solid] = []
    ground = None
    positions = jnp.asarray(data.geom_xpos, float)
    axes = jnp.asarray(data.geom_xmat, float).reshape(-1, 3, 3)
    for number in range(model.ngeom):
        kind, size = int(model.geom_type[number]), np.asarray(model.geom_size[number], float)
        colour = tuple(float(part) for part in model.geom_rgba[number][:3])
        if model.geom_rgba[number][3] == 0:
            continue
        if kind == PLANE:
            ground = ground or Ground(colour)
            continue
        if kind not in (SPHERE, CAPSULE, CYLINDER, BOX):
            name = getattr(model.geom(number), "name", "") or f"geom {number}"
            raise ValueError(
                f"{name!r} is a geom of kind {NAMES.get(kind, kind)}; the camera draws only plane, "
                "sphere, capsule, cylinder, box"
            )
        solids += _solids(kind, positions[number], axes[number], size, colour)
    return Scene(tuple(solids), ground, sky or Sky(), sun or Sun())


def _solids(
    kind: int, position: Float[Array, "3"], axes: Float[Array, "3 3"], size: np.ndarray,
    colour: tuple[float, ...],
) -> list[Solid]:  # fmt: skip
    """Return one geom as solids; ours stand on their position, MuJoCo's are about theirs."""
    if kind == SPHERE:
        return [Sphere(position, size[0], colour)]
    if kind == BOX:
        under = position - axes[:, 2] * size[2]
        return [Box(under, tuple(2 * size), colour, rotation=axes)]
    foot, tip = position - axes[:, 2] * size[1], position + axes[:, 2] * size[1]
    solids: list[Solid] = [Cylinder(foot, size[0], 2 * size[1], colour, axes[:, 2])]
    if kind == CAPSULE:
        solids += [Sphere(foot, size[0], colour), Sphere(tip, size[0], colour)]
    return solids


def mujoco_camera(model: Model, data: Data, name: str, height: int = 24, width: int = 48) -> Camera:
    """Return a camera of a model in the state of `data`.

    **Raises:** `UnknownNameError` for a camera that the model does not have.
    """
    names = [getattr(model.camera(number), "name", "") for number in range(model.ncam)]
    if name not in names:
        raise missing_name("the model", "camera", name, names)
    number = names.index(name)
    half = math.tan(math.radians(float(model.cam_fovy[number])) / 2) * width / height
    # The axes of MuJoCo's cameras are right, up and backwards.
    axes = jnp.asarray(data.cam_xmat[number], float).reshape(3, 3) * jnp.asarray([1.0, -1.0, -1.0])
    position = jnp.asarray(data.cam_xpos[number], float)
    return Camera(height, width, 2 * math.atan(half), position, rotation=axes)
