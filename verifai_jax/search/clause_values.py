"""Values of clauses as searches compare them."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from verifai_jax.core.values.clauses import ABSENT
from verifai_jax.search.base import Observations

NOTHING = ABSENT / 10
"""Values of clauses below mean that a goal has no such clause. Above `ABSENT`, which is raised
where what a search learns is changed, and below the value of any clause, which has no unit."""


def without_clauses(observations: Observations) -> Observations:
    """Return the observations for members that use no clauses."""
    rho = observations.rho
    if observations.clauses is not None:
        # Where clauses of different units have to be broken together, without unit.
        several = observations.clauses[:, 1] > NOTHING
        greatest = jnp.max(observations.clauses, axis=1)
        rho = jnp.where(several & jnp.isfinite(greatest), greatest, rho)
    return Observations(observations.u, rho, observations.valid)


def comparable_clauses(observed: Observations) -> Float[Array, "n clauses"]:
    """Return the clauses; a single one is replaced by the robustness, whose scale never changes."""
    assert observed.clauses is not None
    several = observed.clauses[:, 1] > NOTHING
    first = jnp.where(several, observed.clauses[:, 0], observed.rho)
    clauses = observed.clauses.at[:, 0].set(first)
    return jnp.where(observed.usable[:, None], clauses, 0.0)
