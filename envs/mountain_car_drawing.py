"""One instant of the mountain car, drawn for an animation."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from envs.mountain_car import GOAL, LEFT, RIGHT
from verifai_jax import Trace


def draw(axes: Any, trace: Trace, sample: int, features: Mapping[str, Any]) -> None:
    """Draw the valley, the flag at 0.45, the car, where it pushes, and how fast it rolls."""
    position, velocity, throttle = (
        float(np.asarray(trace[name])[sample]) for name in ("position", "velocity", "throttle")
    )
    flag = GOAL["continuous"]
    color = "#3a7d44" if position >= flag else "#30323d"
    across = np.linspace(LEFT, RIGHT, 200)
    axes.fill_between(across, -0.2, _height(across), color="#e8e4dc", linewidth=0)
    axes.plot(across, _height(across), color="#8d99ae", linewidth=1.5)
    axes.plot([flag, flag], [_height(flag), _height(flag) + 0.25], color="#d1495b", linewidth=2)
    axes.plot([LEFT, LEFT], [_height(LEFT), _height(LEFT) + 0.25], color="#30323d", linewidth=3)
    axes.plot(position, _height(position) + 0.05, "o", color=color, markersize=14)
    if abs(throttle) > 0.02:
        slope = math.atan(0.45 * 3 * math.cos(3 * position))
        ahead = 0.3 * throttle
        axes.annotate(
            "",
            (
                position + ahead * math.cos(slope),
                _height(position) + 0.05 + ahead * math.sin(slope),
            ),
            (position, _height(position) + 0.05),
            arrowprops={"arrowstyle": "->", "color": "#3a7ca5", "linewidth": 1.6},
        )
    time = float(np.asarray(trace.clock())[sample])
    axes.set_title(
        f"{time:4.0f} s   position {position:5.2f}   velocity {velocity:6.3f}",
        fontsize=10,
        color=color,
        family="monospace",
    )
    axes.set_xlim(LEFT - 0.1, RIGHT + 0.1)
    axes.set_ylim(-0.1, 1.35)
    axes.set_aspect("equal")
    axes.axis("off")


def _height(position: Any) -> Any:
    return np.sin(3 * np.asarray(position)) * 0.45 + 0.55
