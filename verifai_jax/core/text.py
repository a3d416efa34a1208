"""Words and numbers as a person reads them."""

from collections.abc import Mapping
from typing import Any

import numpy as np


def format_features(features: Mapping[str, Any]) -> str:
    """Write features as a person reads them: `x0=0.1353, alg=sac`."""
    return ", ".join(
        f"{name}={value:.4g}" if isinstance(value, (float, np.floating)) else f"{name}={value}"
        for name, value in features.items()
    )


def format_error(error: BaseException) -> str:
    """Write an exception in one line."""
    first = (str(error).splitlines() or [""])[0]
    return f"{type(error).__name__}: {first}" if first else type(error).__name__


def shorten(text: str, most: int = 60) -> str:
    """Shorten a text to at most so many characters by leaving out some before its end.

    The end of a name says more than its middle.
    """
    return text if len(text) <= most else f"{text[: most // 3]}...{text[len(text) - most // 2 :]}"
