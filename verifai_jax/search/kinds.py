"""Regions of failures that a search has described, so that it looks for others.

    kinds = Kinds.nothing(cube.dim)
    kinds = kinds.found(observations)                   # after each round
    kinds.raised(u, rho)                                # what the members of a search learn

A kind is a box of inputs around failures near each other: a failure within `REACH` of a box joins
and extends it, and any other begins a box of its own (the leader algorithm: Hartigan, Clustering
Algorithms, 1975, chapter 3). A box is described once it has `ENOUGH` failures. From then on its
failures count as worse than safe, and safe points the more so the nearer to it they are (deflation,
as in Farrell, Birkisson and Funke, Deflation techniques for finding distinct solutions of nonlinear
partial differential equations, SIAM Journal on Scientific Computing 37(4), 2015).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from verifai_jax.search.base import Observations

# `benchmarks/search_quality.py kinds` measures the effect of these numbers.
ENOUGH = 10
"""Failures that describe a kind."""
REACH = 0.05
"""Root mean square distance over the coordinates, from a box, within which a failure joins it."""
TAPER = 0.15
"""The same distance, at which safe points are no longer worse for being near."""
CAPACITY = 64
"""Boxes at most; then a new one replaces that with the fewest failures, unless all are described.
"""


class Kinds(NamedTuple):
    """The boxes so far.

    - `low`, `high`: the corners of each box.
    - `count`: the number of failures in each; 0 for an empty row.
    - `highest`: the highest robustness observed.
    """

    low: Float[Array, "kinds d"]
    high: Float[Array, "kinds d"]
    count: Int[Array, " kinds"]
    highest: Float[Array, ""]

    @classmethod
    def nothing(cls, d: int) -> "Kinds":
        """Return no boxes, before the first simulation."""
        corner = jnp.zeros((CAPACITY, d), jnp.float32)
        return cls(corner, corner, jnp.zeros(CAPACITY, jnp.int32), jnp.float32(-jnp.inf))

    @property
    def described(self) -> Bool[Array, " kinds"]:
        """True for boxes with enough failures."""
        return self.count >= ENOUGH

    def distances(self, u: Float[Array, "n d"]) -> Float[Array, "n kinds"]:
        """Return root mean square distances from the boxes: 0 inside, infinite for empty rows."""
        gap = jnp.maximum(jnp.maximum(self.low - u[:, None], u[:, None] - self.high), 0.0)
        far = jnp.sqrt(jnp.sum(gap**2, axis=2) / max(u.shape[1], 1))
        return jnp.where(self.count > 0, far, jnp.inf)

    def found(self, observed: Observations) -> "Kinds":
        """Return the boxes after a round, whose failures join them one after the other."""
        failing = observed.usable & (observed.rho < 0)
        order = jnp.argsort(~failing, stable=True)

        def add(i: Int[Array, ""], kinds: "Kinds") -> "Kinds":
            u = observed.u[order[i]]
            far = kinds.distances(u[None])[0]
            joins = jnp.min(far) <= REACH
            row = jnp.where(joins, jnp.argmin(far), jnp.argmin(kinds.count))
            fits = joins | ~kinds.described[row]
            row = jnp.where(fits, row, CAPACITY)
            low = jnp.where(joins, jnp.minimum(kinds.low[row], u), u)
            high = jnp.where(joins, jnp.maximum(kinds.high[row], u), u)
            return kinds._replace(
                low=kinds.low.at[row].set(low, mode="drop"),
                high=kinds.high.at[row].set(high, mode="drop"),
                count=kinds.count.at[row].set(
                    jnp.where(joins, kinds.count[row] + 1, 1), mode="drop"
                ),
            )

        highest = jnp.max(jnp.where(observed.usable, observed.rho, -jnp.inf), initial=-jnp.inf)
        grown = jax.lax.fori_loop(0, jnp.sum(failing), add, self)
        return grown._replace(highest=jnp.maximum(self.highest, highest).astype(jnp.float32))

    def nearness(self, u: Float[Array, "n d"], of: Bool[Array, " kinds"]) -> Float[Array, " n"]:
        """Return 1 in any of these boxes, and 0 from `TAPER` on."""
        far = jnp.min(jnp.where(of, self.distances(u), jnp.inf), axis=1)
        return jnp.clip(1 - far / TAPER, 0.0, 1.0)

    def raised(self, u: Float[Array, "n d"], rho: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return the robustness, raised in and near described boxes, but not of other failures."""
        near = self.nearness(u, self.described)
        near = jnp.where((rho < 0) & (near <= 1 - REACH / TAPER), 0.0, near)
        worst = jnp.maximum(self.highest, 0.0) + 1e-6
        return jnp.where(near > 0, jnp.maximum(rho, 0.0) + worst * near, rho)
