"""Text for people: numbers, shares, features and errors in one line."""

import math
from collections.abc import Mapping

import numpy as np


def format_percent(share: float) -> str:
    """Write a share as a percentage of three digits: `3.8 %`, `0.00171 %`, `>99.9 %`.

    Only a share of exactly 1 is written `100 %`; one that is not finite is `unknown`.
    """
    if not math.isfinite(share):
        return "unknown"
    percent = 100 * share
    # Between 99.95 and 100 three digits would round to 100.
    if 99.95 <= percent < 100:
        return ">99.9 %"
    return f"{percent:.3g} %"


def format_features(features: Mapping[str, object]) -> str:
    """Write features with four digits: `x0=0.1353, alg=sac`."""
    return ", ".join(
        f"{name}={value:.4g}" if isinstance(value, (float, np.floating)) else f"{name}={value}"
        for name, value in features.items()
    )


def format_error(error: BaseException) -> str:
    """Write an exception in one line: its type and the first line of its message."""
    first = (str(error).splitlines() or [""])[0]
    return f"{type(error).__name__}: {first}" if first else type(error).__name__


def shorten(text: str, most: int = 60) -> str:
    """Shorten a text to at most so many characters by leaving out some before its end.

    The end of a name says more than its middle.
    """
    return text if len(text) <= most else f"{text[: most // 3]}...{text[len(text) - most // 2 :]}"
