"""The laws of a domain."""

import operator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from verifai_jax.core.values.cube import Cube
from verifai_jax.features import Domain
from verifai_jax.testing.laws import same


def check_domain(domain: Domain, *, samples: int = 64, seed: int = 0) -> None:
    """Check the laws of a domain on random points and on the corners of its cube.

    **Arguments:**
    - `domain`: the domain to check.
    - `samples`: number of random points.
    - `seed`: the seed of the points.
    **Raises:** `AssertionError` naming the broken law.
    """
    size, levels = domain.size, np.array(domain.levels, int)
    assert size == len(levels), "size must be the number of levels"
    assert np.all(levels >= 0), f"levels must not be negative; got {levels.tolist()}"
    for name in ("weights", "ordered"):
        entries = getattr(domain, name)
        assert len(entries) == size, f"{name} must have {size} entries; got {len(entries)}"
    labels = domain.coordinates("value")
    assert len(set(labels)) == size, f"coordinates must be {size} different names; got {labels}"
    # Refuses weights that do not go with the levels, and lengths that are not discrete.
    cube = Cube(domain.levels, domain.weights, domain.ordered, labels, domain.lengths)
    u = jax.random.uniform(jax.random.key(seed), (samples, size), jnp.float32)
    u = jnp.concatenate([u, jnp.zeros((1, size)), jnp.ones((1, size))])

    def round_trip(u: Array) -> tuple[PyTree, Array, PyTree]:
        value = domain.from_unit(u)
        back = domain.to_unit(value)
        return value, back, domain.from_unit(back)

    both = jax.jit(jax.vmap(round_trip))
    values, back, again = both(u)
    assert back.shape == u.shape, f"to_unit must give shape [{size}]; got {list(back.shape[1:])}"
    assert bool(jnp.all((back >= 0) & (back <= 1))), "to_unit must stay in [0, 1]"
    same(values, again, "from_unit(to_unit(value)) must be the value")
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(values)), (
        "values must be finite, at the corners of the cube too"
    )
    alone = jax.jit(domain.from_unit)
    for i in (0, 1, -1):
        value = jax.tree.map(operator.itemgetter(i), values)
        same(value, alone(u[i]), "from_unit must give the same alone and under vmap")
    # With all lengths at their most, every coordinate matters.
    longest = u.at[:, list(domain.lengths)].set(1.0)
    np.testing.assert_allclose(
        np.asarray(both(longest)[1])[:, cube.discrete], cube.centres(cube.cells(longest)),
        atol=1e-6, err_msg="to_unit(from_unit(u)) must be the middle of the cell of u",
    )  # fmt: skip
    columns = domain.columns("value")
    rows = domain.to_columns(jax.tree.map(np.asarray, values), "value")
    assert tuple(rows) == columns, f"to_columns must give {columns}; got {tuple(rows)}"
    one = domain.to_columns(jax.tree.map(lambda leaf: np.asarray(leaf)[:1], values), "value")
    for name, column in rows.items():
        assert column.shape == (len(u),), f"column {name} must have shape [{len(u)}]"
        assert column.dtype == one[name].dtype, f"column {name} must have one dtype in all batches"
    for i in (0, 1, -2, -1):
        value = jax.tree.map(operator.itemgetter(i), values)
        row = {name: column[i] for name, column in rows.items()}
        stored = domain.from_columns(row, "value")
        same(
            value, stored, "from_columns must give back exactly what to_columns stored", exact=True
        )
        domain.check(value, "value")
        same(value, domain.coerce(value), "coerce must keep what from_unit gives", exact=True)
