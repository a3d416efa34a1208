"""The cones as their camera sees them, beside the plan: one instant, or a strip of several.

run.replay(row).animate("worst.gif")                # of the problems of specs/cones.py
film_strip(replay.trace, replay.features, "worst.png")
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from envs.cones import (
    BREADTH,
    CONE_RADIUS,
    FIELD_OF_VIEW,
    LANE,
    LENGTH,
    NOTHING,
    Pose,
    cone_positions,
    feature,
    render,
)
from verifai_jax import Trace

VERGE, ASPHALT, PAINT = "#dfe7d5", "#5b6069", "#f4f4f2"
FINE, BROKEN, PLASTIC = "#3a7ca5", "#d1495b", "#ff6a13"
BACKWARD, AHEAD = 32.0, 22.0
"""Metres of the plan before the first cone, and beyond it."""

_look = jax.jit(render)


def draw(axes: Any, trace: Trace, sample: int, features: Mapping[str, Any]) -> None:
    """Draw what the camera sees at one instant above the plan of the road."""
    axes.set_axis_off()
    now = _now(trace, sample)
    camera, plan = axes.inset_axes((0, 0.4, 1, 0.55)), axes.inset_axes((0, 0, 1, 0.38))
    axes.set_title(_words(trace, sample, now), fontsize=8, family="monospace", color=_ink(now))
    _draw_camera(camera, features, now)
    _draw_plan(plan, trace, sample, features, now)


def film_strip(
    trace: Trace, features: Mapping[str, Any], path: str | Path | None = None, count: int = 6
) -> Any:
    """Draw what the camera saw beside the plan, at instants until the car is nearest to the cones.

    **Arguments:**

    - `trace`: of a simulation of the cones.
    - `features`: of the same one.
    - `path`: of a picture to write; none when left out.
    - `count`: number of instants.

    **Returns:** the figure.
    """
    from verifai_jax.core.display.figure import new_figure

    nearest = int(np.argmin(np.asarray(trace["cone_gap"])))
    samples = np.unique(np.linspace(0, max(nearest, 1), count).round().astype(int))
    figure = new_figure(figsize=(9.0, 1.25 * len(samples)), layout="constrained", dpi=90)
    rows = figure.subplots(len(samples), 2, squeeze=False, width_ratios=[1, 2.2])
    for (camera, plan), sample in zip(rows, samples, strict=True):
        now = _now(trace, int(sample))
        plan.set_title(
            _words(trace, int(sample), now), fontsize=8, family="monospace", color=_ink(now)
        )
        _draw_camera(camera, features, now)
        _draw_plan(plan, trace, int(sample), features, now)
    if path is not None:
        figure.savefig(path)
    return figure


def _now(trace: Trace, sample: int) -> dict[str, float]:
    return {name: float(np.asarray(value)[sample]) for name, value in trace.signals.items()}


def _words(trace: Trace, sample: int, now: Mapping[str, float]) -> str:
    time = float(np.asarray(trace.clock())[sample])
    distance = f"{now['distance']:4.1f} m" if now["distance"] < NOTHING else "  -   "
    estimate = f"{now['estimate']:4.1f} m" if now["estimate"] < NOTHING else "none  "
    return f"{time:4.2f} s  cones at {distance}  seen at {estimate}  gap {now['cone_gap']:5.2f} m"


def _ink(now: Mapping[str, float]) -> str:
    return BROKEN if now["cone_gap"] < 0.1 else "#30323d"


def _draw_camera(axes: Any, features: Mapping[str, Any], now: Mapping[str, float]) -> None:
    pose = Pose(*(jnp.float32(now[name]) for name in ("x", "offset", "heading")))
    image: Float[np.ndarray, "h w 3"] = np.asarray(_look(dict(features), pose))
    axes.imshow(image, interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks([])


def _draw_plan(
    axes: Any, trace: Trace, sample: int, features: Mapping[str, Any], now: Mapping[str, float]
) -> None:
    from matplotlib.colors import hsv_to_rgb
    from matplotlib.patches import Circle, Polygon, Rectangle

    low, high = -LANE / 2, 1.5 * LANE
    axes.set_facecolor(VERGE)
    axes.add_patch(
        Rectangle((-BACKWARD, low - 0.4), BACKWARD + AHEAD, high - low + 0.8, color=ASPHALT)
    )
    for edge in (low, high):
        axes.plot([-BACKWARD, AHEAD], [edge, edge], color=PAINT, linewidth=1)
    axes.plot([-BACKWARD, AHEAD], [LANE / 2] * 2, color=PAINT, linewidth=1, dashes=(4, 4))
    positions = np.asarray(cone_positions(features))
    hue, value = (float(feature(features, name)) for name in ("car_hue", "car_value"))
    x = float(positions[-1, 0]) + float(feature(features, "car_gap")) + LENGTH / 2
    parked = x, float(feature(features, "car_offset")), float(feature(features, "car_yaw"))
    axes.add_patch(Polygon(_outline(*parked), color=hsv_to_rgb((hue, 0.85, value))))
    for position in positions:
        axes.add_patch(Circle(tuple(position), 1.6 * CONE_RADIUS, color=PLASTIC, zorder=4))
    past = slice(0, sample + 1)
    axes.plot(np.asarray(trace["x"])[past], np.asarray(trace["offset"])[past], color="#f2c14e")
    color = BROKEN if now["cone_gap"] < 0.1 else FINE
    here = now["x"], now["offset"], now["heading"]
    axes.add_patch(Polygon(_outline(*here), color=color, zorder=5))
    for side in (-1, 1):
        angle = now["heading"] + side * FIELD_OF_VIEW / 2
        reach = 14.0 * np.array([math.cos(angle), math.sin(angle)])
        ends = np.array(here[:2]) + np.outer([0, 1], reach)
        axes.plot(*ends.T, color=PAINT, linewidth=0.6, alpha=0.7)
    axes.set_xlim(-BACKWARD, AHEAD)
    axes.set_ylim(low - 0.8, high + 0.8)
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])


def _outline(x: float, y: float, heading: float) -> Float[np.ndarray, "4 2"]:
    """Return the corners of a car."""
    corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * [LENGTH / 2, BREADTH / 2]
    turn = np.array(
        [[math.cos(heading), math.sin(heading)], [-math.sin(heading), math.cos(heading)]]
    )
    return corners @ turn + [x, y]
