"""The dependence of a problem's robustness on its features and its key, found without simulation.

    has_gradient(problem)                           # can slopes by features say anything?
    without_derivative(problem)                     # None, or "pure_callback of road (sim.py, ..."
    depends_on_key(problem)                         # does a point fail with a probability?

An integer or Boolean signal (a gear, a count) is constant between its jumps, so its derivative is
zero wherever it exists. If formulas use only such signals, derivatives cost simulations and give no
information. JAX shows this: the derivative of such a signal does not depend on the features.

Differentiating a simulation takes JAX many times as long as tracing it. So a sweep over the steps
of the traced simulation finds the values that depend on the features through differentiable steps.
Only steps with a custom derivative are differentiated, one at a time.

Some steps have no derivative: a call of Python on the host, or a user's own operation. If a feature
reaches the robustness through one, JAX cannot differentiate the simulation.
"""

from collections.abc import Sequence, Set
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.extend.core
import jax.numpy as jnp
from jax.interpreters import ad
from jaxtyping import Array

from verifai_jax.core.compute import fingerprint
from verifai_jax.core.compute.compilation import Slot
from verifai_jax.core.compute.jaxprs import CALLS, called, programs_in
from verifai_jax.core.compute.precision import truncate_silently
from verifai_jax.problem.problem import Problem
from verifai_jax.problem.tracing import judged_results


class Slopes(NamedTuple):
    """The derivative of a robustness with respect to the features, as far as tracing shows it.

    - `depends`: whether the derivative can be different from zero.
    - `lacking`: descriptions of the steps that have no derivative; often none.
    """

    depends: bool
    lacking: tuple[str, ...]


DEPENDENCE: Slot[None, Slopes] = Slot("dependence")
"""How the robustness of a problem depends on the features."""
KEY: Slot[None, bool] = Slot("dependence on the key")
"""Whether the verdict of a simulation depends on its random key."""
_FLAT = frozenset({"ceil", "floor", "nextafter", "round", "sign", "stop_gradient"})
"""Steps with real results whose derivative is zero."""


def has_gradient(problem: Problem) -> bool:
    """Return whether a monitored signal depends differentiably on a feature; traced once."""
    return _slopes(problem).depends


def without_derivative(problem: Problem) -> str | None:
    """Return the steps from the features to the robustness that have no derivative; traced once.

    None if every step has one, and for a black box, which JAX does not trace.
    """
    lacking = () if problem.black_box else _slopes(problem).lacking
    return " and ".join(lacking) if lacking else None


def _slopes(problem: Problem) -> Slopes:
    return problem.programs.get(DEPENDENCE, None, lambda: _depends(problem))


def depends_on_key(problem: Problem) -> bool:
    """Return whether the verdict of a simulation depends on its random key; traced once.

    Splitting a key, or drawing numbers that no monitored signal uses, does not count. A black box
    that is given a seed counts as one that draws: no number of simulations could show that it does
    not.
    """
    return problem.programs.get(KEY, None, lambda: _uses_key(problem))


def _uses_key(problem: Problem) -> bool:
    if problem.black_box:
        return problem.system.may_draw(problem.space.feature_form)
    program, trace = problem.traced()
    return fingerprint.used_inputs(program, judged_results(trace, problem.monitored))[-1]


@truncate_silently()
def _depends(problem: Problem) -> Slopes:
    mapped = jax.make_jaxpr(problem.space.unflatten)(problem.space.point_form)
    sweep = _Sweep()
    moved = sweep(mapped.jaxpr, [True])
    program, trace = problem.traced()
    of_key = [False] * (len(program.jaxpr.invars) - len(moved))
    # What nothing monitored is computed from is not differentiated either.
    judged = judged_results(trace, problem.monitored)
    reached = sweep(fingerprint.without_unused(program.jaxpr, judged), [*moved, *of_key])
    # The length and the status, which are whole numbers, depend differentiably on nothing.
    return Slopes(any(reached), tuple(sweep.lacking))


class _Sweep:
    """Sweeps over the steps of programs; `lacking` are those found that have no derivative."""

    def __init__(self) -> None:
        self.lacking: dict[str, None] = {}

    def __call__(self, program: jax.extend.core.Jaxpr, moved: Sequence[bool]) -> list[bool]:
        """Return which results of a program depend differentiably on inputs that are `moved`."""
        depends = {each for each, moves in zip(program.invars, moved, strict=True) if moves}
        for step in program.eqns:
            inputs = _among(step.invars, depends)
            if any(inputs):
                results = self.results(program, step, inputs)
                pairs = zip(step.outvars, results, strict=True)
                depends.update(each for each, moves in pairs if moves and _is_real(each))
        return _among(program.outvars, depends)

    def results(self, program: jax.extend.core.Jaxpr, step: Any, moved: list[bool]) -> list[bool]:
        """Return which results of a step depend differentiably on the inputs that are `moved`."""
        name, options = step.primitive.name, step.params
        if name in CALLS:
            return self(_program(called(step)), moved)
        if name == "scan":
            constants, carried = fingerprint.operands_of_scan(options)
            fixed, carry = moved[:constants], moved[constants : constants + carried]
            rows = moved[constants + carried :]
            return self.repeated(_program(options["jaxpr"]), fixed, carry, rows)
        if name == "while":
            test, count = options["cond_nconsts"], options["body_nconsts"]
            body = _program(options["body_jaxpr"])
            return self.repeated(body, moved[test : test + count], moved[test + count :], [])
        if name == "cond":
            branches = [self(_program(each), moved[1:]) for each in options["branches"]]
            return [any(each) for each in zip(*branches, strict=True)]
        if name.startswith("scatter") or (_is_of_jax(step) and not programs_in(step)):
            return [name not in _FLAT] * len(step.outvars)
        return self.differentiated(program, step, moved)

    def differentiated(
        self, program: jax.extend.core.Jaxpr, step: Any, moved: list[bool]
    ) -> list[bool]:
        """Return the same from the derivative of the step along a direction."""
        call, inputs = fingerprint.as_function(program, step)
        pairs = zip(step.invars, moved, strict=True)
        moving = {each for each, moves in pairs if moves and _is_real(each)}
        indices = [i for i, each in enumerate(inputs) if each in moving]
        forms = [jax.ShapeDtypeStruct(each.aval.shape, each.aval.dtype) for each in inputs]

        def along(values: list[Array], direction: list[Array]) -> list[Any]:
            function = fingerprint.of_some(call, values, indices)
            return jax.jvp(function, [values[i] for i in indices], direction)[1]

        try:
            derivative = jax.make_jaxpr(along)(forms, [forms[i] for i in indices]).jaxpr
        except Exception:
            # JAX says by errors of many kinds that there is none, each operation by its own.
            self.lacking.setdefault(fingerprint.describe_step(step))
            return [False] * len(step.outvars)
        # All that it is computed from in any way: the derivative is linear in the direction.
        reached = set(derivative.invars[len(inputs) :])
        for each in derivative.eqns:
            if any(_among(each.invars, reached)):
                reached.update(each.outvars)
        found = iter(_among(derivative.outvars, reached))
        return [_is_real(each) and next(found) for each in step.outvars]

    def repeated(
        self, body: jax.extend.core.Jaxpr, fixed: list[bool], carry: list[bool], rows: list[bool]
    ) -> list[bool]:
        """Return the same of a loop: what is carried goes round until no more of it depends."""
        while True:
            results = self(body, [*fixed, *carry, *rows])
            after = [old or new for old, new in zip(carry, results[: len(carry)], strict=True)]
            if after == carry:
                return [*carry, *results[len(carry) :]]
            carry = after


def _among(values: Sequence[Any], variables: Set[Any]) -> list[bool]:
    """Return which operands of a step are some of these variables."""
    return [
        not isinstance(value, jax.extend.core.Literal) and value in variables for value in values
    ]


def _is_real(value: Any) -> bool:
    dtype = getattr(value.aval, "dtype", None)
    return dtype is not None and jnp.issubdtype(dtype, jnp.inexact)


def _is_of_jax(step: Any) -> bool:
    """Return whether JAX has a derivative of its own for a step: one that does not refuse.

    Those of calls of Python, and of operations from elsewhere, are asked for.
    """
    rule = ad.primitive_jvps.get(step.primitive)
    while isinstance(rule, partial):
        rule = rule.func
    return str(getattr(rule, "__module__", "")).startswith(
        ("jax._src.lax", "jax._src.interpreters")
    )


def _program(program: Any) -> jax.extend.core.Jaxpr:
    return getattr(program, "jaxpr", program)
