"""Sine and cosine of one angle together, in straight-line code.

XLA's own `sin` and `cos` carry a range reduction for huge arguments through every lane; in a
pendulum's equations of motion they cost more than everything else together.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float


class _Coefficients(NamedTuple):
    """The numbers of one precision.

    - `half_pi`: pi / 2 in parts. All but the last have so few bits that their products with a
      quadrant number are exact, also where multiplication and subtraction are not fused (Cody and
      Waite, Software Manual for the Elementary Functions, 1980).
    - `largest`: the greatest angle, whose quadrant number is below 2^16, or 2^20 in float64.
    - `shift`: 1.5 times the power of two from which on all numbers are whole: the last bits of
      its sum with a whole number are those of the whole number.
    - `sine`, `cosine`: minimax polynomials on [-pi/4, pi/4].
    """

    half_pi: tuple[Any, ...]
    largest: Any
    shift: Any
    sine: tuple[Any, ...]
    cosine: tuple[Any, ...]

    @classmethod
    def of(cls, dtype: Any, *groups: tuple[float, ...]) -> "_Coefficients":
        half_pi, (largest, shift), *more = [tuple(map(dtype, group)) for group in groups]
        return cls(half_pi, largest, shift, *more)


# Parts of pi / 2 of eight bits; polynomials by S. Moshier, Cephes 2.2, sinf.c.
_SINGLE = _Coefficients.of(
    np.float32,
    (1.5703125, 4.825592041015625e-4, 1.2665987014770508e-6, 9.92093629470503e-10),
    (1e5, 1.5 * 2**23),
    (-1.6666654611e-1, 8.3321608736e-3, -1.9515295891e-4),
    (4.166664568298827e-2, -1.388731625493765e-3, 2.44331571e-5),
)
# Parts of 33 bits, of Sun's fdlibm, e_rem_pio2.c; polynomials of Cephes 2.2, sin.c.
_DOUBLE = _Coefficients.of(
    np.float64,
    (
        1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624871116645580e-21,
        8.47842766036889956997e-32,
    ),
    (1e6, 1.5 * 2**52),
    (
        -1.66666666666666307295e-1, 8.33333333332211858878e-3, -1.98412698295895385996e-4,
        2.75573136213857245213e-6, -2.50507477628578072866e-8, 1.58962301576546568060e-10,
    ),
    (
        4.16666666666665929218e-2, -1.38888888888730564116e-3, 2.48015872888517045348e-5,
        -2.75573141792967388112e-7, 2.08757008419747316778e-9, -1.13585365213876817300e-11,
    ),
)  # fmt: skip
_NUMBERS = {np.dtype(np.float32): _SINGLE, np.dtype(np.float64): _DOUBLE}


@jax.custom_jvp
def sin_cos(
    angle: Float[Array, "*shape"] | Float[np.ndarray, "*shape"] | float,
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """Return `(sin(angle), cos(angle))`, faster than two calls.

    **Arguments:**
    - `angle`: in radians, of any shape.
    **Returns:** values with an error of at most 1.2e-7 for angles up to 1e5, NaN beyond; in float64
    at most 2.3e-16 for angles up to 1e6; in any other precision those of `jnp.sin` and `jnp.cos`.
    """
    angle = jnp.asarray(angle)
    numbers = _NUMBERS.get(np.dtype(angle.dtype))
    if numbers is None:
        return jnp.sin(angle), jnp.cos(angle)
    own = angle.dtype.type
    quadrant = jnp.round(angle * own(2 / np.pi))
    rest = angle
    for part in numbers.half_pi:
        rest = rest - quadrant * part
    # A diverged simulation must not look like a bounded one.
    rest = jnp.where(jnp.abs(angle) <= numbers.largest, rest, own(np.nan))
    square = rest * rest
    sine = rest + rest * square * _polynomial(numbers.sine, square)
    cosine = 1 - own(0.5) * square + square * square * _polynomial(numbers.cosine, square)
    # A conversion would look for what no integer holds; beyond `largest` all is NaN in any case.
    bits = np.dtype(f"int{8 * angle.dtype.itemsize}")
    turn = jax.lax.bitcast_convert_type(quadrant + numbers.shift, bits)
    swapped = (turn & 1) != 0
    sin = jnp.where(swapped, cosine, sine)
    cos = jnp.where(swapped, sine, cosine)
    sin = jnp.where((turn & 2) != 0, -sin, sin)
    cos = jnp.where(((turn + 1) & 2) != 0, -cos, cos)
    return sin, cos


@sin_cos.defjvp
def _sin_cos_jvp(primals: tuple[ArrayLike], tangents: tuple[ArrayLike]) -> Any:
    sin, cos = sin_cos(*primals)
    return (sin, cos), (cos * tangents[0], -sin * tangents[0])


def _polynomial(coefficients: tuple[Any, ...], x: Array) -> Array:
    value: Any = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        value = coefficient + x * value
    return value
