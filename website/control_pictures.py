"""The picture of docs/control_requirements.md, from the traces of its first block.

python website/control_pictures.py
"""

import re
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot

PAGE = Path(__file__).resolve().parents[1] / "docs" / "control_requirements.md"


def main() -> None:
    """Draw for each requirement the step that satisfies it and the one that breaks it."""
    code = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)[0]
    names: dict = {}
    exec(code.partition("for name, (")[0], names)
    cases, good, t = names["cases"], names["good"], names["t"]
    figure, axes = pyplot.subplots(2, 4, figsize=(9.6, 3.8), layout="constrained", sharex=True)
    bands = {
        "settling": (2, 10, 0.95, 1.05), "overshoot": (0, 10, 0, 1.1),
        "rise time": (0, 1, 0.9, 1.1),
        "steady-state error": (8, 10, 0.98, 1.02), "oscillation": (5, 10, 0.975, 1.025),
    }  # fmt: skip
    for ax, (name, (_, bad)) in zip(axes.flat, cases.items(), strict=False):
        shown = {"effort": "u", "Lyapunov": "V"}.get(name, "y")
        if name in bands:
            left, right, low, high = bands[name]
            ax.fill_between([left, right], low, high, color="0.85", lw=0, label="asked for")
        ax.plot(t, good[shown], color="#1b6ca8", lw=1, label="holds")
        ax.plot(t, bad[shown], color="#c0392b", lw=1, label="fails")
        ax.set_title(name, fontsize=9)
        ax.set_ylabel(shown, fontsize=8, rotation=0)
        ax.tick_params(labelsize=7)
    figure.supxlabel("time [s]", fontsize=8)
    axes[0, 3].tick_params(labelbottom=True)  # The panel below it is the legend.
    axes[1, 3].axis("off")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    axes[1, 3].legend(handles, labels, loc="center", frameon=False, fontsize=9)
    figure.savefig(PAGE.with_suffix(".png"), dpi=80, pil_kwargs={"optimize": True})


if __name__ == "__main__":
    main()
