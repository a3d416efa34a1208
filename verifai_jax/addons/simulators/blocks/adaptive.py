"""Adaptive and stiff integrators by diffrax, as a `method` of `ode`.

ode(kinetics, start, dt=0.1, duration=10.0, method=adaptive("Kvaerno5", rtol=1e-6))
"""

import inspect
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from verifai_jax.core.messages.checks import check_count, is_number
from verifai_jax.core.messages.errors import require, unknown_name
from verifai_jax.systems.ode.integrators import Derivative, Integrator, Step, Time


def adaptive(
    solver: str = "Tsit5", *, rtol: float = 1e-6, atol: float = 1e-8, max_steps: int = 256
) -> Integrator:
    """Make an integrator that divides each step of `ode` into as many diffrax steps as needed.

    Needs the extra: `pip install 'verifai_jax[diffrax]'`. It can be differentiated, forward and
    reverse. Samples, controller, `update` and switches keep the period `dt`, at which the solver
    restarts. A refined loop has shorter steps and the same tolerances. Single precision needs
    tolerances of 1e-6 or more.

    **Arguments:**
    - `solver`: the name of a diffrax solver: `"Tsit5"` and `"Dopri8"` for non-stiff equations,
      `"Kvaerno3"` and `"Kvaerno5"` (implicit) for stiff ones.
    - `rtol`, `atol`: relative and absolute tolerance of a step's error.
    - `max_steps`: the maximum number of diffrax steps in one step of `ode`; a simulation that needs
      more becomes `NONFINITE`.
    **Raises:** `MissingExtra` without diffrax, `UnknownNameError` for an unknown solver, and
    `ValueError` for tolerances that are not positive.
    """
    diffrax = require("diffrax", extra="diffrax")
    for name, tolerance in (("rtol", rtol), ("atol", atol)):
        if not is_number(tolerance) or not 0 < tolerance < 1:
            raise ValueError(f"{name} must lie between 0 and 1; got {tolerance!r}")
    check_count("max_steps", max_steps)
    solvers = adaptive_solvers(diffrax)
    if solver not in solvers:
        raise unknown_name("solver of diffrax", solver, solvers)
    # Implicit solvers take the tolerances of their root finder from the controller.
    controller = diffrax.PIDController(rtol=rtol, atol=atol)

    def step(derivative: Derivative, time: Time, state: PyTree, dt: Step) -> PyTree:
        dtype = jax.tree.leaves(state)[0].dtype
        # Counted from the step's beginning: small steps late in a simulation would be rounded.
        term = diffrax.ODETerm(lambda since, state, _: derivative(time + since, state))
        solution = diffrax.diffeqsolve(
            term,
            solvers[solver](),
            t0=jnp.zeros((), dtype),
            t1=jnp.asarray(dt, dtype),
            dt0=None,
            y0=state,
            saveat=diffrax.SaveAt(t1=True),
            stepsize_controller=controller,
            adjoint=diffrax.DirectAdjoint(),
            max_steps=max_steps,
            throw=False,
        )
        reached = solution.result == diffrax.RESULTS.successful
        return jax.tree.map(lambda leaf: jnp.where(reached, leaf[-1], jnp.nan), solution.ys)

    return step


def adaptive_solvers(diffrax: Any) -> dict[str, Any]:
    """Return the adaptive solvers of ordinary differential equations, by name."""
    return {
        name: kind
        for name, kind in vars(diffrax).items()
        if inspect.isclass(kind)
        and issubclass(kind, diffrax.AbstractAdaptiveSolver)
        and not name.startswith("Abstract")
        # Others take equations in two parts, noise, or another solver.
        and getattr(kind, "term_structure", None) is diffrax.AbstractTerm
    }
