"""Mistakes in a problem that raise no error, reported before the first simulation.

    silent_mistakes(problem)                            # ("feature 'wind' influences no ...",)

Examples are a formula that looks beyond the end of the trace, an unused feature, and a system whose
calls change something. Nothing compiles: the system is traced, which takes a fraction of a second.
Only certain mistakes are reported.
"""

from collections.abc import Iterator

import jax

from verifai_jax.core.compute.compilation import Slot
from verifai_jax.core.compute.fingerprint import used_inputs
from verifai_jax.core.values.trace import Trace
from verifai_jax.features import Domain
from verifai_jax.mtl.fitting import assumptions
from verifai_jax.mtl.shortfalls import shortfalls
from verifai_jax.problem.problem import WATCHED, Problem
from verifai_jax.problem.tracing import judged_results, traced_by_default

COMPARED = ". A Categorical of texts has the place of the choice as its value, which no text equals"
"""Advice on a choice that seems to be read: a comparison with a text is false, silently."""
MISTAKES: Slot[None, tuple[str, ...]] = Slot("silent mistakes")
"""Sentences on a problem."""


def silent_mistakes(problem: Problem) -> tuple[str, ...]:
    """Return a sentence for each likely mistake in a problem that raises no error; cached."""

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
        f"in {'the formula' if len(problem.formulas) == 1 else f'formula {name!r}'}, {said}"
        for name, formula in problem.formulas.items()
        for said in (
            *(() if known is None else shortfalls(formula, dt, duration, problem.end)),
            *assumptions(formula, {}),
        )
    )


def mistakes_of_the_system(problem: Problem) -> Iterator[str]:
    """Yield the mistakes that tracing the system shows."""
    if problem.black_box or not traced_by_default(problem.system):
        return
    yield from _unread(problem)
    if (watched := problem.programs.peek(WATCHED, None)) and (kept := watched.kept):
        yield (
            f"each call of the system changes {' and '.join(kept[:4])}, and JAX calls it while "
            "tracing, once for all steps of all simulations: what it decides by that, it decides "
            "as in the first call"
        )


def is_quick(problem: Problem) -> bool:
    """Return whether a system was quick to trace, and so is likely quick to simulate."""
    watched = problem.programs.peek(WATCHED, None)
    return watched is not None and watched.quick


def _unread(problem: Problem) -> Iterator[str]:
    """Yield the features that neither a monitored signal nor the constraint depends on."""
    features, (program, trace) = problem.space.feature_form, problem.traced()
    used = used_inputs(program, judged_results(trace, problem.monitored, status=False))
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
