"""The part that each feature has in a failure."""

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
    """Return when each coordinate of a signal acts; None for other domains.

    A point between two lines acts from the point before to the one after; see `Signal.spans`.
    """
    spans = domain.spans(duration)
    if spans is None:
        return None
    each = domain.size // len(spans)
    return tuple(Span(*span) for span in spans for _ in range(each))


@dataclass(frozen=True)
class Influence:
    """The part of one feature in a failure.

    **Fields:** `name`; `value` and `nominal`, as a table has them, one for each column; `spans`:
    when each coordinate acts, for the control points of a signal, else None; `reverted`: the
    robustness with the whole feature back at nominal; `each` `[k]`: with one of its coordinates
    back; `slopes` `[k]`: derivative of the smooth robustness by each of its real numbers, in their
    own unit, at the row; `gradient` `[k]`: the same over the whole range of each (for a
    distribution, twice the range of its middle half). Unknown numbers are NaN. `gone`: whether the
    failure vanishes with the whole feature back; `departs`: whether the feature is not nominal;
    `each_gone`: whether the failure vanishes with one coordinate back.
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
        """Return by how much the feature moves the robustness `rho` of the row.

        That of the whole feature back at nominal, or where it is not known its steepest gradient.
        """
        if np.isfinite(self.reverted):
            return self.reverted - rho
        return float(np.nan_to_num(np.abs(self.gradient)).max(initial=0.0))
