"""Facts of the table columns of a domain, known before any row: their order, bounds and choices.

    Box(0, 2).facts("x")       # {"x": {"ordered": True, "bounds": (0, 2), "range": (0, 2), ...}}

The facts of a column are `ordered` and, of numbers, `bounds` (of the domain), `range` (what is
scaled to `[0, 1]`), `integer`, `uniform` and `length` (the column counts items); of others,
`choices` and `prior`, their probabilities. What is not known is left out.
"""

from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

Facts: TypeAlias = dict[str, dict[str, Any]]
"""What is known of columns, by their names."""


def drawn_facts(domain: Any, name: str) -> Facts:
    """Return bounds from the ends of the coordinates, or those that the domain names.

    For a distribution without ends, such as a normal one, the range leaves out a thousandth of each
    tail.
    """
    if domain.size == 0:
        return {}
    u = jnp.repeat(jnp.array([0.0, 1.0, 0.001, 0.999])[:, None], domain.size, axis=1)
    columns = domain.to_columns(jax.vmap(domain.from_unit)(u), name)
    found: Facts = {}
    for column, entries in columns.items():
        ends = np.asarray(entries)
        if ends.dtype.kind not in "iuf":
            found[column] = {"ordered": False}
            continue
        low, high, near, far = ends.astype(np.float64)
        bounds, inner = sorted((low, high)), sorted((near, far))
        # A distribution names its support; drawn ends are finite even where that is not.
        endless = not np.isfinite(getattr(domain, "support", (np.inf, np.inf))).all()
        found[column] = {
            "ordered": True,
            "bounds": bounds,
            "range": inner if endless else bounds,
            "integer": ends.dtype.kind in "iu",
        }
    return found


def integer_facts(low: int, high: int) -> dict[str, Any]:
    """Return the facts about a column of equally probable integers."""
    ends = (low, high)
    return {"ordered": True, "bounds": ends, "range": ends, "integer": True, "uniform": True}
