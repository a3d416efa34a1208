"""The work of a program, counted: which decides whether a native one is worth its compilation."""

import numpy as np

from verifai_jax.core.compute.fingerprint import programs_in
from verifai_jax.evaluation.native_code.values import Program


def work_of(program: Program) -> int:
    """Count the operations on single numbers of a `Jaxpr`: those of loops as often as they run.

    Of a loop that ends by its own condition one round is counted, of branches all.
    """
    count = 0
    for step in program.eqns:
        inside = sum(map(work_of, programs_in(step)))
        if inside:
            count += inside * int(step.params.get("length", 1))
        else:
            count += sum(int(np.prod(np.shape(each.aval))) for each in step.outvars)
    return count
