"""Pictures of an augmentation: its arms with intervals, and the images that were added."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from verifai_jax.addons.training.augmentation.examples import Examples
from verifai_jax.addons.training.augmentation.result import Augmentation
from verifai_jax.addons.training.augmentation.summary import SHARES
from verifai_jax.core.display.figure import Figure
from verifai_jax.core.messages.checks import check_count
from verifai_jax.pictures.style import BOUND, FAILING, SAFE, new_figure, show_or_save, tidy


def plot_arms(
    result: Augmentation, path: str | Path | None = None, metric: str = "error",
    reference: str = "none",
) -> Figure:  # fmt: skip
    """Draw a metric of each arm and seed, and the paired differences; see `Augmentation.plot`."""
    differences = result.compare(metric, reference)
    arms = [str(arm) for arm in result.table["arm"].unique()]
    figure = new_figure(figsize=(9.0, 1.2 + 0.34 * len(arms)))
    left, right = figure.subplots(1, 2, sharey=True)
    scale, unit = (100.0, " (%)") if metric in SHARES else (1.0, "")
    for height, arm in enumerate(arms):
        values = result.table.loc[result.table["arm"] == arm, metric].to_numpy(np.float64)
        left.plot(scale * values, np.full(len(values), height), "o", color=BOUND, alpha=0.35, ms=4)
        if np.isfinite(values).any():
            left.plot(scale * np.nanmean(values), height, "|", color=BOUND, ms=15, mew=2)
        difference = differences.get(arm)
        if difference is None or not difference.pairs:
            continue
        color = SAFE if difference.negative else FAILING if difference.positive else BOUND
        if np.isfinite(difference.low):
            ends = [scale * difference.low, scale * difference.high]
            right.plot(ends, [height, height], color=color, linewidth=3, alpha=0.5)
        right.plot(scale * difference.mean, height, "o", color=color)
    left.set_yticks(range(len(arms)), [arm.replace("_", " ") for arm in arms])
    # The marks of the first and the last arm are as high as a row.
    left.set_ylim(len(arms) - 0.4, -0.6)
    label = metric.replace("_", " ")
    left.set_xlabel(f"{label}{unit}: seeds and their mean")
    points = " (points)" if metric in SHARES else ""
    sure = f"{100 * result.confidence:zg} % t interval"
    right.set_xlabel(f"{label} minus that of {reference}{points}, {sure}")
    right.axvline(0, color=BOUND, linewidth=0.8, linestyle=":")
    for axes in (left, right):
        tidy(axes)
    figure.suptitle(result.task.name, fontsize=10)
    return show_or_save(figure, path)


def plot_montage(
    result: Augmentation, path: str | Path | None = None, arm: str = "counterexamples",
    seed: int = 0, count: int = 24,
) -> Figure:  # fmt: skip
    """Draw images that an arm added; see `Augmentation.montage`."""
    check_count("count", count)
    examples = result.examples(arm, seed)
    if not len(examples):
        raise ValueError(f"the arm {arm!r} added no inputs in seed {seed}")
    images = _images(examples)[:count]
    columns = min(6, len(images))
    rows = -(-len(images) // columns)
    height, width = images.shape[1:3]
    figure = new_figure(figsize=(1.6 * columns, 1.6 * rows * height / width + 0.4))
    panels: list[Axes] = list(np.ravel(figure.subplots(rows, columns, squeeze=False)))
    for axes, image in zip(panels, images, strict=False):
        axes.imshow(image, cmap=None if image.ndim == 3 else "gray", vmin=0, vmax=1)
    for axes in panels:
        axes.set_axis_off()
    figure.suptitle(f"{result.task.name}: {len(images)} of {len(examples)}, {arm}", fontsize=10)
    return show_or_save(figure, path)


def _images(examples: Examples) -> np.ndarray:
    """Return inputs as images `[n, height, width]` or `[n, height, width, 3 or 4]`, from 0 to 1."""
    images = examples.inputs
    shape = getattr(images, "shape", None)
    channels = shape[3] if shape is not None and len(shape) == 4 else 1
    if shape is None or len(shape) not in (3, 4) or channels not in (1, 3, 4):
        given = type(images).__name__ if shape is None else f"shape {list(shape[1:])}"
        raise ValueError(
            "a montage needs inputs that are images [height, width] or [height, width, channels], "
            f"with 1, 3 or 4 channels; got {given}"
        )
    images = np.asarray(images)
    images = images[..., 0] if len(shape) == 4 and channels == 1 else images
    return np.clip(images / 255.0 if images.dtype.kind in "iu" else images, 0.0, 1.0)
