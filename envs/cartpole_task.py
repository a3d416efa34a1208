"""The cart-pole of CartPole-v1 as a task to train on."""

from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from envs.cartpole import (
    DT,
    NOMINAL,
    THETA_LIMIT,
    X_LIMIT,
    Features,
    Scalar,
    State,
    dynamics,
    initial,
    terminated,
)
from envs.randomisation import check_ranges, factor
from verifai_jax.addons.rl import Discrete
from verifai_jax.addons.rl.algorithm import Number
from verifai_jax.systems.ode.integrators import euler


class Episode(NamedTuple):
    """A state, and the features of this episode."""

    state: State
    features: dict[str, Scalar]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CartPoleTask:
    """CartPole-v1 to train on: nominal features, reward 1 a step, cut off after 500 steps.

    What is None is as in CartPole-v1, which is what returns are measured on. Numbers may be traced.

    - `masspole_range`, `length_range`: each episode's is the nominal one times a factor,
      log-uniform between `1 / (1 + range)` and `1 + range`.
    - `x0_range` (m), `theta0_range` (rad): the start is uniform in 0 +- this; 0.05 in CartPole-v1.
    - `potential`: weight of a shaping: a step also earns `shaping_discount * potential(after) -
      potential(before)`, where the potential falls from 1 in the middle and upright to 0 at the
      limits, and is 0 at the end, which changes no best policy if that discount is the
      algorithm's. Source: Ng, Harada and Russell, Policy invariance under reward transformations
      (1999), theorem 1.

    **Raises:** `ValueError` for a negative number, or a start beyond the limits.
    """

    masspole_range: Number | None = None
    length_range: Number | None = None
    x0_range: Number | None = None
    theta0_range: Number | None = None
    potential: Number | None = None
    shaping_discount: Number = 0.99
    time_limit: int = field(default=500, metadata={"static": True})

    def __post_init__(self) -> None:
        check_ranges(
            self, {"x0_range": X_LIMIT, "theta0_range": THETA_LIMIT, "shaping_discount": 1.0}
        )

    @property
    def action(self) -> Discrete:
        """The two actions: 0 pushes to the left, 1 to the right."""
        return Discrete(2)

    def reset(self, key: Key[Array, ""]) -> Episode:
        """Draw each part of the state uniformly in +-0.05, or in its range."""
        state = State(*jax.random.uniform(key, (4,), minval=-0.05, maxval=0.05))
        for name, farthest in (("x", self.x0_range), ("theta", self.theta0_range)):
            if farthest is not None:
                state = state._replace(**{name: getattr(state, name) / 0.05 * farthest})
        features = {}
        ranges = {"masspole": self.masspole_range, "length": self.length_range}
        for index, (name, spread) in enumerate(ranges.items()):
            if spread is not None:
                unit = jax.random.uniform(jax.random.fold_in(key, index), minval=-1.0)
                features[name] = NOMINAL[name] * factor(unit, spread)
        return Episode(state, features)

    def start(self, key: Key[Array, ""], features: Features) -> Episode:
        """Start with the features of a problem, all else nominal."""
        state = State(*(jnp.asarray(part, float) for part in initial(features)))
        return Episode(state, {name: features[name] for name in ("masspole", "length")})

    def step(
        self, key: Key[Array, ""], state: Episode, action: Int[Array, ""]
    ) -> tuple[Episode, Scalar, Bool[Array, ""]]:
        """Take one step of 0.02 s."""
        before, features = state
        force = jnp.where(action == 1, 1.0, -1.0) * NOMINAL["force_mag"]
        time = jnp.zeros(())
        after = euler(lambda t, s: dynamics(t, s, force, features), time, before, DT)
        over, reward = terminated(after, features), jnp.ones(())
        if self.potential is not None:
            gain = self.shaping_discount * jnp.where(over, 0.0, _potential(after))
            reward = reward + self.potential * (gain - _potential(before))
        return Episode(after, features), reward, over

    def observe(self, state: Episode) -> Float[Array, "4"]:
        """Return the state itself."""
        return jnp.stack(state.state)


def _potential(state: State) -> Scalar:
    return 1 - ((state.x / X_LIMIT) ** 2 + (state.theta / THETA_LIMIT) ** 2) / 2
