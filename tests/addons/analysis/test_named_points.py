"""Names beside points."""

import numpy as np
from legible import faults

from verifai_jax.addons.analysis.pictures.panels import name_points
from verifai_jax.pictures.style import new_figure


def test_names_of_points_never_lie_on_another():
    figure = new_figure(figsize=(5, 4))
    axes = figure.subplots()
    x = np.array([0.0, 0.0, 0.0, 0.01, 0.5, 0.98])
    y = np.array([0.0, 0.0, 0.01, 0.0, 0.5, 0.9])
    axes.set_xlim(0, 1)
    axes.set_ylim(-0.03, 1)
    names = ["mass_of_the_trailer", "damping", "road", "wind[3]", "middle", "initial_offset"]
    name_points(axes, names, x, y, x - 0.05, x + 0.05)
    assert sorted(text.get_text() for text in axes.texts) == sorted(names)
    assert faults(figure) == []
