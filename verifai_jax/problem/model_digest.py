"""The identity of a problem's simulation, without its formulas."""

import jax

from verifai_jax.core.compute.fingerprint import fingerprint, identity, stable_text
from verifai_jax.problem.problem import Problem


def digest_of_model(problem: Problem) -> str:
    """Return a hash of the system, the features and the constraint of a problem.

    The hash is taken from the traced program, so other text in the same file does not change it.

    **Returns:** hexadecimal digits; empty for a black box, and where JAX cannot look into a part.
    """
    if problem.black_box:
        return ""
    space = problem.space
    programs = [problem.traced()[0]]
    if space.where is not None:
        programs.append(jax.make_jaxpr(space.accepts)(space.feature_form))
    hashes = [fingerprint(each, derivatives=False) for each in programs]
    if None in hashes:
        return ""
    domains = {name: stable_text(each) for name, each in space.domains.items()}
    return identity(*hashes, domains, stable_text(problem.form()), problem.end) or ""
