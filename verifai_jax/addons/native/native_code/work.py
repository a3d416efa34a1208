"""The counted work of a program, which decides whether native compilation pays."""

import numpy as np

from verifai_jax.addons.native.native_code.values import Program
from verifai_jax.core.compute.fingerprint import programs_in


def work_of(program: Program) -> int:
    """Count the scalar operations of a `Jaxpr`; those in loops count as often as they run.

    For a loop with a condition one iteration counts, for a conditional all branches.
    """
    count = 0
    for step in program.eqns:
        inside = sum(map(work_of, programs_in(step)))
        if inside:
            count += inside * int(step.params.get("length", 1))
        else:
            count += sum(int(np.prod(np.shape(each.aval))) for each in step.outvars)
    return count
