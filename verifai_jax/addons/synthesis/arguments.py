"""The arguments of a synthesis or a repair, checked before anything compiles."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from verifai_jax import search as searches
from verifai_jax.addons.synthesis.parametric import ArrayParameters, FeatureParameters, Parametric
from verifai_jax.core.compute.precision import in_precision
from verifai_jax.core.messages.errors import check_names
from verifai_jax.evaluation.backends import resolved
from verifai_jax.falsification.validation import check_search
from verifai_jax.problem.dependence import without_derivative
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Search

ATTACK = 20_000
"""Simulations of an attack at most, however large the budget."""


def feature_parameters(
    problem: Problem, parameters: Sequence[str] | str | None, gradient: bool | None, batch: int,
    budget: int, precision: str, backend: str | None, seed: int,
) -> FeatureParameters:  # fmt: skip
    """Return the checked problem on its backend, with these features as parameters.

    **Raises:** `ValueError` for invalid arguments, before anything compiles.
    """
    if not isinstance(problem, Problem):
        raise TypeError(f"a Problem is needed; got {type(problem).__name__}")
    in_precision(precision)
    if gradient and problem.black_box:
        raise ValueError(
            f"the system of problem {problem.name!r} is a black box, which has no gradient; leave "
            "gradient out, and parameters are chosen by cross-entropy"
        )
    several = bool(problem.system.backends)
    # With every name known, before a backend is measured.
    FeatureParameters(problem, parameters, batch=batch, gradient=False)
    problem.space.check_where()
    choice = resolved(
        problem, gradient=bool(gradient), batch=batch, budget=budget, precision=precision,
        wanted=backend,
    )  # fmt: skip
    choice.problem.check()
    follows = gradient or (gradient is None and not several)
    lacking = without_derivative(choice.problem) if follows else None
    if gradient and lacking is not None:
        raise ValueError(
            f"the system of problem {problem.name!r} has no gradient: {lacking} has no derivative; "
            "leave gradient out, and parameters are chosen by cross-entropy"
        )
    wanted = bool(follows) and lacking is None
    return FeatureParameters(
        choice.problem, parameters, batch=batch, gradient=wanted, precision=precision, seed=seed
    )


def attack_search(problem: Problem, search: str | Search, loop: Parametric) -> Search:
    """Return the search over the environment, if it can work on this problem.

    **Raises:** `ValueError` for a search that needs clauses, or gradients that the system lacks.
    """
    if isinstance(search, str):
        search = searches.named(search)
    if loop.environment is None:
        return search
    checked = check_search(problem, search) if loop.problem.black_box else search
    if not isinstance(checked, Search):
        raise TypeError(f"attack must be a name or a search like CrossEntropy(); got {search!r}")
    checked.check(loop.environment.cube)
    if checked.wants.clauses or (checked.wants.gradient and not loop.differentiable):
        raise ValueError(
            f"attack {checked!r} needs gradients that are not available here; use a search that "
            "needs none, such as 'cross_entropy', whose worst environments are followed downhill "
            "anyway"
        )
    return checked


def repaired_arrays(
    problem: Any, parameters: Any, system_of: Any, nominal: Any, gradient: Any, batch: int,
    precision: str, seed: int,
) -> ArrayParameters:  # fmt: skip
    """Return the problem with these arrays as parameters of a repair.

    **Raises:** `TypeError` or `ValueError` for invalid arguments.
    """
    if not isinstance(problem, Problem):
        raise TypeError(f"a Problem is needed; got {type(problem).__name__}")
    if nominal is not None:
        raise ValueError("with system_of the parameters are their own nominal values")
    if gradient is False:
        raise ValueError(
            "arrays of parameters are repaired by gradients; leave gradient out, or make the "
            "parameters features of the space"
        )
    problem.space.check_where()
    return ArrayParameters(
        problem, parameters, system_of, batch=batch, precision=precision, seed=seed
    )


def repaired_features(
    problem: Any, names: Any, nominal: Any, gradient: Any, batch: int, budget: int, precision: str,
    backend: Any, seed: int,
) -> tuple[Any, Float[np.ndarray, " p"]]:  # fmt: skip
    """Return the problem with these features as parameters of a repair, and their nominal values.

    **Raises:** `ValueError` for invalid arguments, before anything compiles.
    """
    named = isinstance(names, str) or (
        isinstance(names, Sequence) and all(isinstance(name, str) for name in names)
    )
    if not named or not len(names):
        raise ValueError(
            "parameters must be names of features, at least one; arrays need system_of=, a "
            f"function that makes the system from them; got {names!r}"
        )
    loop = feature_parameters(problem, names, gradient, batch, budget, precision, backend, seed)
    if loop.environment is None:
        raise ValueError(
            "all features are parameters, so no environment is left in which to find "
            "counterexamples; use synthesize"
        )
    check_names("parameter of nominal", nominal or {}, loop.names)
    given = {**(problem.nominal or {}), **(nominal or {})}
    missing = [name for name in loop.names if name not in given]
    if missing:
        raise ValueError(
            f"a repair starts from nominal values; {', '.join(missing)} "
            f"{'has' if len(missing) == 1 else 'have'} none: give nominal={{...}}"
        )
    values = {name: given[name] for name in loop.names}
    for name, value in values.items():
        loop.space[name].check(value, name)
    return loop, loop.begin(values)
