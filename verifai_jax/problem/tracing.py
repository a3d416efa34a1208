"""Questions about a system that JAX traces.

traced_by_default(system)                           # whether JAX traces the system itself
why_not_batched(program)                            # what jax.vmap refuses, and the remedy
"""

from collections.abc import Iterable, Mapping
from typing import Any

import jax

from verifai_jax.core.compute.fingerprint import alone_only, describe_step
from verifai_jax.core.compute.precision import truncate_silently
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


@truncate_silently()
def traced(system: System, features: Mapping[str, Any]) -> tuple[Any, Any]:
    """Return the program of a system, of features and a key, and the form of its traces.

    - `features`: the form of the features.
    """
    key = jax.eval_shape(lambda: jax.random.key(0))
    # A new function each time: JAX remembers what it traced by the function.
    return jax.make_jaxpr(lambda *a: system(*a), return_shape=True)(features, key)


def judged_results(trace: Any, names: Iterable[str], status: bool = True) -> list[bool]:
    """Return which results of a system's program verdicts are made of.

    **Arguments:**
    - `trace`: the form of its traces.
    - `names`: the monitored signals.
    - `status`: whether the status counts, too.
    """
    count = len(jax.tree.leaves(trace))
    numbers = jax.tree.unflatten(jax.tree.structure(trace), range(count))
    signals = [numbers.signals[name] for name in names]
    judged = set(jax.tree.leaves((signals, numbers.valid, numbers.status if status else None)))
    return [number in judged for number in range(count)]
