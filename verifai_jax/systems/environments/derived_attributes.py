"""Attributes that Gymnasium's environments compute from others when they are made."""

from collections.abc import Callable
from typing import Any

# What environments compute once from their attributes, and would not follow a feature.
DERIVED: dict[str, dict[str, Callable[[Any], Any]]] = {
    "CartPoleEnv": {
        "total_mass": lambda env: env.masspole + env.masscart,
        "polemass_length": lambda env: env.masspole * env.length,
    }
}
