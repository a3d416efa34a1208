"""The Halton sequence: points that fill the cube more evenly than random ones.

Coordinate j of point i is the radical inverse of i in the j-th prime base: the digits of i,
mirrored at the point (Halton 1960, Algorithm 247). In large bases neighbouring coordinates run in
step for many points (in base 47 the first 46 points climb a line), so in many dimensions digits
are permuted at random (Owen, A randomized Halton algorithm in R, 2017), here by affine maps modulo
the base.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, UInt32

from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Asked, PointSequence
from verifai_jax.search.draws import draw_uniform

BITS = 32  # bits of the index of a point: JAX has no wider integers by default
PLAIN_UP_TO = 8
"""Number of bases up to which the sequence is plain: in larger ones lines are visible."""
MAX_IN_LOOP = 2**14
"""Coordinates of points computed in a loop, which compiles in a third of the time; more run ten
times as fast where the loop is written out."""
MAX_SKIPPED_POINTS = 2**31  # maximum number of skipped points, so that as many indices remain
MAX_SKIPPED_BASES = 10_000
"""Maximum number of skipped bases: in bases beyond, which are
over 100 000, the points of most runs have a single digit and lie on a line."""


class HaltonState(NamedTuple):
    key: Key[Array, ""]
    index: UInt32[Array, ""]


@dataclass(frozen=True)
class Halton(PointSequence[HaltonState]):
    """The Halton sequence from index 1; the same for any batch size, up to rounding.

    **Arguments:**
    - `scramble`: whether to permute digits at random (from the key). `False` gives the plain
      sequence, which does not depend on the key. By default it is plain if all bases are among the
      first 8 primes (up to 8 coordinates), and scrambled otherwise.
    - `skip_points`: number of points left out at the start of the sequence; the first one then has
      index `1 + skip_points`. VerifAI calls it `sample_index`.
    - `skip_bases`: number of primes left out; with one, the first coordinate has base 3. VerifAI
      calls it `bases_skipped`.
    **Raises:** `ValueError` for a `scramble` other than True, False and None, or for numbers to
    skip that are not integers, negative or too large.
    """

    scramble: bool | None = None
    skip_points: int = 0
    skip_bases: int = 0

    def __post_init__(self) -> None:
        if self.scramble is not None and not isinstance(self.scramble, bool):
            raise ValueError(f"scramble must be True, False or None; got {self.scramble!r}")
        for name, limit in (("skip_points", MAX_SKIPPED_POINTS), ("skip_bases", MAX_SKIPPED_BASES)):
            count = getattr(self, name)
            check_count(name, count, 0)
            if count > limit:
                raise ValueError(f"{name} must be at most {limit}; got {count!r}")

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> HaltonState:
        return HaltonState(key, jnp.uint32(1 + self.skip_points))

    def ask(self, state: HaltonState, cube: Cube, batch: int) -> Asked[HaltonState]:
        last = self.skip_bases + cube.dim
        scramble = last > PLAIN_UP_TO if self.scramble is None else self.scramble
        index = state.index + jnp.arange(batch, dtype=jnp.uint32)
        u = halton_points(index, cube.dim, state.key if scramble else None, self.skip_bases)
        return u, state._replace(index=state.index + batch)


def halton_points(
    index: UInt32[Array, " n"], dim: int, key: Key[Array, ""] | None = None, skip_bases: int = 0
) -> Float[Array, "n dim"]:
    """Compute points of the Halton sequence by their `index`, in `[0, 1)`.

    **Arguments:**
    - `index`: indices of the points, from 1 on (point 0 is the corner at the origin).
    - `dim`: number of coordinates.
    - `key`: the key of the random permutations of digits; without it the sequence is plain.
    - `skip_bases`: number of primes left out before the base of the first coordinate.
    """
    bases = np.array(primes(skip_bases + dim)[skip_bases:], np.uint32)
    digits = np.array([_digits(int(base)) for base in bases], int)
    maps = None if key is None else _digit_maps(key, bases, int(np.max(digits, initial=0)))
    if len(index) * dim <= MAX_IN_LOOP:
        return _radical_inverse(index, bases, digits, maps, unroll=False)
    blocks = [jnp.zeros((len(index), 0), jnp.float32)]
    # Bases whose indices have equally many digits go together: one loop for many large ones.
    for count in sorted(set(digits.tolist()), reverse=True):
        group = digits == count
        chosen = None if maps is None else (maps[0][:count, group], maps[1][:count, group])
        blocks.append(_radical_inverse(index, bases[group], digits[group], chosen, unroll=True))
    return jnp.concatenate(blocks, axis=1)


def primes(count: int) -> list[int]:
    """Return the first `count` primes."""
    # The n-th prime is below n (log n + log log n) for n >= 6.
    limit = 13 if count < 6 else int(count * (np.log(count) + np.log(np.log(count)))) + 1
    sieve = np.ones(limit + 1, bool)
    sieve[:2] = False
    for p in range(2, int(limit**0.5) + 1):
        if sieve[p]:
            sieve[p * p :: p] = False
    return np.flatnonzero(sieve)[:count].tolist()


def _digits(base: int) -> int:
    """Return the number of digits that an index may have in this base."""
    digits = 1
    while base**digits < 2**BITS:
        digits += 1
    return digits


def _radical_inverse(
    index: UInt32[Array, " n"], bases: UInt32[np.ndarray, " d"], digits: Int[np.ndarray, " d"],
    maps: tuple[UInt32[Array, "digits d"], UInt32[Array, "digits d"]] | None, *, unroll: bool,
) -> Float[Array, "n d"]:  # fmt: skip
    """Mirror the digits of the indices at the point, in a loop or written out (`unroll`)."""
    width = int(np.max(digits, initial=0))
    shape = (len(index), len(bases))

    def divide(rest: Array, digit_map: tuple[Array, Array] | None) -> tuple[Array, Array]:
        quotient = rest // bases
        figure = rest - quotient * bases
        if digit_map is not None:
            figure = (digit_map[0] * figure + digit_map[1]) % bases
        return quotient, figure

    rest = jnp.broadcast_to(index[:, None], shape)
    _, figures = jax.lax.scan(divide, rest, maps, length=width, unroll=unroll)
    # As XLA writes a division by a constant, in which LLVM joins product and sum.
    share = np.float32(1) / bases.astype(np.float32)

    def add(total: Array, step: tuple[Array, Array]) -> tuple[Array, None]:
        figure, there = step
        return jnp.where(there, total * share + figure.astype(jnp.float32), total), None

    # From the lowest digit on (Horner): every rounding error is divided by the base at once.
    there = jnp.asarray(np.arange(width)[:, None] < digits)
    zero = jnp.zeros(shape, jnp.float32)
    total, _ = jax.lax.scan(add, zero, (figures, there), reverse=True, unroll=unroll)
    return jnp.minimum(total * share, np.float32(1 - 2**-24))


def _digit_maps(
    key: Key[Array, ""], bases: UInt32[np.ndarray, " d"], digits: int
) -> tuple[UInt32[Array, "digits d"], UInt32[Array, "digits d"]]:
    """Draw factors in `[1, base)` and shifts in `[0, base)` for every digit of every base."""
    factor, shift = draw_uniform(key, (2, digits, len(bases)))
    return (1 + (factor * (bases - 1)).astype(jnp.uint32), (shift * bases).astype(jnp.uint32))
