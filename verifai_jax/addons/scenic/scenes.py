"""Scenes of a Scenic program from above."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from verifai_jax.core.display.figure import Axes, Figure
from verifai_jax.pictures.style import new_figure, show_or_save

EGO, OTHERS, GROUND = "#d1495b", "#3a6ea5", "#b8b8b8"
MARGIN = 4.0
"""Metres around the objects."""


def draw_scene(program: Any, scene: Any, path: str | Path | None = None) -> Figure:
    """Draw the objects of a scene with their names and headings; returns the figure.

    **Arguments:**
    - `program`: a `ScenicProgram`.
    - `scene`: one of its scenes, in Scenic's form.
    - `path`: file to which the picture is written.
    """
    figure = new_figure(figsize=(6, 6))
    axes = figure.subplots()
    corners = []
    names = [name for name in program.objects if name != "params"]
    for name, body in zip(names, scene.objects, strict=True):
        box = np.array([tuple(corner)[:2] for corner in body._corners2D])
        colour = EGO if body is scene.egoObject else OTHERS
        axes.fill(*box.T, facecolor=colour, edgecolor="black", linewidth=0.6, alpha=0.8)
        yaw, reach = body.orientation.yaw, 0.5 * body.length
        ahead = -math.sin(yaw) * reach, math.cos(yaw) * reach
        axes.plot(
            [body.position.x, body.position.x + ahead[0]],
            [body.position.y, body.position.y + ahead[1]], color="black", linewidth=1.0,
        )  # fmt: skip
        axes.annotate(
            name, (box[:, 0].max(), box[:, 1].max()), xytext=(3, 3), textcoords="offset points",
            fontsize=8,
        )  # fmt: skip
        corners.append(box)
    whole = np.concatenate(corners)
    low, high = whole.min(axis=0) - MARGIN, whole.max(axis=0) + MARGIN
    _draw_ground(axes, getattr(scene.workspace.region, "polygons", None))
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.set_xlabel("x in m")
    axes.set_ylabel("y in m")
    return show_or_save(figure, path)


def _draw_ground(axes: Axes, polygons: Any) -> None:
    """Draw the borders of a workspace of polygons."""
    for polygon in getattr(polygons, "geoms", ()):
        for ring in (polygon.exterior, *polygon.interiors):
            points = np.array(ring.coords)[:, :2]
            axes.plot(*points.T, color=GROUND, linewidth=1.2, zorder=0)
