"""Gymnasium's classic control as tasks, for learning curves that the literature knows.

    ControlTask = Pendulum | Acrobot | MountainCar

Each equals Gymnasium's step for step, which `tests/addons/rl/test_learning_curves.py` checks.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from verifai_jax.addons.rl import Continuous, Discrete

Scalar = Float[Array, ""]
Stepped = tuple["Angles", Scalar, Bool[Array, ""]]


class Swing(NamedTuple):
    """Angle in rad from upright, and its rate in rad/s."""

    angle: Scalar
    rate: Scalar


@dataclass(frozen=True)
class Pendulum:
    """Pendulum-v1: swing up and hold, with little torque; never terminates."""

    time_limit: int = 200

    @property
    def action(self) -> Continuous:
        """Torque in N m."""
        return Continuous(-2.0, 2.0)

    def reset(self, key: Key[Array, ""]) -> Swing:
        """Any angle, up to 1 rad/s."""
        unit = jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)
        return Swing(unit[0] * jnp.pi, unit[1])

    def step(
        self, key: Key[Array, ""], state: Swing, action: Float[Array, "1"]
    ) -> tuple[Swing, Scalar, Bool[Array, ""]]:
        """0.05 s."""
        torque = jnp.clip(action[0], -2.0, 2.0)
        angle = (state.angle + jnp.pi) % (2 * jnp.pi) - jnp.pi
        reward = -(angle**2 + 0.1 * state.rate**2 + 0.001 * torque**2)
        rate = state.rate + (15.0 * jnp.sin(state.angle) + 3.0 * torque) * 0.05
        rate = jnp.clip(rate, -8.0, 8.0)
        return Swing(state.angle + rate * 0.05, rate), reward, jnp.array(False)

    def observe(self, state: Swing) -> Float[Array, "3"]:
        """Cosine and sine of the angle, and the rate."""
        return jnp.stack([jnp.cos(state.angle), jnp.sin(state.angle), state.rate])


class Angles(NamedTuple):
    """Angles of the inner link (0: hanging down) and of the outer one to it, and their rates."""

    inner: Scalar
    outer: Scalar
    inner_rate: Scalar
    outer_rate: Scalar


@dataclass(frozen=True)
class Acrobot:
    """Acrobot-v1: swing the tip above the bar; -1 a step until then."""

    time_limit: int = 500

    @property
    def action(self) -> Discrete:
        """Torque -1, 0 or 1 N m between the links."""
        return Discrete(3)

    def reset(self, key: Key[Array, ""]) -> Angles:
        """Nearly at rest."""
        return Angles(*jax.random.uniform(key, (4,), minval=-0.1, maxval=0.1))

    def step(
        self, key: Key[Array, ""], state: Angles, action: Int[Array, ""]
    ) -> tuple[Angles, Scalar, Bool[Array, ""]]:
        """0.2 s, one step of Runge-Kutta."""
        torque = action.astype(jnp.float32) - 1.0

        def derivative(s: Angles) -> Angles:
            # Unit masses, lengths and moments of inertia; centres of mass in the middle.
            cos = jnp.cos(s.outer)
            d1 = 0.25 + (1 + 0.25 + cos) + 2.0
            d2 = 0.25 + 0.5 * cos + 1.0
            phi2 = 0.5 * 9.8 * jnp.cos(s.inner + s.outer - jnp.pi / 2)
            phi1 = (
                -0.5 * s.outer_rate**2 * jnp.sin(s.outer)
                - s.outer_rate * s.inner_rate * jnp.sin(s.outer)
                + 1.5 * 9.8 * jnp.cos(s.inner - jnp.pi / 2)
                + phi2
            )
            outer = torque + d2 / d1 * phi1 - 0.5 * s.inner_rate**2 * jnp.sin(s.outer) - phi2
            outer = outer / (0.25 + 1.0 - d2**2 / d1)
            return Angles(s.inner_rate, s.outer_rate, -(d2 * outer + phi1) / d1, outer)

        def ahead(by: float, k: Angles) -> Angles:
            return jax.tree.map(lambda x, d: x + by * d, state, k)

        k1 = derivative(state)
        k2 = derivative(ahead(0.1, k1))
        k3 = derivative(ahead(0.1, k2))
        k4 = derivative(ahead(0.2, k3))
        new = jax.tree.map(
            lambda x, a, b, c, d: x + 0.2 / 6 * (a + 2 * b + 2 * c + d), state, k1, k2, k3, k4
        )
        new = Angles(
            (new.inner + jnp.pi) % (2 * jnp.pi) - jnp.pi,
            (new.outer + jnp.pi) % (2 * jnp.pi) - jnp.pi,
            jnp.clip(new.inner_rate, -4 * jnp.pi, 4 * jnp.pi),
            jnp.clip(new.outer_rate, -9 * jnp.pi, 9 * jnp.pi),
        )
        over = -jnp.cos(new.inner) - jnp.cos(new.inner + new.outer) > 1.0
        return new, jnp.where(over, 0.0, -1.0), over

    def observe(self, state: Angles) -> Float[Array, "6"]:
        """Cosines and sines of the angles, and the rates."""
        inner, outer = state.inner, state.outer
        turned = [jnp.cos(inner), jnp.sin(inner), jnp.cos(outer), jnp.sin(outer)]
        return jnp.stack([*turned, state.inner_rate, state.outer_rate])
