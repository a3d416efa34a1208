"""One instant of the cart-pole, drawn for an animation."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from envs.cartpole import THETA_LIMIT, X_LIMIT, feature
from verifai_jax import Trace

CART_WIDTH, CART_HEIGHT = 0.5, 0.3


def draw(axes: Any, trace: Trace, sample: int, features: Mapping[str, Any]) -> None:
    """Draw the cart on its track with the pole, its 12 degrees, and the force; red past a bound."""
    x, theta = (float(np.asarray(trace[name])[sample]) for name in ("x", "theta"))
    force = float(np.asarray(trace["force"])[sample]) if "force" in trace.signals else 0.0
    pole = 2 * float(feature(features, "length"))
    fallen = abs(theta) > THETA_LIMIT or abs(x) > X_LIMIT
    color = "#d1495b" if fallen else "#30323d"

    axes.plot([-X_LIMIT, X_LIMIT], [0, 0], color="#8d99ae", linewidth=1)
    for end in (-X_LIMIT, X_LIMIT):
        axes.plot([end, end], [-0.08, 0.08], color="#d1495b", linewidth=2)
    for side in (-1, 1):
        lean = side * THETA_LIMIT
        axes.plot(
            [x, x + pole * math.sin(lean)],
            [CART_HEIGHT, CART_HEIGHT + pole * math.cos(lean)],
            color="#d1495b",
            linewidth=0.8,
            linestyle=":",
        )
    axes.fill_between(
        [x - CART_WIDTH / 2, x + CART_WIDTH / 2], 0.02, CART_HEIGHT, color=color, linewidth=0
    )
    axes.plot(
        [x, x + pole * math.sin(theta)],
        [CART_HEIGHT, CART_HEIGHT + pole * math.cos(theta)],
        color="#d1495b" if fallen else "#c98a2b",
        linewidth=5,
        solid_capstyle="round",
    )
    if force:
        axes.annotate(
            "",
            (x + math.copysign(CART_WIDTH / 2 + 0.045 * abs(force), force), CART_HEIGHT / 2),
            (x + math.copysign(CART_WIDTH / 2, force), CART_HEIGHT / 2),
            arrowprops={"arrowstyle": "->", "color": "#3a7ca5", "linewidth": 1.6},
        )
    time = float(np.asarray(trace.clock())[sample])
    axes.set_title(
        f"{time:4.2f} s   angle {math.degrees(theta):6.2f}°" + ("   fallen" if fallen else ""),
        fontsize=10,
        color=color,
        family="monospace",
    )
    axes.set_xlim(-3, 3)
    axes.set_ylim(-0.15, max(2.2, CART_HEIGHT + pole + 0.15))
    axes.set_aspect("equal")
    axes.axis("off")
