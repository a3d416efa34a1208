"""A road from above: one instant of a trace, drawn for a picture or an animation."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from envs.road.bodies import Body, Pose
from envs.road.paths import Path
from verifai_jax import Trace

VERGE, ASPHALT, PAINT = "#dfe7d5", "#5b6069", "#f4f4f2"
COLORS = ("#3a7ca5", "#f2c14e", "#7f6a93", "#6a994e", "#b08968")
BROKEN, STANDING, INK = "#d1495b", "#a7abb3", "#30323d"


@dataclass(frozen=True)
class Picture:
    """The function `draw` of a problem on a road: `(axes, trace, sample, features)`.

    - `bodies`: what moves, by the name in the signals `name_x`, `name_y` and `name_heading`.
    - `lanes`: path and width in m of each stretch of asphalt.
    - `lines`: paths of the painted lines, broken where the flag says so.
    - `standing`: pose and body of what stands, from the features.
    - `window`: left, right, bottom, top in m; around the body `follow`, or fixed without it.
    - `gap`: the signal below which zero is a collision, drawn in red.
    - `hidden`: two bodies' names; the view between them is drawn while the signal `visible` has it.
    """

    bodies: Mapping[str, Body]
    lanes: Sequence[tuple[Path, float]] = ()
    lines: Sequence[tuple[Path, bool]] = ()
    standing: Callable[[Mapping[str, Any]], Sequence[tuple[Pose, Body]]] | None = None
    window: tuple[float, float, float, float] = (-25.0, 45.0, -12.0, 12.0)
    follow: str | None = None
    gap: str = "gap"
    hidden: tuple[str, str] | None = None

    def __call__(self, axes: Any, trace: Trace, sample: int, features: Mapping[str, Any]) -> None:
        """Draw one instant; bodies are red from the first contact on."""
        from matplotlib.patches import Polygon

        def at(name: str) -> float:
            return float(np.asarray(trace[name])[sample])

        axes.set_facecolor(VERGE)
        for path, width in self.lanes:
            axes.add_patch(Polygon(band(path, width), closed=True, color=ASPHALT, linewidth=0))
        for path, broken in self.lines:
            x, y = course(path)
            axes.plot(x, y, color=PAINT, linewidth=1.6, dashes=(5, 7) if broken else (None, None))
        for pose, body in self.standing(features) if self.standing else ():
            axes.add_patch(_outline(body, pose, STANDING))
        hit = bool((np.asarray(trace[self.gap])[: sample + 1] < 0).any())
        for i, (name, body) in enumerate(self.bodies.items()):
            pose = Pose(*(at(f"{name}_{part}") for part in ("x", "y", "heading")))
            axes.add_patch(_outline(body, pose, BROKEN if hit else COLORS[i % len(COLORS)]))
            if body.length > 2:
                axes.add_patch(_windscreen(body, pose))
        title = f"{float(np.asarray(trace.clock())[sample]):5.2f} s  gap {at(self.gap):6.2f} m"
        if self.hidden is not None:
            seen = at("visible") > 0
            directions = [at(f"{name}_heading") for name in self.hidden]
            fronts = [self.bodies[name].front for name in self.hidden]
            positions = [
                [
                    at(f"{name}_{part}") + front * turn(direction)
                    for name, front, direction in zip(self.hidden, fronts, directions, strict=True)
                ]
                for part, turn in (("x", np.cos), ("y", np.sin))
            ]
            style = "-" if seen else (0, (2, 2))
            axes.plot(*positions, color=PAINT, linewidth=1.4, linestyle=style, zorder=7)
            title += "  in sight" if seen else "  hidden"
        axes.set_title(
            title + ("  collision" if hit else ""),
            fontsize=9,
            color=BROKEN if hit else INK,
            family="monospace",
        )
        x, y = (at(f"{self.follow}_{part}") for part in "xy") if self.follow else (0.0, 0.0)
        left, right, bottom, top = self.window
        axes.set_xlim(x + left, x + right)
        axes.set_ylim(y + bottom, y + top)
        axes.set_aspect("equal")
        axes.set_xticks([])
        axes.set_yticks([])
        for spine in axes.spines.values():
            spine.set_visible(False)


def course(path: Path, offset: float = 0.0, margin: float = 60.0) -> tuple[np.ndarray, np.ndarray]:
    """Return points of a path every metre, and `margin` metres beyond its ends."""
    distance = np.linspace(-margin, path.length + margin, int(path.length + 2 * margin) + 1)
    pose = path.pose(jnp.asarray(distance), offset)
    return np.asarray(pose.x), np.asarray(pose.y)


def band(path: Path, width: float) -> np.ndarray:
    """Return the outline `[points, 2]` of a lane."""
    right, left = (np.stack(course(path, side * width / 2), axis=1) for side in (-1, 1))
    return np.concatenate([right, left[::-1]])


def _outline(body: Body, pose: Pose, color: str) -> Any:
    from matplotlib.patches import Polygon

    corners = np.asarray(body.corners(pose), float)
    return Polygon(
        corners, closed=True, facecolor=color, edgecolor="white", linewidth=0.7, zorder=5
    )


def _windscreen(body: Body, pose: Pose) -> Any:
    from matplotlib.patches import Polygon

    glass = Body(0.14 * body.length, 0.8 * body.width, body.ahead + 0.18 * body.length)
    corners = np.asarray(glass.corners(pose), float)
    return Polygon(corners, closed=True, color="#dcecf5", linewidth=0, zorder=6)
