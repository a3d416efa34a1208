"""The contract suites find what they are there to find."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from verifai_jax.core.values.cube import Cube
from verifai_jax.features import Box
from verifai_jax.search import Search, Uniform
from verifai_jax.testing import check_batch_independence, check_domain, check_search

CUBE = Cube((0, 0))


@dataclasses.dataclass(frozen=True, repr=False)
class Crooked(Box):
    """A box with one law broken."""

    flaw: str = ""

    def from_unit(self, u):
        return super().from_unit(u**2 if self.flaw == "round trip" else u)

    def to_unit(self, value):
        return super().to_unit(value) + (2 if self.flaw == "range" else 0)

    def to_columns(self, values, name):
        name = "other" if self.flaw == "names" else name
        return super().to_columns(values + (1 if self.flaw == "table" else 0), name)


@pytest.mark.parametrize(
    ("flaw", "message"),
    [
        ("round trip", r"from_unit\(to_unit\(value\)\) must be the value"),
        ("range", r"to_unit must stay in \[0, 1\]"),
        ("names", "to_columns must give"),
        ("table", "exactly what to_columns stored"),
    ],
)
def test_domains(flaw, message):
    with pytest.raises(AssertionError, match=message):
        check_domain(Crooked(1, 3, flaw=flaw))


@dataclasses.dataclass(frozen=True)
class Wayward(Search):
    """A search with one law broken: it moves by the mean robustness, or worse."""

    flaw: str = ""

    def total(self, cube):
        return 0 if self.flaw == "total" else None

    def warm_start(self, state, cube, observations):
        return {} if self.flaw == "warm_start" else state

    def init(self, key, cube, batch):
        return {"key": key, "shift": jnp.zeros((), jnp.float32)}

    def ask(self, state, cube, batch):
        key, next_key = jax.random.split(state["key"])
        rows = batch + 1 if self.flaw == "shape" else batch
        u = jax.random.uniform(key, (rows, cube.dim)) + state["shift"]
        if self.flaw != "range":
            u = jnp.clip(u, 0, 1)
        return u, {**state, "key": next_key}

    def tell(self, state, cube, observations):
        weight = 1.0 if self.flaw == "padding" else observations.valid
        rho = jnp.where(weight, observations.rho, 0.0)
        shift = jnp.nan_to_num(jnp.mean(jnp.abs(rho)))
        if self.flaw == "types":
            shift = shift.astype(jnp.float16)
        return {**state, "shift": shift}


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("flaw", "message"),
    [
        ("shape", r"ask must give shape \[16, 2\]; got \[17, 2\]"),
        ("range", r"points must stay in \[0, 1\]"),
        ("types", "tell must keep the types of the state"),
        ("padding", "rows that are not valid must not influence the search"),
        ("total", "total must be None or a positive integer; got 0"),
        ("warm_start", "warm_start must keep the state's form"),
    ],
)
def test_searches(flaw, message):
    with pytest.raises(AssertionError, match=message):
        check_search(Wayward(flaw), CUBE)


def test_what_is_right_passes():
    check_domain(Crooked(1, 3))
    check_search(Wayward(), CUBE)
    check_search(Uniform(), CUBE)


@pytest.mark.thorough
def test_batches_that_matter():
    with pytest.raises(AssertionError, match="must not depend on the batch size"):
        check_batch_independence(Wayward(), CUBE)
