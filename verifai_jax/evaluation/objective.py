"""The robustness of a problem as a pure function, for your own optimisers and samplers.

    rho = objective(problem, mtl.smooth(0.1), of="unit")
    rho(u)                                              # u[dim] -> a number; positive, it holds
    jax.grad(rho)(u), jax.vmap(rho)(us), jax.jit(rho)

The searches of this package use the engine, which batches, pads and counts. This function returns
the same number without these, so that JAX can transform it.
"""

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from verifai_jax.core.compute.keys import IMPLEMENTATION
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.core.messages.errors import check_names
from verifai_jax.evaluation.backends import resolved
from verifai_jax.evaluation.verdicts import trace_verdict
from verifai_jax.mtl import hard
from verifai_jax.mtl.semantics import Semantics
from verifai_jax.problem.problem import Problem, ProblemError

ARGUMENTS = ("unit", "features")
"""Arguments of an objective: a point of the unit cube, or features by name."""
Point: TypeAlias = Float[Any, " dim"] | Mapping[str, Any]
"""A point `[dim]` of the unit cube, or features by name."""


def objective(
    problem: Problem, semantics: Semantics = hard, of: str = "unit",
    key: Key[Array, ""] | None = None, formula: str | None = None,
) -> Callable[..., Float[Array, ""]]:  # fmt: skip
    """Return the robustness of one simulation as a function `(point, key=key)`.

    If the problem's system has several backends, the one that JAX traces is used.

    **Arguments**, **Returns**, **Raises:** those of `Problem.objective`.
    """
    check_names("argument of an objective", [of], ARGUMENTS)
    if not isinstance(semantics, Semantics):
        raise TypeError(f"semantics is mtl.hard or mtl.smooth(0.1); got {semantics!r}")
    names = list(problem.formulas)
    if formula is not None:
        check_names("formula", [formula], names)
    traced = resolved(problem, gradient=True).problem
    if traced.black_box:
        raise ProblemError(
            f"problem {problem.name!r} has no objective: its system runs on the host, where JAX "
            "cannot trace it; vj.falsify searches it without gradients"
        )
    traced.check()
    usual = jax.random.key(0, impl=IMPLEMENTATION) if key is None else key

    def robustness_at(point: Point, key: Key[Array, ""] = usual) -> Float[Array, ""]:
        with in_precision("float64" if jax.config.read("jax_enable_x64") else "float32"):
            features = _features(traced, point, of)
            rho, _ = trace_verdict(traced, traced.system(features, key), semantics)
            return jnp.min(rho) if formula is None else rho[names.index(formula)]

    return robustness_at


def _features(problem: Problem, point: Point, of: str) -> dict[str, Any]:
    """Return the features of a simulation from the argument of an objective."""
    by_name = isinstance(point, Mapping)
    if by_name != (of == "features"):
        other, form = ("features", "a dictionary") if by_name else ("unit", "an array")
        raise ProblemError(
            f"this objective of problem {problem.name!r} is a function of="
            f"{of!r} and got {form}; objective(..., of={other!r}) takes one"
        )
    return (
        problem.space.convert(point)
        if isinstance(point, Mapping)
        else (problem.space.unflatten(point))
    )
