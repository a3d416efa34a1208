"""Sun, sky and colours.

Sun(azimuth=0.5, elevation=0.9, ambient=0.5)
hsv(0.08, 0.9, 0.9)                                       # orange
"""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from verifai_jax.addons.perception.camera import STATIC, Number, Vector, described, dot


@described
class Sun:
    """Directional light, and ambient light.

    - `azimuth`: direction towards the sun in rad, counterclockwise from the x axis.
    - `elevation`: elevation above the horizon in rad.
    - `ambient`: share of ambient light; a surface facing the sun has brightness 1, one in shadow
      this share.
    - `shadows`: whether solids cast shadows on the ground.
    """

    azimuth: Number = 0.7
    elevation: Number = 0.9
    ambient: Number = 0.55
    shadows: bool = dataclasses.field(default=True, metadata=STATIC)

    def direction(self) -> Float[Array, "3"]:
        """Return the unit vector towards the sun."""
        azimuth, elevation = jnp.asarray(self.azimuth, float), jnp.asarray(self.elevation, float)
        across = jnp.cos(elevation)
        return jnp.stack([across * jnp.cos(azimuth), across * jnp.sin(azimuth), jnp.sin(elevation)])

    def lit(self, cosine: Array) -> Array:
        """Return the light of a surface whose normal has this cosine with the sun's direction."""
        return self.ambient + (1 - jnp.asarray(self.ambient, float)) * jnp.maximum(cosine, 0.0)

    def light(self, normal: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
        """Return the light of surfaces with these normals (Lambert's law)."""
        return self.lit(dot(normal, self.direction()))


@described
class Sky:
    """A sky between two colours: `horizon`, and `zenith` overhead."""

    horizon: Vector = (0.78, 0.85, 0.92)
    zenith: Vector = (0.35, 0.55, 0.85)


def hsv(hue: Number, saturation: Number = 1.0, value: Number = 1.0) -> Float[Array, "3"]:
    """Return the red, green and blue of a hue in [0, 1): 0 red, 1/3 green, 2/3 blue."""
    around = jnp.asarray(hue, float) + jnp.asarray([0.0, -1 / 3, 1 / 3])
    pure = jnp.clip(jnp.abs((around - jnp.floor(around)) * 6 - 3) - 1, 0.0, 1.0)
    return value * (1 - saturation * (1 - pure))
