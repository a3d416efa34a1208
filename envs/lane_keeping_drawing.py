"""One instant of the lane-keeping car from above, drawn for an animation."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from envs.lane_keeping import CAR_WIDTH, FRONT, LANE_WIDTH, REAR, feature
from verifai_jax import Trace

BACKWARD, AHEAD = 11.0, 25.0
BELOW, ABOVE = 7.5, 10.5
VERGE, ASPHALT, PAINT = "#dfe7d5", "#5b6069", "#f4f4f2"
FINE, BROKEN, TRAIL = "#3a7ca5", "#d1495b", "#f2c14e"


def draw(axes: Any, trace: Trace, sample: int, features: Mapping[str, Any]) -> None:
    """Draw the road around the car, the car's way, and the car; red while it is over a marking."""
    now = {name: float(np.asarray(value)[sample]) for name, value in trace.signals.items()}
    road = _Road(features, now["distance"])
    half = LANE_WIDTH / 2

    axes.set_facecolor(VERGE)
    # The car's own lane, and the oncoming one on its left.
    axes.add_patch(road.band(-half - 0.5, 3 * half + 0.5, ASPHALT))
    for edge in (-half, 3 * half):
        axes.plot(*road.line(edge), color=PAINT, linewidth=2.2)
    for begin in np.arange(math.floor(road.first / 9) * 9, road.last, 9.0):
        dash = road.line(half, begin, begin + 4.5)
        axes.plot(*dash, color=PAINT, linewidth=2.2, solid_capstyle="butt")
    past = slice(0, sample + 1)
    distance, offset = (np.asarray(trace[name])[past] for name in ("distance", "offset"))
    near = distance >= road.first
    axes.plot(*road.position(distance[near], offset[near]), color=TRAIL, linewidth=1.6)

    over = min(now["left"], now["right"]) < 0
    color = BROKEN if over else FINE
    _car(axes, now, float(feature(features, "wheelbase", 0.0)), color)
    time = float(np.asarray(trace.clock())[sample])
    axes.set_title(
        f"{time:5.2f} s  {now['speed']:4.1f} m/s  {now['offset']:+5.2f} m  "
        f"{now['lateral_acceleration']:+5.1f} m/s²" + ("  off the lane" if over else ""),
        fontsize=9,
        color=BROKEN if over else "#30323d",
        family="monospace",
    )
    axes.set_xlim(-BACKWARD, AHEAD)
    axes.set_ylim(-BELOW, ABOVE)
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)


class _Road:
    """The road's middle around a distance, which is the origin, its direction along x."""

    def __init__(self, features: Mapping[str, Any], here: float) -> None:
        margin = 15.0
        self.first, self.last = here - BACKWARD - margin, here + AHEAD + margin
        self.distance = np.linspace(self.first, self.last, 321)
        step = self.distance[1] - self.distance[0]
        curvature = np.asarray(feature(features, "curvature", self.distance))
        curvature = np.broadcast_to(curvature, self.distance.shape)
        direction = np.concatenate([[0.0], np.cumsum((curvature[1:] + curvature[:-1]) / 2 * step)])
        self.direction = direction - np.interp(here, self.distance, direction)
        middle = (self.direction[1:] + self.direction[:-1]) / 2
        x = np.concatenate([[0.0], np.cumsum(np.cos(middle) * step)])
        y = np.concatenate([[0.0], np.cumsum(np.sin(middle) * step)])
        self.x = x - np.interp(here, self.distance, x)
        self.y = y - np.interp(here, self.distance, y)

    def position(self, distance: Any, offset: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return points of the plane at distances along the road and offsets to its left."""
        x, y, direction = (
            np.interp(distance, self.distance, values)
            for values in (self.x, self.y, self.direction)
        )
        return x - offset * np.sin(direction), y + offset * np.cos(direction)

    def line(
        self, offset: float, begin: float | None = None, end: float | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Draw a line beside the road's middle."""
        first = self.first if begin is None else begin
        last = self.last if end is None else end
        return self.position(np.linspace(first, last, 60), offset)

    def band(self, right: float, left: float, color: str) -> Any:
        """Fill the surface between two offsets."""
        from matplotlib.patches import Polygon

        here = np.stack(self.line(right), axis=1)
        there = np.stack(self.line(left), axis=1)[::-1]
        return Polygon(np.concatenate([here, there]), closed=True, color=color, linewidth=0)


def _car(axes: Any, now: Mapping[str, float], wheelbase: float, color: str) -> None:
    """Draw the body with its windscreen and wheels, rear axle at the offset."""
    from matplotlib.patches import FancyBboxPatch, Polygon, Rectangle
    from matplotlib.transforms import Affine2D

    turned = Affine2D().rotate(now["heading"]).translate(0.0, now["offset"]) + axes.transData

    def wheel(x: float, y: float, angle: float) -> None:
        tilt = Affine2D().rotate(angle).translate(x, y)
        axes.add_patch(
            Rectangle((-0.38, -0.15), 0.76, 0.3, color="#1c1d21", transform=tilt + turned, zorder=4)
        )

    for side in (-1, 1):
        wheel(0.0, side * 0.84, 0.0)
        # Steering angles on a road are a few degrees: drawn three times as large to be seen.
        wheel(wheelbase, side * 0.84, 3 * now["steer"])
    axes.add_patch(
        FancyBboxPatch(
            (-REAR + 0.3, -CAR_WIDTH / 2 + 0.3),
            REAR + FRONT - 0.6,
            CAR_WIDTH - 0.6,
            boxstyle="round,pad=0.3",
            facecolor=color,
            edgecolor="white",
            linewidth=0.6,
            transform=turned,
            zorder=5,
        )
    )
    glass = np.array([[1.5, -0.65], [2.3, -0.75], [2.3, 0.75], [1.5, 0.65]])
    axes.add_patch(Polygon(glass, color="#dcecf5", linewidth=0, transform=turned, zorder=6))
    glass = np.array([[-0.2, -0.65], [-0.55, -0.7], [-0.55, 0.7], [-0.2, 0.65]])
    axes.add_patch(Polygon(glass, color="#dcecf5", linewidth=0, transform=turned, zorder=6))
