"""Formulas that differ from one in a single point, and the recordings that show the difference.

    found = mutants("always (speed > 5 -> dist > 2)", recordings)
    print(found)                      # which changes no recording notices
    found.surviving[0].example        # a trace that would

A recording kills a mutant if their verdict differs from that of the formula. A surviving mutant
shows that such a mistake in the formula would go unnoticed.
"""

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, TypeAlias

from verifai_jax.addons.monitoring.distinguishing import free_difference
from verifai_jax.addons.monitoring.recorded import Recordings, named_traces
from verifai_jax.core.display.notebook import Tabular
from verifai_jax.core.messages.text import counted
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl.evaluate import End, IntervalError
from verifai_jax.mtl.expression import (
    Arithmetic,
    Expression,
    Number,
    expression,
)
from verifai_jax.mtl.formula import EVERYTHING, Formula, Interval, surface
from verifai_jax.mtl.host_values import HostValues
from verifai_jax.mtl.rewriting import nnf, simplify
from verifai_jax.mtl.sampled import Sampled
from verifai_jax.mtl.setting import as_formula
from verifai_jax.mtl.words import OPERATORS

if TYPE_CHECKING:
    import pandas as pd
OTHER_WORDS = {
    "always": "eventually", "eventually": "always", "historically": "once", "once": "historically",
    "until": "weak_until", "weak_until": "until", "and": "or", "or": "and", "implies": "and",
    "iff": "implies", "xor": "or", "release": "until", "rise": "fall", "fall": "rise",
}  # fmt: skip
"""The operator that is written by mistake for each."""
REVERSED = {">": "<", ">=": "<=", "<": ">", "<=": ">=", "==": "!=", "!=": "=="}
MOVED = 0.1
"""Share by which a bound is moved, either way."""
Change: TypeAlias = tuple[str, str, Formula]
"""A kind of change, what was changed into what, and the formula."""


@dataclass(frozen=True)
class Mutant:
    """A formula with one change.

    - `kind`: `"bound"`, `"window"`, `"operator"`, `"comparison"`, `"clause"` or `"guard"`.
    - `change`: a description of the change.
    - `killed_by`: the first recording with another verdict; empty for a mutant that survives.
    - `example`: for a surviving mutant, a free trace that would kill it; None if none was found,
      for example because it is equivalent.
    """

    kind: str
    change: str
    formula: Formula
    killed_by: str = ""
    example: Trace | None = field(default=None, repr=False)


@dataclass(frozen=True)
class Mutants(Tabular):
    """The mutants of a formula, killed and surviving; `str()` lists the surviving ones."""

    formula: Formula
    mutants: tuple[Mutant, ...]
    recordings: int

    def __len__(self) -> int:
        return len(self.mutants)

    def __iter__(self) -> Iterator[Mutant]:
        return iter(self.mutants)

    @property
    def surviving(self) -> tuple[Mutant, ...]:
        """The mutants that no recording kills, although some trace would."""
        return tuple(m for m in self.mutants if not m.killed_by and m.example is not None)

    @property
    def equivalent(self) -> tuple[Mutant, ...]:
        """The mutants for which no trace was found that distinguishes them from the formula."""
        return tuple(m for m in self.mutants if not m.killed_by and m.example is None)

    @functools.cached_property
    def table(self) -> "pd.DataFrame":
        """A row for each mutant."""
        import pandas as pd

        alive = ("survives", "not told apart")
        states = ["killed" if m.killed_by else alive[m.example is None] for m in self.mutants]
        pairs = zip(self.mutants, states, strict=True)
        rows = [(m.kind, m.change, str(m.formula), m.killed_by, state) for m, state in pairs]
        return pd.DataFrame(rows, columns=["kind", "change", "formula", "killed_by", "state"])

    def summary(self) -> str:
        """Write how many were killed, and each one that survives."""
        killed = sum(bool(mutant.killed_by) for mutant in self.mutants)
        lines = [
            f"{self.formula}",
            f"  {killed} of {counted(len(self.mutants), 'mutant')} killed by "
            f"{counted(self.recordings, 'recording')}, {len(self.surviving)} survive, "
            f"{len(self.equivalent)} were told apart by no trace that was tried",
        ]
        for title, own in (("survives", self.surviving), ("not told apart", self.equivalent)):
            lines += [f"  {title:<15}{m.kind:<12}{m.change}" for m in own]
        if self.surviving:
            lines.append("  a trace that kills one is its .example: record such a case, or test it")
        return "\n".join(lines)

    __str__ = summary


def mutants(
    formula: Formula | str, signals: Recordings | None = None, *, end: End = "hold", seed: int = 0
) -> Mutants:
    """Change a formula in one point at a time, and find which recordings notice the change.

    **Arguments:**
    - `formula`: a formula, or its text.
    - `signals`: recordings (traces, files, folders, tables), or a problem, which is simulated 64
      times. Without them all mutants survive, each with an example of a trace that would kill it.
    - `end`: how a trace continues after the last sample, `"hold"` or `"truncate"`.
    - `seed`: the seed of the free traces that are tried.
    **Raises:** `FormulaSyntaxError`; the errors of `read`; `ValueError` for a recording without the
    signals, or with gaps where they matter.
    """
    formula = as_formula(formula)
    traces = {} if signals is None else named_traces(signals)
    values = {name: HostValues.of(trace, end) for name, trace in traces.items()}
    truth = {name: each.holds(formula) for name, each in values.items()}
    dt = next((each.dt for each in values.values()), 0.0)
    found: dict[Formula, Mutant] = {}
    original = simplify(nnf(formula))
    for kind, change, changed in changes(formula, dt):
        if changed in found or simplify(nnf(changed)) == original:
            continue
        try:
            killer = next((n for n, each in values.items() if each.holds(changed) != truth[n]), "")
        except IntervalError:
            continue  # A window that the clock of a recording does not have.
        example = None if killer else _example(formula, changed, list(traces.values()), end, seed)
        found[changed] = Mutant(kind, change, changed, killer, example)
    return Mutants(formula, tuple(found.values()), len(traces))


def _example(
    formula: Formula, changed: Formula, like: Sequence[Trace], end: End, seed: int
) -> Trace | None:
    try:
        return free_difference(formula, changed, like, end, seed=seed)
    except ValueError:
        return None  # Windows that only a clock of very many samples has.


def changes(formula: Formula, dt: float = 0.0) -> Iterator[Change]:
    """Yield all formulas that differ from the given one in a single point.

    **Arguments:**
    - `dt`: minimum shift of a window in seconds, the sampling period.
    """
    if isinstance(formula, ast.Constant):
        return
    if formula.is_predicate:
        yield from _changed_leaf(formula)
        return
    word, operands, interval = surface(formula)

    def made(word: str, parts: Sequence[Formula], span: Interval | None = interval) -> Formula:
        return ast.build(word, parts, EVERYTHING if span is None else span)

    if word in OTHER_WORDS:
        other = OTHER_WORDS[word]
        yield "operator", f"{word} becomes {other} in {formula}", made(other, operands)
    if word == "implies":
        negated = made(word, (~operands[0], operands[1]))
        yield "guard", f"{operands[0]} becomes its negation", negated
        yield "clause", f"{operands[0]} is left out", operands[1]
    elif word in ("and", "or"):
        for index, part in enumerate(operands):
            rest = (*operands[:index], *operands[index + 1 :])
            yield "clause", f"{part} is left out", rest[0] if len(rest) == 1 else made(word, rest)
    elif word == "not":
        yield "guard", f"{formula} becomes {operands[0]}", operands[0]
    elif OPERATORS[word].operands == 1:
        yield "operator", f"{word} is left out of {formula}", operands[0]
    if interval is not None:
        for span in _windows(interval, dt):
            text = "everything" if span.everything else str(span)
            yield "window", f"{interval} becomes {text} in {formula}", made(word, operands, span)
    for index, part in enumerate(operands):
        for kind, change, other in changes(part, dt):
            yield kind, change, made(word, (*operands[:index], other, *operands[index + 1 :]))


def _windows(interval: Interval, dt: float) -> Iterator[Interval]:
    """Yield windows that begin or end elsewhere."""
    start, end = interval.start, interval.end
    if math.isinf(end):
        return
    middle = (start + end) / 2
    middle = round(middle / dt) * dt if dt else middle
    for new in (start, middle), (start, 2 * end), (start, math.inf), (0.0, end), (middle, end):
        ends = tuple(round(t, 9) for t in new)
        if ends != (start, end) and ends[0] <= ends[1]:
            yield Interval(ends[0], ends[1])


def _changed_leaf(leaf: Formula) -> Iterator[Change]:
    if leaf.compared is None:
        yield "comparison", f"{leaf} becomes its negation", ~leaf
        return
    left, comparison, right = leaf.compared
    swapped = ast.Predicate(REVERSED[comparison], left, right)
    yield "comparison", f"{leaf} becomes {swapped}", swapped
    for one, other in _changed_terms(expression(left), expression(right)):
        changed = ast.Predicate(comparison, one, other)
        yield "bound", f"{leaf} becomes {changed}", changed


def _changed_terms(*terms: Expression) -> Iterator[tuple[Expression, ...]]:
    """Yield the terms with one number moved, or without one absolute value."""
    for index, term in enumerate(terms):
        for changed in _changed_term(term):
            if any(each.signals() for each in (*terms[:index], changed, *terms[index + 1 :])):
                yield (*terms[:index], changed, *terms[index + 1 :])


def _changed_term(term: Expression) -> Iterator[Expression]:
    if isinstance(term, Number) and term.opened:
        yield from (Arithmetic("*", (Number(share), term)) for share in (1 - MOVED, 1 + MOVED))
    elif isinstance(term, Number):
        for share in (1 - MOVED, 1 + MOVED) if term.value else ():
            yield Number(float(f"{term.value * share:z.12g}"))
        if not term.value:
            yield from (Number(-MOVED), Number(MOVED))
    elif isinstance(term, Sampled):
        if term.window is not None:
            end = 2 * term.window.end
            yield term.changed(lambda part: part, replace(term.window, end=end))
        for index, part in enumerate(term.operands):
            others = [~part] if isinstance(part, Formula) else _changed_term(expression(part))
            for other in others:
                own = (*term.operands[:index], other, *term.operands[index + 1 :])
                yield term.of(own, term.window)
    elif isinstance(term, Arithmetic):
        if term.name == "abs":
            yield term.arguments[0]
        if term.name != "**":
            for parts in _changed_terms(*term.arguments):
                yield Arithmetic(term.name, parts)
