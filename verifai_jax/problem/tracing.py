"""Questions about a system that JAX traces.

traced_by_default(system)                           # whether JAX traces the system itself
why_not_batched(program)                            # what jax.vmap refuses, and the remedy
"""

from collections.abc import Mapping
from typing import Any

import jax

from verifai_jax.core.compute.fingerprint import alone_only, describe_step, fingerprint
from verifai_jax.core.compute.precision import reproducible_settings, truncate_silently
from verifai_jax.systems.base import System


def traced_by_default(system: System) -> bool:
    """Return whether the shapes of the system's traces come from tracing it with JAX."""
    function = getattr(system, "function", None)
    return type(system).abstract is System.abstract or (
        function is not None and not callable(getattr(function, "abstract", None))
    )


def why_not_batched(program: Any) -> str | None:
    """Return the step of a program that JAX takes for one simulation at a time only, and a remedy.

    None if all steps can be batched.
    """
    for step, error in alone_only(program):
        does = step.primitive.name
        said = str(error).strip().partition("\n")[0].rstrip(".")
        if does == "pure_callback":
            said, cure = "it has no vmap_method", "give it vmap_method='sequential'"
        elif does == "io_callback" and step.params.get("ordered"):
            cure = "write ordered=False"
        else:
            cure = "give the operation a rule for jax.vmap"
        return (
            f"{describe_step(step)} is for one simulation at a time ({said}); {cure}, or make the "
            "system a vj.blackbox, which JAX does not trace"
        )
    return None


@reproducible_settings()
@truncate_silently()
def fingerprint_of(system: System, features: Mapping[str, Any]) -> str:
    """Return the fingerprint of a system's program, with all of its constants.

    Empty for a system that is not traced for its form, and for one that raises, of which
    `Problem.check` says why.

    - `features`: the form of the features.
    """
    if system.black_box or not traced_by_default(system):
        return ""
    try:
        # Traced already, for its form.
        program = jax.make_jaxpr(system)(features, jax.eval_shape(lambda: jax.random.key(0)))
    except Exception:
        return ""
    return fingerprint(program, derivatives=False) or ""
