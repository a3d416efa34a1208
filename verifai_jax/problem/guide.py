"""A user's term that steers a search in addition to the robustness, and decides nothing.

    Guide("always distance > 10")                       # its robustness
    Guide(lambda trace, features: trace["speed"].min(), weight=0.8, scale=5.0)

If the robustness gives little guidance, users may know what leads to a failure. A search receives a
weighted sum of robustness and term, as in ATheNA, which combines fitness generated from the
requirement with fitness defined by an engineer (Formica, Fan, Menghi, Search-based software testing
driven by automatically generated and manually defined fitness functions, ACM Transactions on
Software Engineering and Methodology, arXiv:2207.11016, 2022). The term does not affect verdicts,
the robustness of the table, confirmation or estimates.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from verifai_jax.core.messages.checks import check_fraction, check_positive
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import Formula, hard, parse, robustness
from verifai_jax.mtl.evaluate import End

Term = Callable[[Trace, Mapping[str, PyTree]], Float[Array, ""] | float]
"""A function of a trace and the features to a number, less where it is nearer to a failure."""


@dataclass(frozen=True, init=False)
class Guide:
    """A term that steers a search.

    The search receives `(1 - weight) * robustness + weight * t` of a simulation that keeps the
    property, where `t = (1 + g / (abs(g) + scale)) / 2` lies between 0 and 1 and rises with the
    term's value `g`; so a safe simulation never looks like a failure. For a simulation that breaks
    the property it receives the robustness.

    **Arguments:**
    - `term`: a formula or its text, whose robustness is the value of the term; or a pure function
      of the trace and the features that JAX can trace, even if the system is a black box. Lower
      values mean nearer to a failure.
    - `weight`: the weight of the term, above 0; with 1 the search ignores the robustness of safe
      simulations.
    - `scale`: the size of differences of the term that matter, in its unit.
    **Raises:** `TypeError` for a term of another type; `ValueError` for a formula that does not
    parse, or numbers out of range.
    """

    term: Formula | Term
    weight: float
    scale: float

    def __init__(
        self, term: "Formula | str | Term", weight: float = 0.5, scale: float = 1.0
    ) -> None:
        if isinstance(term, str):
            term = parse(term)
        if not isinstance(term, Formula) and not callable(term):
            raise TypeError(
                "a guide must be a formula, its text, or a function of a trace and the features; "
                f"got {term!r}"
            )
        check_fraction("weight of a guide", weight, one=True)
        check_positive("scale of a guide", scale, finite=True)
        object.__setattr__(self, "term", term)
        object.__setattr__(self, "weight", float(weight))
        object.__setattr__(self, "scale", float(scale))

    def value(
        self, trace: Trace, features: Mapping[str, PyTree], end: End = "hold"
    ) -> Float[Array, ""]:
        """Return the value of the term on one trace; traced by JAX.

        **Raises:** the errors of the formula, such as that for an unknown signal; `TypeError` for a
        function that returns no number.
        """
        if isinstance(self.term, Formula):
            return robustness(self.term, trace, hard, end)
        value = jnp.asarray(self.term(trace, features))
        if value.shape != ():
            raise TypeError(
                f"the guide {self.describe()} must return one number; got shape {list(value.shape)}"
            )
        return value.astype(jnp.result_type(float))

    def share(self, value: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return the contribution of a value of the term, between 0 and 1; 1 for NaN."""
        part = value / (jnp.abs(value) + self.scale)
        # An infinite value is the end of what can be added.
        part = jnp.where(jnp.isinf(value), jnp.sign(value), part)
        return jnp.where(jnp.isnan(value), 1.0, 0.5 * (1 + part))

    def steer(
        self, observed: Float[np.ndarray, " n"], value: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        """Return the numbers that the search receives; failures and rows without a verdict stay.

        **Arguments:**
        - `observed`: the robustness, or the objective of the search.
        - `value`: the value of the term.
        """
        # In NumPy: of an array of JAX each first use of this kind compiles a program.
        known = np.where(np.isfinite(value), value, 0.0).astype(np.float64)
        part = np.where(np.isinf(value), np.sign(value), known / (np.abs(known) + self.scale))
        share = np.where(np.isnan(value), 1.0, 0.5 * (1 + part))
        steered = (1 - self.weight) * observed + self.weight * share
        return np.where(observed >= 0, steered, observed).astype(observed.dtype)

    def describe(self) -> str:
        """Return the formula, or the name of the function."""
        if isinstance(self.term, Formula):
            return str(self.term)
        name = getattr(self.term, "__qualname__", type(self.term).__qualname__)
        return f"{getattr(self.term, '__module__', None) or '__main__'}:{name}"

    def to_json(self) -> dict[str, Any]:
        """Describe the guide as plain data, for the record."""
        return {"term": self.describe(), "weight": self.weight, "scale": self.scale}
