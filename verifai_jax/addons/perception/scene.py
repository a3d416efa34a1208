"""A scene of primitives, rendered.

    scene = Scene(
        solids=(Box((20.0, 0.0, 0.0), (4.5, 1.8, 0.8)), Cone((15.0, 1.0, 0.0), 0.2, 0.75)),
        ground=Ground(markings=(Line((0.0, 1.75)), Line((0.0, -1.75)))),
    )
    image = scene.render(Camera(24, 48), Conditions(fog=0.01))        # (24, 48, 3), in [0, 1]
    depth = scene.depth(Camera(24, 48))                               # (24, 48), in m

A scene is a pytree of numbers: any of them may be traced, batched by `jax.vmap`, differentiated.
Solids hide each other by their depth in each pixel, whatever their order; the ground hides nothing.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Key

from verifai_jax.addons.perception.camera import (
    Camera,
    Rays,
    computed_once,
    coverage,
    described,
    vector,
)
from verifai_jax.addons.perception.conditions import Conditions, in_fog, taken, transmission
from verifai_jax.addons.perception.ground import (
    NEAREST_FALL,
    Cross,
    Disc,
    Ground,
    Line,
    Rectangle,
    Ring,
    painted,
)
from verifai_jax.addons.perception.light import Sky, Sun
from verifai_jax.addons.perception.solids import Box, Cone, Cylinder, Look, Solid, Sphere, look

KINDS = (Box, Cone, Cylinder, Sphere)


@described
class Scene:
    """Solids on a ground, under a sky.

    - `solids`: boxes, cones, cylinders, spheres.
    - `ground`: the plane z = 0 with its markings; with None there is sky in all directions.
    - `sky`, `sun`: colours and light.
    """

    solids: tuple[Solid, ...] = ()
    ground: Ground | None = Ground()
    sky: Sky = Sky()
    sun: Sun = Sun()

    def render(
        self, camera: Camera, conditions: Conditions | None = None,
        key: Key[Array, ""] | None = None, lens: Key[Array, ""] | None = None,
    ) -> Float[Array, "height width 3"]:  # fmt: skip
        """Return the image taken by a camera.

        **Arguments:**
        - `camera`: the camera, which must be above the ground.
        - `conditions`: weather, lens and sensor; None for a clear day and a perfect camera.
        - `key`: the key of random effects that differ between frames (noise, rain).
        - `lens`: the key of random effects of the lens (dirt, dead pixels).
        **Returns:** red, green and blue in [0, 1].
        **Raises:** `ValueError` that names what does not fit.
        """
        conditions = check_scene(self, camera, conditions)
        rays = camera.rays()
        looks = self._looks(rays, self.sun.shadows and self.ground is not None)
        image = self._background(rays, conditions, looks)
        if self.solids:
            image = self._composed(rays, conditions, looks, image)
        return jnp.moveaxis(taken(jnp.stack(image), conditions, key, lens), 0, -1)

    def depth(self, camera: Camera) -> Float[Array, "height width"]:
        """Return the distance in m along the optical axis of the surface in each pixel.

        It is infinite for the sky. A pixel of which solids cover less than half shows what is
        behind them.
        """
        check_scene(self, camera, None)
        rays = camera.rays()
        depth = jnp.full((camera.height, camera.width), jnp.inf)
        if self.ground is not None:
            fall = jnp.broadcast_to(rays.rises(), depth.shape)
            depth = jnp.where(fall < 0, -rays.eye[2] / jnp.minimum(fall, -1e-9), depth)
        for seen in self._looks(rays, shadows=False):
            nearest = jnp.min(jnp.where(seen.cover > 0.5, seen.depth, jnp.inf), axis=0)
            depth = jnp.minimum(depth, nearest)
        return depth

    def _kinds(self) -> list[list[Solid]]:
        """Return the solids of each kind."""
        groups = [[solid for solid in self.solids if type(solid) is kind] for kind in KINDS]
        return [group for group in groups if group]

    def _looks(self, rays: Rays, shadows: bool) -> list[Look]:
        return [look(rays, group, self.sun, shadows) for group in self._kinds()]

    def _background(self, rays: Rays, conditions: Conditions, looks: list[Look]) -> list[Array]:
        """Return the three channels of sky and ground."""
        shape = (rays.v.size, rays.u.size)
        rises = rays.rises()
        # The root has a finite slope everywhere: what is below the horizon has none.
        up = jnp.sqrt(jnp.clip(rises / rays.lengths()[:, : rises.shape[1]], 1e-6, 1.0))
        horizon, zenith = vector(self.sky.horizon), vector(self.sky.zenith)
        # The fog before the horizon is as thick as the ground's is there.
        through = transmission(conditions, 30.0 / jnp.maximum(up, 1e-2))
        sky = [
            in_fog(conditions, k, horizon[k] + (zenith[k] - horizon[k]) * up, through)
            for k in range(3)
        ]
        if self.ground is None:
            return [jnp.broadcast_to(channel, shape) for channel in sky]
        sunlit = self.sun.light(jnp.asarray([0.0, 0.0, 1.0]))
        light = sunlit
        shadows = [row for seen in looks if seen.shadow is not None for row in seen.shadow]
        if shadows:
            lit = jnp.ones(())
            for shadow in shadows:
                lit = lit * (1 - shadow)
            light = self.sun.ambient + (sunlit - self.sun.ambient) * lit
        colour = vector(self.ground.colour)
        light = computed_once(light)
        ground = [colour[k] for k in range(3)]
        for marking in self.ground.markings:
            cover, paint = computed_once((painted(rays, marking), vector(marking.colour)))
            ground = [below + (paint[k] - below) * cover for k, below in enumerate(ground)]
        distance = rays.eye[2] / jnp.maximum(-rises, NEAREST_FALL)
        through = transmission(conditions, distance)
        below = _below_horizon(rays)
        return [
            jnp.broadcast_to(
                sky[k] + (in_fog(conditions, k, ground[k] * light, through) - sky[k]) * below, shape
            )
            for k in range(3)
        ]

    def _composed(
        self, rays: Rays, conditions: Conditions, looks: list[Look], image: list[Array]
    ) -> list[Array]:
        """Lay the solids over the background, each hidden by what is nearer."""
        cover = jnp.concatenate([seen.cover for seen in looks])
        depth = jnp.concatenate([seen.depth for seen in looks])
        light = jnp.concatenate([seen.light for seen in looks])
        centre = jnp.concatenate([seen.centre for seen in looks])
        colours = jnp.stack([vector(solid.colour) for group in self._kinds() for solid in group])
        # Where surfaces coincide, the first one shows.
        depth = depth * (1 + 1e-6 * jnp.arange(len(depth))[:, None, None])
        cover, depth, light, image = computed_once((cover, depth, light, image))
        visible, free = cover, jnp.ones(())
        for j in range(len(self.solids)):
            nearer = jax.lax.stop_gradient(depth[j] < depth)
            visible = visible * (1 - cover[j] * nearer)
            free = free * (1 - cover[j])
        through = transmission(
            conditions, jnp.maximum(jnp.sum((centre - rays.eye) * rays.forward, -1), 0.0)
        )
        mixed = []
        for k in range(3):
            shown = colours[:, k, None, None] * light
            seen = in_fog(conditions, k, shown, None if through is None else through[:, None, None])
            mixed.append(image[k] * free + jnp.sum(visible * seen, axis=0))
        return mixed


def _below_horizon(rays: Rays) -> Array:
    """Return the share of each pixel below the horizon."""
    if rays.level:
        slope = jnp.abs(rays.down[2]) / rays.focal
        return coverage(-rays.rises() / jnp.maximum(slope, 1e-6))
    return coverage(-rays.pixels(jnp.asarray([0.0, 0.0, 1.0])))


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

    **Raises:** `ValueError` or `TypeError` with the description, its field and the allowed values.
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
