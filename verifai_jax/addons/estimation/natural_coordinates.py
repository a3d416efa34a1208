"""Steps in the coordinates in which the features themselves move.

    slopes = natural_slopes(z, gradient, uniform)   # by natural coordinates
    z = move_naturally(z, steps, uniform)           # steps in natural coordinates

A simulation depends smoothly on its features. A normal feature is linear in normal space, a uniform
one in the unit cube; in these coordinates Newton steps are accurate. In normal space a uniform
feature is strongly curved near the ends of its interval, where it hardly changes. So the natural
coordinate is that of normal space or, for a uniform feature, its position in the cube in units of
its standard deviation.

Source: Nocedal and Wright, Numerical Optimization (2006), section 19.2, for steps that go no more
than a fraction of the way to a boundary.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import ndtr, ndtri

WIDTH = np.sqrt(12.0)
"""Width of the unit interval in standard deviations of the uniform distribution."""
NEAREST_FACE = 0.01
"""Part of the way to an end of the interval that a step leaves, at least."""
_MIN_DENSITY = 1e-300


def natural_slopes(
    z: Float[np.ndarray, "n d"], gradient: Float[np.ndarray, "n d"], uniform: Bool[np.ndarray, " d"]
) -> Float[np.ndarray, "n d"]:
    """Convert derivatives from coordinates of normal space to natural coordinates.

    **Arguments:**
    - `gradient`: the gradient at these points.
    - `uniform`: True at coordinates of a uniform feature.
    """
    density = np.exp(-z * z / 2) / np.sqrt(2 * np.pi)
    return np.where(uniform, gradient / np.maximum(WIDTH * density, _MIN_DENSITY), gradient)


def move_naturally(
    z: Float[np.ndarray, "n d"], steps: Float[np.ndarray, "n d"], uniform: Bool[np.ndarray, " d"]
) -> Float[np.ndarray, "n d"]:
    """Move points of normal space by steps in natural coordinates.

    A uniform feature stays within its interval: a step never reaches the end.
    """
    if not uniform.any():
        return z + steps
    # Measured from the nearer end, where the distance is known to all digits.
    side = np.where(z > 0, -1.0, 1.0)
    begin = np.maximum(ndtr(-np.abs(z)), _MIN_DENSITY)
    end = begin + side * steps / WIDTH
    end = np.clip(end, NEAREST_FACE * begin, 1 - NEAREST_FACE * (1 - begin))
    return np.where(uniform, side * ndtri(end), z + steps)
