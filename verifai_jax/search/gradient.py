"""Multi-start gradient descent on annealed smooth robustness, projected to the cube.

Each row of a batch is a descent of its own. The steps are Adam's (Kingma and Ba, Adam: a method for
stochastic optimization, ICLR 2015, algorithm 1), whose first is the sign of the gradient: with a
large first step a descent jumps towards the corner where the failures of many systems are, and then
settles down.
"""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from verifai_jax.search.base import Cube, Evaluated
from verifai_jax.search.halton import halton_points

BETA_1, BETA_2, EPSILON = 0.7, 0.9, 1e-12
USELESS = 1e-9  # A gradient smaller than this part of the robustness' spread leads nowhere.


class GradientState(NamedTuple):
    """Where each descent is, Adam's moments, and its age and progress."""

    key: Key[Array, ""]
    u: Float[Array, "n d"]
    momentum: Float[Array, "n d"]
    second: Float[Array, "n d"]
    age: Int[Array, " n"]
    least: Float[Array, " n"]
    stale: Int[Array, " n"]
    started: Int[Array, ""]
    rounds: Int[Array, ""]
    spread: Float[Array, ""]


@dataclass(frozen=True)
class Gradient:
    """Descents from low-discrepancy starts; one that has ended starts elsewhere.

    Discrete coordinates are drawn at each start and stay. A descent ends when it has found a
    failure, has made `steps` steps or `patience` without progress, or its gradient is of no use
    (zero or not finite).

    - `step`, `last_step`: lengths of the first and the last step in widths of the cube; geometric
      in between.
    - `steps`: of one descent.
    - `patience`: steps without progress before a descent gives up.
    - `warm`, `cold`: temperatures at the first and last step, relative to the spread of the
      robustness seen so far.

    **Raises:** `ValueError` for values out of range; `check` for a cube without a continuous
    coordinate.
    """

    step: float = 0.25
    last_step: float = 0.02
    steps: int = 16
    patience: int = 5
    warm: float = 0.3
    cold: float = 0.02
    wants_gradient: ClassVar[bool] = True
    samples_prior: ClassVar[bool] = False

    def __post_init__(self) -> None:
        for first, last in (("step", "last_step"), ("warm", "cold")):
            a, b = getattr(self, first), getattr(self, last)
            if not 0 < b <= a:
                raise ValueError(f"need 0 < {last} <= {first}; got ({first}={a}, {last}={b})")
        for name in ("steps", "patience"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"{name} must be an integer of at least 1; got {value!r}")

    def check(self, cube: Cube) -> None:
        """Refuse a cube without a continuous coordinate."""
        if not cube.continuous.any():
            raise ValueError(
                "search 'gradient' needs a continuous feature, and this space has only discrete "
                "ones; use 'cross_entropy' or 'uniform'"
            )

    def init(self, key: Key[Array, ""], cube: Cube, batch: int) -> GradientState:
        """One descent a row."""
        zeros = jnp.zeros((batch, cube.dim))
        return GradientState(
            key=key,
            u=halton_points(1 + jnp.arange(batch), cube.dim, key),
            momentum=zeros,
            second=zeros,
            age=jnp.zeros(batch, jnp.int32),
            least=jnp.full(batch, np.inf),
            stale=jnp.zeros(batch, jnp.int32),
            started=jnp.int32(batch),
            rounds=jnp.int32(0),
            spread=jnp.asarray(0.0),
        )

    def ask(
        self, state: GradientState, cube: Cube, batch: int
    ) -> tuple[Float[Array, "batch d"], GradientState]:
        """Where the descents are now."""
        return state.u, state

    def temperature(self, state: GradientState) -> Float[Array, ""]:
        """Of the smooth robustness to differentiate: falls over the rounds of a descent."""
        part = jnp.mean(state.age) / max(self.steps - 1, 1)
        relative = self.warm * (self.cold / self.warm) ** jnp.clip(part, 0, 1)
        return jnp.where(state.spread > 0, relative * state.spread, self.warm)

    def tell(self, state: GradientState, cube: Cube, evaluated: Evaluated) -> GradientState:
        """Step down, or start anew."""
        assert evaluated.gradient is not None
        usable = evaluated.counted & jnp.isfinite(evaluated.rho)
        gradient = jnp.where(jnp.asarray(cube.continuous), evaluated.gradient, 0.0)
        rho = jnp.where(usable, evaluated.rho, np.inf)
        spread = _spread(state, rho, usable)
        size = jnp.max(jnp.abs(gradient), axis=1, initial=0.0)
        leads = usable & jnp.isfinite(size) & (size > USELESS * spread)

        gradient = jnp.where(leads[:, None], gradient, 0.0)
        momentum = BETA_1 * state.momentum + (1 - BETA_1) * gradient
        second = BETA_2 * state.second + (1 - BETA_2) * gradient**2
        step = self._moves(momentum, second, state.age)
        moved = jnp.clip(state.u - step, 0.0, 1.0)

        better = rho < state.least - 0.01 * spread
        stale = jnp.where(better, 0, state.stale + 1)
        ended = (
            ~leads
            | (rho < 0)
            | (state.age + 1 >= self.steps)
            | (stale >= self.patience)
            | (jnp.max(jnp.abs(moved - state.u), axis=1, initial=0.0) == 0)
        )
        return self._restart(
            state._replace(
                u=moved,
                momentum=momentum,
                second=second,
                age=state.age + 1,
                least=jnp.minimum(state.least, rho),
                stale=stale,
                rounds=state.rounds + 1,
                spread=spread,
            ),
            cube,
            ended,
        )

    def _moves(
        self, momentum: Float[Array, "n d"], second: Float[Array, "n d"], age: Int[Array, " n"]
    ) -> Float[Array, "n d"]:
        """Adam's steps with bias correction, shrinking with the age of the descent."""
        count = (age + 1)[:, None]
        mean = momentum / (1 - BETA_1**count)
        scale = jnp.sqrt(second / (1 - BETA_2**count))
        # Coordinates that hardly matter must not move as far as those that do.
        scale = jnp.maximum(scale, 0.1 * jnp.max(scale, axis=1, keepdims=True))
        shrink = (self.last_step / self.step) ** (age / max(self.steps - 1, 1))
        return self.step * shrink[:, None] * mean / (scale + EPSILON)

    def _restart(self, state: GradientState, cube: Cube, ended: Bool[Array, " n"]) -> GradientState:
        number = state.started + jnp.cumsum(ended.astype(jnp.int32))
        fresh = halton_points(number, cube.dim, state.key)
        return state._replace(
            u=jnp.where(ended[:, None], fresh, state.u),
            momentum=jnp.where(ended[:, None], 0.0, state.momentum),
            second=jnp.where(ended[:, None], 0.0, state.second),
            age=jnp.where(ended, 0, state.age),
            least=jnp.where(ended, np.inf, state.least),
            stale=jnp.where(ended, 0, state.stale),
            started=state.started + jnp.sum(ended.astype(jnp.int32)),
        )


def _spread(
    state: GradientState, rho: Float[Array, " n"], usable: Bool[Array, " n"]
) -> Float[Array, ""]:
    """Standard deviation of the robustness at the first starts; later rounds would shrink it."""
    count = jnp.maximum(jnp.sum(usable), 1)
    mean = jnp.sum(jnp.where(usable, rho, 0.0)) / count
    deviation = jnp.sqrt(jnp.sum(jnp.where(usable, (rho - mean) ** 2, 0.0)) / count)
    deviation = jnp.where(deviation > 0, deviation, jnp.abs(mean))
    return jnp.where(state.spread > 0, state.spread, deviation)
