"""Picture of a hardening: failure probability and return, round by round."""

from pathlib import Path

from verifai_jax.addons.training.hardening.result import HARDENED, Hardening
from verifai_jax.core.display.figure import Figure
from verifai_jax.pictures.style import BOUND, SAFE, new_figure, show_or_save, tidy


def plot_hardening(result: Hardening, path: str | Path | None = None) -> Figure:
    """Draw the failure probability of each round with its interval, and the mean return."""
    figure = new_figure(figsize=(8.0, 3.2))
    left, right = figure.subplots(1, 2)
    for index, (arm, rows) in enumerate(result.table.groupby("arm", sort=False)):
        color = SAFE if arm == HARDENED else BOUND
        at, rate = rows["round"] + 0.06 * index, 100 * rows["failure_rate"]
        spread = [rate - 100 * rows["failure_low"], 100 * rows["failure_high"] - rate]
        left.errorbar(at, rate, spread, color=color, marker="o", ms=4, label=arm, capsize=2)
        right.plot(at, rows["return"], color=color, marker="o", ms=4, label=arm)
    left.axhline(100 * result.options["p"], color=BOUND, linewidth=0.8, linestyle=":", label="p")
    left.set_yscale("symlog", linthresh=0.1)
    left.set_ylim(bottom=0)
    left.set_ylabel("failure probability (%)")
    right.set_ylabel("mean return")
    for axes in (left, right):
        axes.set_xlabel("round")
        axes.xaxis.get_major_locator().set_params(integer=True)
        axes.legend(frameon=False, fontsize=8)
        tidy(axes)
    figure.suptitle(result.problem, fontsize=10)
    return show_or_save(figure, path)
