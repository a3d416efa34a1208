"""Weather, lens and sensor: the effects between a scene and its image.

    Conditions(fog=0.02, brightness=0.7, blur=0.8)
    Conditions(rain=0.6, glare=0.5, glare_at=(0.7, 0.2), noise=0.02, dead=0.01, dirt=0.4)

A field that is None costs nothing. Blur is a product with two band matrices; glare, rain and dirt
are products of rows and columns. Sums of shifted images are avoided, because XLA would fuse them
with the rendering and compute it once for each shift.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree

from verifai_jax.addons.perception.camera import Number, Vector, described, vector

LUMINANCE = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in ITU-R BT.601."""
DROPS = 24
SPOTS = 12


@described
class Conditions:
    """Weather, lens and sensor.

    - `fog`: extinction in 1/m: an object at d metres keeps `exp(-fog d)` of its contrast.
    - `fog_colour`: red, green and blue.
    - `rain`: opacity in [0, 1] of streaks, whose positions differ in each frame.
    - `glare`: strength of a bright spot at `glare_at`, `(across, down)` in [0, 1], whose size is
      `glare_size` of the image's height.
    - `dirt`: opacity in [0, 1] of spots on the lens, at the same positions in all frames.
    - `blur`: standard deviation in pixels.
    - `brightness`, `contrast`, `saturation`: factors; 1 has no effect.
    - `noise`: standard deviation of each channel of each pixel.
    - `dead`: share of black pixels, the same ones in all frames with a lens.
    """

    fog: Number = None
    fog_colour: Vector = (0.75, 0.77, 0.8)
    rain: Number = None
    glare: Number = None
    glare_at: PyTree = (0.5, 0.3)
    glare_size: Number = 0.25
    dirt: Number = None
    blur: Number = None
    brightness: Number = None
    contrast: Number = None
    saturation: Number = None
    noise: Number = None
    dead: Number = None


def transmission(conditions: Conditions, distance: Array) -> Array | None:
    """Return the share of light transmitted by the fog; None without fog."""
    if conditions.fog is None:
        return None
    return jnp.exp(-jnp.asarray(conditions.fog, float) * distance)


def in_fog(conditions: Conditions, channel: int, seen: Array, through: Array | None) -> Array:
    """Mix a channel with the fog's colour."""
    if through is None:
        return seen
    fog = vector(conditions.fog_colour)[channel]
    return fog + (seen - fog) * through


def taken(
    image: Float[Array, "3 height width"], conditions: Conditions, key: Key[Array, ""] | None,
    lens: Key[Array, ""] | None,
) -> Float[Array, "3 height width"]:  # fmt: skip
    """Return the image that a sensor with a lens records of `image`, in [0, 1].

    **Arguments:**
    - `image`: colours of the scene.
    - `conditions`: the conditions, except fog, which is part of the scene.
    - `key`: the key of random effects that differ between frames: noise and rain.
    - `lens`: the key of random effects of the lens and the sensor: dirt and dead pixels.
    """
    _, height, width = image.shape
    if conditions.rain is not None:
        drops = _streaks(_needed(key, "rain", "key"), height, width)
        image = image + jnp.asarray(conditions.rain, float) * drops * (0.85 - image)
    if conditions.glare is not None:
        across, down = vector(conditions.glare_at)
        size = jnp.asarray(conditions.glare_size, float) * height
        rows = _bell(jnp.arange(height) + 0.5 - down * height, size)
        columns = _bell(jnp.arange(width) + 0.5 - across * width, size)
        image = image + jnp.asarray(conditions.glare, float) * rows[:, None] * columns
    if conditions.dirt is not None:
        spots = _spots(_needed(lens, "dirt", "lens"), height, width)
        image = image + jnp.asarray(conditions.dirt, float) * spots * (0.2 - image)
    if conditions.blur is not None:
        image = blurred(image, conditions.blur)
    if conditions.brightness is not None:
        image = image * jnp.asarray(conditions.brightness, float)
    if conditions.contrast is not None:
        mean = jnp.mean(_luminance(image))
        image = mean + (image - mean) * jnp.asarray(conditions.contrast, float)
    if conditions.saturation is not None:
        grey = _luminance(image)
        image = grey + (image - grey) * jnp.asarray(conditions.saturation, float)
    if conditions.noise is not None:
        noise = jax.random.normal(_needed(key, "noise", "key"), image.shape)
        image = image + jnp.asarray(conditions.noise, float) * noise
    if conditions.dead is not None:
        drawn = jax.random.uniform(_needed(lens, "dead", "lens"), (height, width))
        image = jnp.where(drawn < jnp.asarray(conditions.dead, float), 0.0, image)
    return jnp.clip(image, 0.0, 1.0)


def _needed(key: Key[Array, ""] | None, effect: str, argument: str) -> Key[Array, ""]:
    if key is None:
        raise ValueError(
            f"Conditions({effect}=...) is drawn at random and needs a key: render(..., "
            f"{argument}=jax.random.key(0))"
        )
    # Noise and rain, or dirt and dead pixels, have keys of their own.
    return jax.random.fold_in(key, {"noise": 0, "rain": 1, "dirt": 0, "dead": 1}[effect])


def _luminance(image: Float[Array, "3 *pixels"]) -> Float[Array, "1 *pixels"]:
    return sum(weight * image[k : k + 1] for k, weight in enumerate(LUMINANCE))  # pyright: ignore


def _bell(offset: Array, size: Array) -> Array:
    return jnp.exp(-0.5 * (offset / size) ** 2)


def blurred(image: Float[Array, "3 height width"], sigma: Number) -> Float[Array, "3 height width"]:
    """Blur an image with a Gaussian of standard deviation `sigma`, in pixels."""
    sigma = jnp.maximum(jnp.asarray(sigma, float), 0.05)

    def kernel(pixels: int) -> Array:
        positions = jnp.arange(pixels, dtype=image.dtype)
        weights = _bell(positions[:, None] - positions, sigma)
        return weights / jnp.sum(weights, axis=1, keepdims=True)

    _, height, width = image.shape
    across = jnp.einsum("chw,vw->chv", image, kernel(width))
    return jnp.einsum("chv,uh->cuv", across, kernel(height))


def _streaks(key: Key[Array, ""], height: int, width: int) -> Float[Array, "height width"]:
    """Return upright streaks of rain: the share of each pixel that they cover."""
    x, y, length = jax.random.uniform(key, (3, DROPS))
    rows = (jnp.arange(height) + 0.5)[:, None]
    columns = (jnp.arange(width) + 0.5)[:, None]
    half = (0.06 + 0.1 * length) * height
    down = jnp.clip(half + 0.5 - jnp.abs(rows - y * height), 0.0, 1.0)
    across = jnp.clip(1.0 - jnp.abs(columns - x * width), 0.0, 1.0)
    return jnp.minimum(down @ across.T, 1.0)


def _spots(key: Key[Array, ""], height: int, width: int) -> Float[Array, "height width"]:
    """Return soft spots of dirt: the share of light that each pixel loses at opacity one."""
    x, y, size = jax.random.uniform(key, (3, SPOTS))
    size = (0.03 + 0.09 * size) * height
    down = _bell((jnp.arange(height) + 0.5)[:, None] - y * height, size)
    across = _bell((jnp.arange(width) + 0.5)[:, None] - x * width, size)
    return jnp.minimum(down @ across.T, 1.0)
