"""Gradient descent on the smooth robustness, from many starts at once.

Each row of the batch is a descent of its own: Adam (Kingma, Ba, 2015, algorithm 1) with large,
shrinking steps, projected to the cube. Its first steps are the sign of the gradient, which takes
a descent to a corner in a few simulations. A descent that has failed the system, has converged or
has no usable gradient starts again at the next low-discrepancy point.
"""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

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


class GradientState(NamedTuple):
    key: Key[Array, ""]
    u: Float[Array, "batch d"]
    restart: Bool[Array, " batch"]  # rows that take a new start instead of `u`
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
        row = state.restart[:, None]
        u = jnp.where(row, fresh, state.u)
        return u, state._replace(
            u=u,
            restart=jnp.zeros(batch, bool),
            first=jnp.where(row, 0.0, state.first),
            second=jnp.where(row, 0.0, state.second),
            best=jnp.where(state.restart, jnp.inf, state.best),
            step=jnp.where(state.restart, 0, state.step),
            stale=jnp.where(state.restart, 0, state.stale),
            starts=index[-1],
        )

    def temperature(self, state: GradientState) -> Float[Array, ""]:
        """Geometric from `hot` to `cold`, relative to the spread of the robustness."""
        progress = jnp.minimum(state.round / self.cooling, 1.0).astype(jnp.float32)
        scale = jnp.where(state.scale > 0, state.scale, 1.0)
        return scale * self.hot * (self.cold / self.hot) ** progress

    def tell(self, state: GradientState, cube: Cube, evaluated: Evaluated) -> GradientState:
        assert evaluated.gradient is not None, "the gradient search needs gradients"
        free = np.array(cube.levels) == 0
        usable = evaluated.counted & jnp.isfinite(evaluated.rho)
        rho = jnp.where(usable, evaluated.rho, jnp.inf)
        usable &= jnp.all(jnp.isfinite(evaluated.gradient), axis=1)
        gradient = jnp.where(usable[:, None] & free, evaluated.gradient, 0.0)
        # Divided by its largest entry, so that squares neither overflow nor vanish.
        largest = jnp.max(jnp.abs(gradient), axis=1, keepdims=True, initial=0.0)
        gradient = gradient / jnp.where(largest > 0, largest, 1.0)

        step = state.step + 1
        first = BETA1 * state.first + (1 - BETA1) * gradient
        second = BETA2 * state.second + (1 - BETA2) * gradient**2
        count = step[:, None].astype(jnp.float32)
        mean = first / (1 - BETA1**count)
        root = jnp.sqrt(second / (1 - BETA2**count)) + EPSILON
        rate = jnp.maximum(self.learning_rate * self.decay ** (count - 1), self.least_rate)
        moved = jnp.clip(evaluated.u - rate * mean / root, 0.0, 1.0)
        moved = jnp.where(free, moved, evaluated.u)

        better = rho < state.best - 0.01 * jnp.abs(state.best)
        better |= jnp.isinf(state.best) & jnp.isfinite(rho)
        stale = jnp.where(better, 0, state.stale + 1)
        stuck = jnp.all(moved == evaluated.u, axis=1)
        return state._replace(
            u=moved,
            restart=~usable | stuck | (rho < 0) | (stale >= self.patience),
            first=first,
            second=second,
            best=jnp.minimum(state.best, rho),
            step=step,
            stale=stale.astype(jnp.int32),
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
