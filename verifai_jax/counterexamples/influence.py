"""The contribution of each feature to a failure."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from verifai_jax.features import Domain


class Span(NamedTuple):
    """The time during which a control point acts, in seconds."""

    begin: float
    end: float


def spans_of(domain: Domain, duration: float) -> tuple[Span, ...] | None:
    """Return the span in which each coordinate of a signal acts; None for other domains.

    With linear interpolation a control point acts from the one before it to the one after it; see
    `Signal.spans`.
    """
    spans = domain.spans(duration)
    if spans is None:
        return None
    each = domain.size // len(spans)
    return tuple(Span(*span) for span in spans for _ in range(each))


@dataclass(frozen=True)
class Influence:
    """The influence of one feature on a failure.

    **Fields:** `name`; `value` and `nominal` in the columns of a table; `spans`: when each
    coordinate acts, for the control points of a signal, else None; `reverted`: the robustness with
    the whole feature reset to nominal; `each` `[k]`: with one of its coordinates reset; `slopes`
    `[k]`: derivative of the smooth robustness with respect to each of its real numbers, in their
    own unit, at the row; `gradient` `[k]`: the same over the whole range of each (for a
    distribution, twice its interquartile range). Unknown numbers are NaN. `gone`: whether the
    failure vanishes when the whole feature is reset; `departs`: whether the feature is not nominal;
    `each_gone`: whether the failure vanishes when one coordinate is reset.
    """

    name: str
    coordinates: tuple[str, ...]
    value: tuple[Any, ...]
    nominal: tuple[Any, ...]
    spans: tuple[Span, ...] | None
    reverted: float
    gone: bool
    departs: bool
    each: Float[np.ndarray, " k"]
    each_gone: tuple[bool, ...]
    gradient: Float[np.ndarray, " k"]
    slopes: Float[np.ndarray, " k"]

    def effect(self, rho: float) -> float:
        """Return how much the feature changes the robustness `rho` of the row.

        The change is that of resetting the whole feature to nominal, or its steepest gradient if
        that is unknown.
        """
        if np.isfinite(self.reverted):
            return self.reverted - rho
        return float(np.nan_to_num(np.abs(self.gradient)).max(initial=0.0))
