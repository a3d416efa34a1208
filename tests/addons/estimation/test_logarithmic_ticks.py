"""The numbers on logarithmic axes."""

from legible import faults

from verifai_jax.addons.estimation.pictures.estimate import log_ticks
from verifai_jax.pictures.style import new_figure


def test_numbers_on_logarithmic_axes_are_few():
    figure = new_figure(figsize=(4, 3))
    axes = figure.subplots()
    axes.set_xscale("log")
    for low, high in ((0.03, 0.9), (0.2, 0.31), (1e-9, 1.0), (1e-3, 0.02)):
        axes.set_xlim(low, high)
        log_ticks(axes.xaxis)
        assert faults(figure) == []


def test_an_axis_of_less_than_a_decade_has_several_numbers():
    axes = new_figure().add_subplot()
    axes.set_xscale("log")
    axes.set_xlim(0.0947, 0.101)
    log_ticks(axes.xaxis)
    ticks = axes.xaxis.get_major_locator().tick_values(0.0947, 0.101)
    assert sum(0.0947 <= tick <= 0.101 for tick in ticks) >= 3
