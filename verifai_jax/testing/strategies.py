"""Features of a space as a strategy of Hypothesis."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from verifai_jax.features import FeatureSpace


def strategy(space: FeatureSpace, nominal: Mapping[str, Any] | None = None) -> Any:
    """Return a Hypothesis strategy for the features of a space, in the form for a system.

    Hypothesis draws each unit coordinate as a number from 0 to 1, from which the features follow by
    inverse cumulative distributions. Examples shrink towards `nominal`, and to few items of arrays
    of variable length, such as events; all satisfy the constraint of the space.

        space = FeatureSpace({"x": Box(-1, 1), "n": DiscreteBox(0, 5)})

        @given(strategy(space, nominal={"x": 0, "n": 0}))
        def test_stays_near(features):
            assert abs(features["x"]) * features["n"] < 4

    **Arguments:**
    - `space`: a feature space.
    - `nominal`: nominal features, towards which examples shrink; by default the middles of the
      domains, and the minimum lengths.
    **Returns:** a `hypothesis.strategies.SearchStrategy` of dictionaries of features.
    **Raises:** `ImportError` without Hypothesis; `ValueError` for nominal features outside it.
    """
    try:
        from hypothesis import strategies
    except ImportError as error:
        raise ImportError("vj.testing.strategy needs Hypothesis: pip install hypothesis") from error
    if not isinstance(space, FeatureSpace):
        raise TypeError(f"strategy needs a FeatureSpace; got {space!r}")
    middle = np.full(space.dim, 0.5, np.float32)
    middle[list(space.lengths)] = 0.0
    if nominal is not None:
        middle = np.array(space.point_of(space.coerce(nominal)))
    # Whether an item is there is drawn by itself, so that each can be shrunk away.
    counted = {length for length, *_ in space.cube.sequences}
    middle[list(counted)] = 1.0

    def point_of(drawn: tuple[tuple[float, ...], tuple[bool, ...]]) -> np.ndarray:
        offsets, kept = drawn
        u = np.clip(middle + np.asarray(offsets, np.float32), 0.0, 1.0).astype(np.float32)[None]
        if space.items:
            u = np.asarray(space.without_items(u, ~np.asarray(kept, bool)[None]))
        return u

    def features_of(u: np.ndarray) -> dict[str, Any]:
        return jax.tree.map(lambda leaf: np.asarray(leaf)[0], space.features_at(u))

    # Zero is what Hypothesis shrinks to. Both ends are reached: often that is where failures are.
    offsets = [
        strategies.just(0.0) if i in counted else strategies.floats(-float(at), 1.0 - float(at))
        for i, at in enumerate(middle)
    ]
    kept = strategies.tuples(*[strategies.booleans()] * space.items)
    points = strategies.tuples(strategies.tuples(*offsets), kept).map(point_of)
    if space.where is not None:
        points = points.filter(lambda u: bool(space.accepts_points(u)[0]))
    return points.map(features_of)
