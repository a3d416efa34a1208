"""Delays as options of a simulator: a number of steps, or a feature with its maximum."""

from collections.abc import Mapping
from typing import TypeAlias

from verifai_jax.systems.channels import Side
from verifai_jax.systems.delays import Delay

DelayOption: TypeAlias = int | Mapping[str, int]
"""The option of a delay: a number of steps, or `{feature: greatest number of steps}`."""
NO_DELAY = Delay()
"""An observation that is seen at once, an action that takes effect at once."""


def as_delay(option: DelayOption, name: str) -> Delay:
    """Return the delay given by the option `name`.

    **Raises:** `ValueError` for anything but a number of steps or `{feature: maximum}`.
    """
    side: Side = "action" if name == "action_delay" else "observation"
    feature, steps = None, option
    if isinstance(option, Mapping) and len(option) == 1:
        ((feature, steps),) = option.items()
    if type(steps) is not int or steps < 0 or not isinstance(feature, str | None):
        raise ValueError(
            f"{name} must be a number of steps, or a feature with its maximum number of steps, "
            f"{{'latency': 5}}; got {option!r}"
        )
    return Delay(steps, feature, side)


def links_of(*delays: Delay) -> tuple[Delay, ...]:
    """Return the delays that are not zero."""
    return tuple(delay for delay in delays if delay.max_steps or delay.feature is not None)
