"""Any Python function as a system: a simulator that JAX cannot see into.

    blackbox(simulate)                       # simulate(features) -> Trace
    blackbox(simulate, seeded=True)          # simulate(features, seed) -> Trace

Exceptions are for the caller to record; one simulation that raises must not end the run.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import numpy as np

from verifai_jax.trace import Trace


@dataclass(frozen=True, eq=False)
class BlackBox:
    """A host-side system; made by `blackbox`. Simulated row by row, never traced by JAX."""

    black_box: ClassVar[bool] = True
    function: Callable[..., Trace]
    seeded: bool = False

    def __call__(self, features: Any, key: Any = None) -> Trace:
        """Simulate once, with features as plain Python and NumPy values.

        `key`: a JAX random key, or an integer seed.
        """
        plain = jax.tree.map(_plain, features)
        return self.function(plain, _seed(key)) if self.seeded else self.function(plain)


def blackbox(function: Callable[..., Trace], *, seeded: bool = False) -> BlackBox:
    """Mark a Python function as a system that runs on the host.

    **Arguments:**

    - `function(features) -> Trace`: numbers arrive as `float` and `int`, arrays as NumPy.
    - `seeded`: call `function(features, seed)` with an integer seed in `[0, 2^32)` of the
      simulation, the same on every replay.

    **Raises:** `ValueError` for something that is not callable.
    """
    if not callable(function):
        raise ValueError(f"blackbox needs a function (features) -> Trace; got {function!r}")
    return BlackBox(function, seeded)


def _plain(leaf: Any) -> Any:
    if not isinstance(leaf, jax.Array | np.ndarray | np.generic):
        return leaf
    return np.asarray(leaf).item() if np.ndim(leaf) == 0 else np.asarray(leaf)


def _seed(key: Any) -> int:
    if isinstance(key, int | np.integer):
        return int(key)
    if key is None:
        return 0
    return int(jax.random.bits(key))
