"""Sobol' sequences: points spread evenly over the dyadic boxes of the cube.

Point i is the sum over the set bits of the Gray code of i, without carry, of direction numbers
(Sobol' 1967; Antonov, Saleev 1979), with the primitive polynomials and initial numbers of Joe, Kuo,
Constructing Sobol' sequences with better two-dimensional projections, SIAM J. Sci. Comput. 30,
2008, as SciPy ships them. Scrambled by random lower triangular matrices and a digital shift
(Matousek, On the L2-discrepancy for anchored boxes, J. Complexity 14, 1998), which keeps their
evenness and makes each point uniform on the cube.
"""

import importlib.util
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key, UInt32

from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Asked, PointSequence

BITS = 32
"""Bits of the index of a point: JAX has no wider integers by default."""
MAX_DIMENSIONS = 21201
"""Coordinates for which direction numbers are known: those of Joe and Kuo, which SciPy has."""


class SobolState(NamedTuple):
    directions: UInt32[Array, "bits d"]
    shift: UInt32[Array, " d"]
    index: UInt32[Array, ""]


@dataclass(frozen=True)
class Sobol(PointSequence[SobolState]):
    """The Sobol' sequence from index 0; the same for any batch size.

    The first `2^k` points, and every further `2^k`, are evenly distributed. Without scrambling the
    first point is the corner at the origin; leaving it out would destroy the evenness (Owen, On
    dropping the first Sobol' point, 2022).

    **Arguments:**
    - `scramble`: whether to scramble at random (from the key). `False` gives the plain sequence,
      which does not depend on the key.
    **Raises:** `ValueError` for a `scramble` that is neither True nor False. `check` raises it for
    more coordinates than there are direction numbers.
    """

    scramble: bool = True

    def __post_init__(self) -> None:
        if not isinstance(self.scramble, bool):
            raise ValueError(f"scramble must be True or False; got {self.scramble!r}")

    def check(self, cube: Cube) -> None:
        """Raise `ValueError` for more than 21201 coordinates."""
        if cube.dim > MAX_DIMENSIONS:
            raise ValueError(
                f"search sobol works on at most {MAX_DIMENSIONS} unit coordinates; this space has "
                f"{cube.dim}. Use 'uniform'"
            )

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> SobolState:
        directions = jnp.asarray(direction_numbers(cube.dim))
        shift = jnp.zeros(cube.dim, jnp.uint32)
        if self.scramble:
            # Drawn flat, which compiles ten times as fast.
            random = jax.random.bits(key, ((BITS + 1) * cube.dim,), jnp.uint32)
            random = random.reshape(BITS + 1, cube.dim)
            directions, shift = _scramble(directions, random[1:]), random[0]
        return SobolState(directions, shift, jnp.uint32(0))

    def ask(self, state: SobolState, cube: Cube, batch: int) -> Asked[SobolState]:
        index = state.index + jnp.arange(batch, dtype=jnp.uint32)
        gray = (index ^ (index >> 1))[:, None]
        digits = jnp.broadcast_to(state.shift, (batch, cube.dim))
        for k in range(BITS):
            digits ^= ((gray >> k) & 1) * state.directions[k]
        # A float32 in [0, 1) holds 24 digits.
        u = (digits >> 8).astype(jnp.float32) * np.float32(2**-24)
        return u, state._replace(index=state.index + batch)


@lru_cache(maxsize=8)
def direction_numbers(dim: int) -> UInt32[np.ndarray, "bits dim"]:
    """Compute direction numbers of `dim` coordinates; the binary point is before the first bit."""
    polynomials, initial = _joe_kuo()
    numbers = np.zeros((BITS, dim), np.uint32)
    for j in range(dim):
        polynomial = int(polynomials[j])
        degree = polynomial.bit_length() - 1
        # The first coordinate is the van der Corput sequence: all its numbers are 1.
        m = [1] * BITS if j == 0 else [int(number) for number in initial[j, :degree]]
        for k in range(len(m), BITS):
            number = m[k - degree] ^ (m[k - degree] << degree)
            for i in range(1, degree):
                if polynomial >> (degree - i) & 1:
                    number ^= m[k - i] << i
            m.append(number)
        numbers[:, j] = [number << (BITS - 1 - k) for k, number in enumerate(m)]
    numbers.setflags(write=False)
    return numbers


@lru_cache(maxsize=1)
def _joe_kuo() -> tuple[np.ndarray, np.ndarray]:
    """Load primitive polynomials and initial numbers from SciPy's file; an import takes longer."""
    scipy = importlib.util.find_spec("scipy")
    assert scipy is not None, "JAX depends on SciPy"
    with np.load(Path(str(scipy.origin)).parent / "stats/_sobol_direction_numbers.npz") as file:
        return file["poly"], file["vinit"]


def _scramble(
    directions: UInt32[Array, "bits d"], random: UInt32[Array, "bits d"]
) -> UInt32[Array, "bits d"]:
    """Multiply direction numbers by a random lower triangular bit matrix for each coordinate."""
    digit = np.arange(BITS, dtype=np.uint32)
    own = (np.uint32(1) << (BITS - 1 - digit))[:, None]
    # Each digit is flipped by random ones of the digits before it, and keeps itself.
    before = (np.uint64(2**32) - 2 * own.astype(np.uint64)).astype(np.uint32)
    rows = (random & before) | own
    parity = jax.lax.population_count(rows[:, None] & directions[None]) & 1
    return jnp.sum(parity * own[:, None], axis=0, dtype=jnp.uint32)
