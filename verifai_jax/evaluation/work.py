"""The counted work of a program, which decides whether native compilation pays."""

from typing import Any

import numpy as np
from jax.extend.core import Jaxpr

from verifai_jax.core.compute.fingerprint import programs_in


def work_of(program: Jaxpr) -> int:
    """Count the scalar operations of a `Jaxpr`; those in loops count as often as they run.

    For a loop with a condition one iteration counts, for a conditional all branches.
    """
    count = 0
    for step in program.eqns:
        inside = sum(map(work_of, programs_in(step)))
        if inside:
            count += inside * int(step.params.get("length", 1))
        else:
            shapes: list[Any] = [each.aval for each in step.outvars]
            count += sum(int(np.prod(each.shape)) for each in shapes)
    return count
