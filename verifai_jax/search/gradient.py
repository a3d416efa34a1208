"""Gradient descent on the smooth robustness, from many starts at once.

Each row of the batch is a descent of its own: Adam (Kingma, Ba, 2015, algorithm 1) with large,
shrinking steps, projected to the cube. Its first steps are the sign of the gradient, which takes
a descent to a corner in a few simulations. A descent that has failed the system, has converged or
has no usable gradient starts again at the next low-discrepancy point; one that has stepped onto a
point without a verdict, or out of the space's constraint, goes halfway back first.
"""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt32

from verifai_jax.search.base import (
    Cube,
    Evaluated,
    Search,
    check_count,
    check_fraction,
    check_positive,
)
from verifai_jax.search.halton import halton_points

BETA1, BETA2, EPSILON = 0.5, 0.9, 1e-12
MOST_RETREATS = 3


class GradientState(NamedTuple):
    key: Key[Array, ""]
    u: Float[Array, "batch d"]
    restart: Bool[Array, " batch"]  # rows that take a new start instead of `u`
    anchor: Float[Array, "batch d"]  # the last point with a verdict
    retreats: Int[Array, " batch"]  # since then
    first: Float[Array, "batch d"]  # moments of the gradient
    second: Float[Array, "batch d"]
    best: Float[Array, " batch"]  # least robustness since the start
    step: Int[Array, " batch"]  # since the start
    stale: Int[Array, " batch"]  # steps without progress
    starts: UInt32[Array, ""]  # how many starts were made
    round: Int[Array, ""]
    scale: Float[Array, ""]  # of the robustness; 0 until a batch shows it


@dataclass(frozen=True)
class Gradient(Search):
    """Multi-start Adam on the smooth robustness; discrete coordinates keep their start's value.

    **Arguments:**

    - `learning_rate`: length of the first step in each unit coordinate.
    - `decay`: factor on the step length from step to step.
    - `least_rate`: step length below which it does not shrink.
    - `hot`, `cold`: temperature of the smooth robustness at first and at last, in units of the
      robustness' spread over the first batch.
    - `cooling`: rounds from `hot` to `cold`, geometrically.
    - `patience`: steps without progress after which a descent starts again elsewhere.

    **Raises:** `ValueError` for values out of range.
    """

    learning_rate: float = 0.25
    decay: float = 0.8
    least_rate: float = 0.01
    hot: float = 0.3
    cold: float = 0.02
    cooling: int = 10
    patience: int = 4
    wants_gradient: ClassVar[bool] = True

    def __post_init__(self) -> None:
        for name in ("learning_rate", "decay", "least_rate"):
            check_fraction(name, getattr(self, name))
        for name in ("hot", "cold"):
            check_positive(name, getattr(self, name))
        check_count("cooling", self.cooling)
        check_count("patience", self.patience)

    def check(self, cube: Cube) -> None:
        """Raise `ValueError` unless there is a continuous coordinate to move in."""
        if cube.dim and len(cube.continuous) == 0:
            raise ValueError(
                f"search gradient needs at least one continuous feature; all {cube.dim} unit "
                "coordinates of this space are discrete. Use 'cross_entropy'"
            )

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> GradientState:
        zeros = jnp.zeros((batch, cube.dim), jnp.float32)
        return GradientState(
            key=key,
            u=zeros,
            restart=jnp.ones(batch, bool),
            anchor=zeros,
            retreats=jnp.full(batch, MOST_RETREATS, jnp.int32),
            first=zeros,
            second=zeros,
            best=jnp.full(batch, jnp.inf, jnp.float32),
            step=jnp.zeros(batch, jnp.int32),
            stale=jnp.zeros(batch, jnp.int32),
            starts=jnp.uint32(0),
            round=jnp.int32(0),
            scale=jnp.float32(0),
        )

    def ask(
        self, state: GradientState, cube: Cube, batch: int
    ) -> tuple[Float[Array, "batch d"], GradientState]:
        index = state.starts + jnp.cumsum(state.restart).astype(jnp.uint32)
        fresh = halton_points(index, cube.dim, state.key)
        # Rows stay marked until they are told of: another `ask` gives them another start.
        u = jnp.where(state.restart[:, None], fresh, state.u)
        return u, state._replace(u=u, starts=index[-1])

    def warm(self, state: GradientState, cube: Cube, evaluated: Evaluated) -> GradientState:
        """Start the first descents from the most nearly failing points; failures are found."""
        usable = evaluated.counted & (evaluated.rho >= 0)
        rho = jnp.concatenate([jnp.where(usable, evaluated.rho, jnp.inf), state.best])
        points = jnp.concatenate([jnp.where(usable[:, None], evaluated.u, 0.5), state.u])
        _, nearest = jax.lax.top_k(-rho, len(state.best))
        best = rho[nearest]
        return state._replace(u=points[nearest], best=best, restart=jnp.isinf(best))

    def temperature(self, state: GradientState) -> Float[Array, ""]:
        """Geometric from `hot` to `cold`, relative to the spread of the robustness."""
        progress = jnp.minimum(state.round / self.cooling, 1.0).astype(jnp.float32)
        scale = jnp.where(state.scale > 0, state.scale, 1.0)
        return scale * self.hot * (self.cold / self.hot) ** progress

    def tell(self, state: GradientState, cube: Cube, evaluated: Evaluated) -> GradientState:
        assert evaluated.gradient is not None, "the gradient search needs gradients"
        free = np.array(cube.levels) == 0
        judged = evaluated.judged
        rho = jnp.where(judged, evaluated.rho, jnp.inf)
        usable = judged & jnp.all(jnp.isfinite(evaluated.gradient), axis=1)
        gradient = jnp.where(usable[:, None] & free, evaluated.gradient, 0.0)
        # Divided by its largest entry, so that squares neither overflow nor vanish.
        largest = jnp.max(jnp.abs(gradient), axis=1, keepdims=True, initial=0.0)
        gradient = gradient / jnp.where(largest > 0, largest, 1.0)

        fresh = state.restart
        begun = ~fresh[:, None]
        step = jnp.where(fresh, 0, state.step) + 1
        first = BETA1 * jnp.where(begun, state.first, 0.0) + (1 - BETA1) * gradient
        second = BETA2 * jnp.where(begun, state.second, 0.0) + (1 - BETA2) * gradient**2
        count = step[:, None].astype(jnp.float32)
        mean = first / (1 - BETA1**count)
        root = jnp.sqrt(second / (1 - BETA2**count)) + EPSILON
        rate = jnp.maximum(self.learning_rate * self.decay ** (count - 1), self.least_rate)
        moved = jnp.clip(evaluated.u - rate * mean / root, 0.0, 1.0)
        moved = jnp.where(free, moved, evaluated.u)

        before = jnp.where(fresh, jnp.inf, state.best)
        better = rho < before - 0.01 * jnp.abs(before)
        better |= jnp.isinf(before) & jnp.isfinite(rho)
        stale = jnp.where(better, 0, jnp.where(fresh, 0, state.stale) + 1)
        stuck = jnp.all(moved == evaluated.u, axis=1)

        # Without a verdict a descent goes back halfway to where it had one, a few times.
        back = ~judged & ~fresh & (state.retreats < MOST_RETREATS)
        halfway = jnp.where(free, (state.anchor + evaluated.u) / 2, evaluated.u)
        done = ~usable | stuck | (rho < 0) | (stale >= self.patience)

        def unless_back(new: Array, old: Array) -> Array:
            rows = back if new.ndim == 1 else back[:, None]
            return jnp.where(rows, old, new)

        return state._replace(
            u=unless_back(moved, halfway),
            restart=done & ~back,
            anchor=jnp.where(judged[:, None], evaluated.u, state.anchor),
            retreats=jnp.where(judged, 0, state.retreats + 1).astype(jnp.int32),
            first=unless_back(first, state.first),
            second=unless_back(second, state.second),
            best=jnp.minimum(before, rho),
            step=unless_back(step, state.step),
            stale=unless_back(stale, state.stale).astype(jnp.int32),
            round=state.round + 1,
            scale=jnp.where(state.scale > 0, state.scale, _spread(rho)),
        )


def _spread(rho: Float[Array, " n"]) -> Float[Array, ""]:
    """Standard deviation of the finite entries, or where it is zero their mean size."""
    finite = jnp.isfinite(rho)
    count = jnp.maximum(jnp.sum(finite), 1)
    mean = jnp.sum(jnp.where(finite, rho, 0.0)) / count
    std = jnp.sqrt(jnp.sum(jnp.where(finite, (rho - mean) ** 2, 0.0)) / count)
    return jnp.where(std > 0, std, jnp.abs(mean)).astype(jnp.float32)
