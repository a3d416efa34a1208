"""Mistakes in a problem that raise no error, reported before the first simulation.

    silent_mistakes(problem)                            # ("feature 'wind' influences no ...",)

Examples are a formula that looks beyond the end of the trace, an unused feature, and a system that
is not a function of its features and its key. Nothing compiles: the system is traced twice, which
takes a fraction of a second. Only certain mistakes are reported.
"""

import time
from collections.abc import Iterator
from typing import Any, TypeAlias

import jax
import numpy as np
from jax.extend.core import Jaxpr, JaxprEqn, Literal
from jaxtyping import PyTree

from verifai_jax.core.compute.compilation import Slot
from verifai_jax.core.compute.fingerprint import PROGRAM, used_inputs
from verifai_jax.core.compute.precision import truncate_silently
from verifai_jax.core.user_code.user_errors import source_line
from verifai_jax.core.values.trace import Trace
from verifai_jax.features import Domain
from verifai_jax.mtl.shortfalls import shortfalls
from verifai_jax.problem.problem import Problem
from verifai_jax.systems.base import System

PATIENCE = 1.0
"""Seconds of a first tracing above which there is no second one."""
COMPARED = ". A Categorical of texts has the place of the choice as its value, which no text equals"
"""Advice on a choice that seems to be read: a comparison with a text is false, silently."""
MISTAKES: Slot[None, tuple[str, ...]] = Slot("silent mistakes")
"""Sentences on a problem."""
SECONDS: Slot[None, float] = Slot("seconds of tracing")
"""Seconds that one tracing of a problem's system takes."""
Program: TypeAlias = Any
"""A program with its constants, or one inside an operation, whose constants are operands of it."""


def silent_mistakes(problem: Problem) -> tuple[str, ...]:
    """Return a sentence for each likely mistake in a problem that raises no error; cached.

    **Raises:** the errors of tracing the system.
    """

    def found() -> tuple[str, ...]:
        return (*formula_notes(problem), *mistakes_of_the_system(problem))

    return problem.programs.get(MISTAKES, None, found)


def formula_notes(problem: Problem, trace: Trace | None = None) -> tuple[str, ...]:
    """Return a sentence for each part of a formula that says less, or more, than it seems to say.

    **Arguments:**
    - `trace`: a simulation, for a problem whose traces are not known before.
    """
    known = problem.form() or trace
    length = None if known is None else known.length
    dt = (known and known.dt) or 0.0
    duration = None if length is None or not (dt or length == 1) else (length - 1) * dt
    # A black box whose traces are not known may return single samples.
    return tuple(
        f"in {'the formula' if len(problem.formulas) == 1 else f'formula {name!r}'}, {fall}"
        for name, formula in problem.formulas.items()
        for fall in (() if known is None else shortfalls(formula, dt, duration, problem.end))
    )


def mistakes_of_the_system(problem: Problem) -> Iterator[str]:
    """Yield the mistakes that two tracings of the system show; none if it is slow to trace."""
    if problem.black_box or not traced_by_default(problem.system):
        return
    features = problem.space.feature_form
    key = jax.eval_shape(lambda: jax.random.key(0))
    started = time.perf_counter()
    program = _program(problem, features, key)
    yield from _unread(problem, program, features)
    seconds = time.perf_counter() - started
    problem.programs.get(SECONDS, None, lambda: seconds)
    if seconds > PATIENCE:
        return
    differs, line = difference(program, _program(problem, features, key))
    if differs:
        where = "" if line is None else f" (see {line})"
        yield (
            f"the system computes with other numbers each time that it is called{where}: random "
            "numbers of Python or NumPy, the clock, or something kept from the call before. "
            "Compiled by JAX it keeps those of one call for all simulations. Draw from the key "
            "that the system is given, by jax.random"
        )


def traced_by_default(system: System) -> bool:
    """Return whether the shapes of the system's traces come from tracing it with JAX."""
    function = getattr(system, "function", None)
    return type(system).abstract is System.abstract or (
        function is not None and not callable(getattr(function, "abstract", None))
    )


def is_quick(problem: Problem) -> bool:
    """Return whether a system was quick to trace, and so is likely quick to simulate."""
    seconds = problem.programs.peek(SECONDS, None)
    return seconds is not None and seconds <= PATIENCE


@truncate_silently()
def _program(problem: Problem, features: PyTree, key: Any) -> Program:
    """Trace from features to the monitored signals, and the length of what counts of them."""

    def signals(features: PyTree, key: Any) -> Any:
        trace = problem.system(features, key)
        return [trace.signals[name] for name in problem.monitored], trace.valid

    return jax.make_jaxpr(signals)(features, key)


def _unread(problem: Problem, program: Program, features: PyTree) -> Iterator[str]:
    """Yield the features that neither a monitored signal nor the constraint depends on."""
    used = used_inputs(program)
    where = problem.space.where
    if where is not None:
        asked = jax.make_jaxpr(where)(features)
        used = [one or other for one, other in zip(used, used_inputs(asked), strict=False)]
    read: dict[tuple[str, ...], bool] = {}
    for (path, _), is_used in zip(jax.tree.leaves_with_path(features), used, strict=False):
        names = _names(path)
        read[names] = read.get(names, False) or is_used
    unread = [names for names in _order(problem) if not read.get(names, True)]
    shown = ", ".join(repr(".".join(names)) for names in unread[:6])
    if unread:
        one = len(unread) == 1
        more = f" and {len(unread) - 6} more" if len(unread) > 6 else ""
        domains = [problem.space.domains[names[0]] for names in unread]
        texts = not all(domain.numeric for domain in domains)
        yield (
            f"feature{'' if one else 's'} {shown}{more} influence{'s' if one else ''} no signal "
            f"that the property speaks of ({', '.join(problem.monitored)}): "
            f"the search varies {'it' if one else 'them'} for nothing{COMPARED if texts else ''}"
        )


def _names(path: jax.tree_util.KeyPath) -> tuple[str, ...]:
    """Return the names of a feature and of its fields, as far as these are dictionaries'."""
    names = []
    for step in path:
        if not isinstance(step, jax.tree_util.DictKey):
            break
        names.append(str(step.key))
    return tuple(names)


def _order(problem: Problem) -> Iterator[tuple[str, ...]]:
    """Yield the names of all features that vary, fields of structures one by one."""

    def below(names: tuple[str, ...], domain: Domain) -> Iterator[tuple[str, ...]]:
        for name, part in domain.named:
            yield from below((*names, name), part)
        if domain.size and not domain.named:
            yield names

    return below((), problem.space.root)


def difference(one: Program, other: Program) -> tuple[bool, str | None]:
    """Return whether two programs use different constants, and the source line where known.

    Compares operations, constants among their operands, and plain parameters.
    """
    # From JAX 0.12 on both are one class; before, a program inside an operation has no constants.
    constants, others = (getattr(each, "consts", ()) for each in (one, other))
    for a, b in zip(constants, others, strict=False):
        if not _same_value(a, b):
            return True, _line_of_constant(one, a)
    if len(constants) != len(others):
        return True, None
    return _difference(*(getattr(each, "jaxpr", each) for each in (one, other)))


def _difference(one: Jaxpr, other: Jaxpr) -> tuple[bool, str | None]:
    for a, b in zip(one.eqns, other.eqns, strict=False):
        if a.primitive is not b.primitive or not _same_operands(a, b):
            return True, _line(a)
        inner = list(zip(programs_read(a.params), programs_read(b.params), strict=False))
        for first, second in inner:
            differs, line = difference(first, second)
            if differs:
                return True, line or _line(a)
        plain = [name for name, value in a.params.items() if _is_plain(value)]
        if any(a.params[name] != b.params.get(name) for name in plain):
            return True, _line(a)
    return len(one.eqns) != len(other.eqns), None


def _same_operands(one: JaxprEqn, other: JaxprEqn) -> bool:
    if len(one.invars) != len(other.invars):
        return False
    for a, b in zip(one.invars, other.invars, strict=True):
        if isinstance(a, Literal) != isinstance(b, Literal):
            return False
        if isinstance(a, Literal) and isinstance(b, Literal) and not _same_value(a.val, b.val):
            return False
    return True


def programs_read(parameters: dict[str, Any]) -> Iterator[Program]:
    """Yield the programs nested in an operation, such as the body of a loop."""
    for value in parameters.values():
        for part in value if isinstance(value, tuple | list) else (value,):
            if isinstance(part, (Jaxpr, PROGRAM)):
                yield part


def _is_plain(value: object) -> bool:
    if isinstance(value, tuple):
        return all(map(_is_plain, value))
    # Names of functions may hold addresses.
    return isinstance(value, bool | int | float) and value == value


def _same_value(one: object, other: object) -> bool:
    try:
        a, b = np.asarray(one), np.asarray(other)
        return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind in "fc")
    except TypeError:  # Random keys and the like.
        return True


def _line_of_constant(program: Program, constant: object) -> str | None:
    """Return the line of the first operation on a constant."""
    index = next(i for i, value in enumerate(program.consts) if value is constant)
    variable = program.jaxpr.constvars[index]
    for step in program.jaxpr.eqns:
        if any(value is variable for value in step.invars):
            return _line(step)
    return None


def _line(step: JaxprEqn) -> str | None:
    return source_line(getattr(step.source_info, "traceback", None))
