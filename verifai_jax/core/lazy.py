"""The one late binding: what a result does through rooms above its own, such as drawing itself.

    plot_replay = late("verifai_jax.plotting.replay", "plot_replay")
    plot_replay(replay, path)                           # the module is imported now, not before

A result lies below the pictures and analyses of it. Its methods reach them through this function,
so that imports point downwards and a reader finds every exception by its name.
"""

import importlib
from typing import Any


def late(module: str, name: str) -> Any:
    """Import `module` now and return what it calls `name`."""
    return getattr(importlib.import_module(module), name)
