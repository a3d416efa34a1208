"""The leaf of a Scenic distribution: its kind of random value, and its domain."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from verifai_jax.addons.scenic import leaves
from verifai_jax.addons.scenic.graph import field, is_random, kind_of, law
from verifai_jax.features import Box, Categorical, Constant, DiscreteBox, Normal, TruncatedNormal
from verifai_jax.features.domain import MAX_LEVELS, Domain


def leaf_of(node: Any, name: str, options: Sequence[Any] | None = None) -> leaves.Leaf | None:
    """Return a random node as a leaf with an inverse; None if it has no inverse.

    **Arguments:**
    - `node`: the node in Scenic's graph.
    - `name`: the name of the leaf.
    - `options`: the options of a selector node.
    """
    drawn = law(node)
    match kind_of(drawn):
        case "Range":
            if is_random(field(drawn, "low")) or is_random(field(drawn, "high")):
                return leaves.Share(node, name, {f"{name}.share": Box(0, 1)})
            return leaves.Number(
                node, name, {name: _between(field(drawn, "low"), field(drawn, "high"))}
            )
        case "Normal":
            mean, std = field(drawn, "mean"), field(drawn, "stddev")
            if is_random(mean) or is_random(std):
                return leaves.Deviation(node, name, {f"{name}.deviation": Normal(0, 1)})
            if std <= 0:
                return (
                    leaves.Number(node, name, {name: Constant(float(mean))}) if std == 0 else None
                )
            return leaves.Number(node, name, {name: Normal(float(mean), float(std))})
        case "TruncatedNormal":
            return _truncated(node, name)
        case "DiscreteRange":
            low, high = field(drawn, "low"), field(drawn, "high")
            if is_random(low) or is_random(high):
                return leaves.ChoiceIndex(node, name, {f"{name}.share": Box(0, 1)})
            return _discrete(node, name, low, high, field(drawn, "weights"), options)
        case "VerifaiRange":
            if field(drawn, "probs") is not None:
                return leaves.Histogram(node, name, {f"{name}.share": Box(0, 1)})
            ((low, high),) = field(drawn, "domain").intervals
            return leaves.Number(node, name, {name: _between(low, high)})
        case "VerifaiDiscreteRange":
            ((low, high),) = field(drawn, "domain").intervals
            return _discrete(node, name, low, high, field(drawn, "probs"), options)
        case "PointInRegionDistribution":
            return _point(node, name)
    return None


def _between(low: float, high: float) -> Domain:
    low, high = sorted((float(low), float(high)))
    return Constant(low) if low == high else Box(low, high)


def _truncated(node: Any, name: str) -> leaves.Leaf:
    drawn = law(node)
    mean, std = field(drawn, "mean"), field(drawn, "stddev")
    if not (is_random(mean) or is_random(std)):
        low, high = field(drawn, "low"), field(drawn, "high")
        try:
            domain = TruncatedNormal(float(mean), float(std), float(low), float(high))
        except ValueError:
            pass  # Uniform but for rounding, or unbounded; the share between the ends is exact.
        else:
            return leaves.Number(node, name, {name: domain})
    return leaves.TruncatedShare(node, name, {f"{name}.share": Box(0, 1)})


def _discrete(
    node: Any, name: str, low: float, high: float, weights: Sequence[float] | None,
    options: Sequence[Any] | None,
) -> leaves.Leaf | None:  # fmt: skip
    first, last = math.ceil(low), math.floor(high)
    if last - first >= MAX_LEVELS:
        return leaves.ChoiceIndex(node, name, {f"{name}.share": Box(0, 1)})
    values = tuple(range(first, last + 1))
    if weights is not None:
        weighted = [(v, w) for v, w in zip(values, weights, strict=True) if w > 0]
        values = tuple(v for v, _ in weighted)
        weights = [w / math.fsum(w for _, w in weighted) for _, w in weighted]
        if len(set(weights)) == 1:
            weights = None
    if not values:
        return None
    labels = None if options is None else _labels([options[value] for value in values])
    if len(values) == 1:
        return leaves.Chosen(
            node, name, {name: Constant(labels[0] if labels else values[0])}, values
        )
    if labels is None and weights is None:
        whole = DiscreteBox(values[0], values[-1])
        return leaves.Chosen(
            node, name, {name: whole}, None if len(values) == whole.levels[0] else values
        )
    return leaves.Chosen(
        node, name, {name: Categorical(*(labels or values), weights=weights)}, values
    )


def _labels(options: Sequence[Any]) -> list[Any]:
    """Return names for options: the numbers or texts themselves, where they are plain."""
    plain = [option for option in map(_plain, options) if option is not None]
    if len(plain) == len(options) and len({str(option) for option in plain}) == len(options):
        numbers = [isinstance(option, int | float) for option in plain]
        if not any(numbers) or (all(numbers) and len(set(map(np.float32, plain))) == len(plain)):
            return plain
    texts = [
        str(_plain(option)) if _plain(option) is not None else _text(option) for option in options
    ]
    return [text if texts.count(text) == 1 else f"{text} ({i + 1})" for i, text in enumerate(texts)]


def _plain(option: Any) -> int | float | str | None:
    if kind_of(option) == "ConstantSamplable":
        option = field(option, "value")
    if isinstance(option, bool) or not isinstance(option, int | float | str):
        return None
    return option if isinstance(option, str) or math.isfinite(option) else None


def _text(option: Any) -> str:
    if kind_of(option) == "ConstantSamplable":
        option = field(option, "value")
    text = getattr(option, "__name__", None) if isinstance(option, type) else None
    if text is None:
        text = kind_of(option) if is_random(option) else repr(option)
    return text if len(text) <= leaves.LABEL else text[: leaves.LABEL - 3] + "..."


def _point(node: Any, name: str) -> leaves.Leaf | None:
    region = leaves.region_of(node)
    constant = not is_random(region)
    kind = kind_of(region)
    if kind == "RectangularRegion":
        width, length = field(region, "width"), field(region, "length")
        if is_random(width) or is_random(length):
            return leaves.InRectangle(
                node, name, {f"{name}.{axis}": Box(-0.5, 0.5) for axis in ("right", "forward")}
            )
        if constant and float(field(region, "heading")) == 0.0:
            x, y = (float(c) for c in field(region, "position").coordinates[:2])
            return leaves.InRectangle(
                node,
                name,
                {
                    f"{name}.x": _between(x - width / 2, x + width / 2),
                    f"{name}.y": _between(y - length / 2, y + length / 2),
                },
            )
        return leaves.InRectangle(
            node,
            name,
            {
                f"{name}.right": _between(-width / 2, width / 2),
                f"{name}.forward": _between(-length / 2, length / 2),
            },
        )
    if kind in ("CircularRegion", "SectorRegion"):
        return leaves.InSector(
            node, name, {f"{name}.{part}": Box(0, 1) for part in ("area", "angle")}
        )
    if kind == "PolygonalRegion" and constant:
        pieces, cumulative = region._samplingData
        triangles = np.array([list(piece.exterior.coords)[:3] for piece, _ in pieces], float)
        shares = np.asarray(cumulative, float) / cumulative[-1]
        domains = {f"{name}.{part}": Box(0, 1) for part in ("piece", "along", "across")}
        return leaves.InPolygon(node, name, domains, triangles[:, :, :2], shares)
    if kind == "PolylineRegion" and constant:
        starts, ends = (
            np.array([segment[end][:2] for segment in region.segments], float) for end in (0, 1)
        )
        cumulative = np.asarray(region.cumulativeLengths, float)
        domain = Box(0, float(cumulative[-1]))
        return leaves.OnPolyline(node, name, {f"{name}.along": domain}, starts, ends, cumulative)
    return None
