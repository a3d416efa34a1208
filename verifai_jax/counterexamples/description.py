"""An explanation in words that somebody who knows the robot, and not the logic, can read."""

from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from verifai_jax.features import Domain, Signal
from verifai_jax.mtl import robustness_signal
from verifai_jax.mtl._explain import heading
from verifai_jax.mtl.formula import Atom, Formula, Number, Predicate

if TYPE_CHECKING:
    from verifai_jax.counterexamples._explain import Explained, Influence

MUST = {
    "<": "has to be below",
    "<=": "may be at most",
    ">": "has to be above",
    ">=": "has to be at least",
}


class Span(NamedTuple):
    """When a control point acts, in seconds."""

    begin: float
    end: float


def spans_of(domain: Domain, duration: float) -> tuple[Span, ...] | None:
    """When each coordinate of a signal acts; None for what is no signal.

    A point between two lines acts from the point before to the one behind.
    """
    if not isinstance(domain, Signal):
        return None
    length = domain.duration or duration
    if domain.hold == "constant":
        edges = np.linspace(0, length, domain.knots + 1)
        spans = [Span(float(a), float(b)) for a, b in pairwise(edges)]
    else:
        times = np.linspace(0, length, domain.knots)
        ends = np.concatenate([[0.0], times, [length]])
        spans = [Span(float(a), float(b)) for a, b in zip(ends[:-2], ends[2:], strict=True)]
    return tuple(span for span in spans for _ in range(domain.domain.size))


def number(value: Any, digits: int = 4) -> str:
    """As a person writes it: `120.4`, `on`."""
    if isinstance(value, (float, np.floating)):
        return f"{value:.{digits}g}" if abs(value) < 1e5 else f"{value:.3e}"
    return str(value)


def close(value: float, bound: float) -> tuple[str, str]:
    """Two numbers with so many digits that they differ."""
    for digits in range(4, 10):
        one, other = number(value, digits), number(bound, digits)
        if one != other:
            return one, other
    return repr(value), repr(bound)


def verdict(explained: "Explained") -> str:
    """Which predicate, when, by how much, and by way of which sub-formulas."""
    why, name = explained.why, explained.replay.problem.name
    at = f"{why.time:.4g} s"
    formula = str(why.formula)
    first = f"Row {explained.row} of {name} breaks  {formula}  with robustness {why.robustness:.4g}"
    predicate = why.predicate
    broken = f"at {at}  {predicate}  decides"
    if isinstance(predicate, Predicate):
        broken = told_predicate(predicate, why, at)
    parts = [heading(node.formula) for node in why.path[:-1]]
    path = f", by way of {' > '.join(parts)}" if len(parts) > 1 else ""
    return f"{first}: {broken}{path}."


def told_predicate(predicate: Predicate, why: Any, at: str) -> str:
    """`at 17.9 s speed is 120.4, which has to be below 120`."""
    left = value_at(predicate.left, why)
    if not isinstance(predicate.right, Number):
        right = value_at(predicate.right, why)
        shown, bound = close(left, right)
        sides = f"at {at} {predicate.left} is {shown} and {predicate.right} is {bound}"
        if why.path[-1].robustness < 0:
            must = MUST.get(predicate.comparison, f"has to be {predicate.comparison}")
            return f"{sides}; {predicate.left} {must} it"
        return f"{sides}: {predicate} holds where it must not"
    shown, bound = close(left, predicate.right.value)
    if why.path[-1].robustness <= 0:
        must = MUST.get(predicate.comparison, f"has to be {predicate.comparison}")
        return f"at {at} {predicate.left} is {shown}, which {must} {bound}"
    return f"at {at} {predicate.left} is {shown}: {predicate} holds where it must not"


def value_at(expression: Any, why: Any) -> float:
    """The value of an expression at the instant that decides."""
    formula: Formula = Atom(expression)
    signal = np.asarray(robustness_signal(formula, why.trace))
    clock = np.asarray(why.trace.clock())
    return float(signal[int(np.argmin(np.abs(clock - why.time)))])


def paragraph(explained: "Explained") -> str:
    """The whole explanation."""
    sentences = [verdict(explained)]
    matter = explained.matter
    known = any(np.isfinite(i.reverted) for i in explained.influences)
    if known:
        sentences += reversals(explained)
    rest = [i.name for i in explained.influences if i not in matter]
    if rest and matter:
        sentences.append(f"{_listed(rest)} {'does' if len(rest) == 1 else 'do'} not matter.")
    if slopes := steepest(explained):
        sentences.append(slopes)
    sentences += [f"Note: {note}." for note in explained.notes]
    return " ".join(sentences)


def reversals(explained: "Explained") -> list[str]:
    """What becomes of the failure with a feature back at nominal."""
    cures = [i for i in explained.matter if i.gone]
    others = [i for i in explained.matter if not i.gone and i.departs]
    told = []
    for i in cures[:4]:
        told.append(
            f"With {_named(i)} back at nominal ({_usual(i)}) the failure vanishes: the robustness "
            f"becomes {number(i.reverted)}.{_points(i, explained)}"
        )
    if len(cures) > 4:
        told.append(f"So it does with {_listed([i.name for i in cures[4:]])}.")
    if not cures:
        told.append("No single feature back at nominal removes the failure.")
    for i in others[:3]:
        change = explained.effect(i)
        how = f"{'raises' if change > 0 else 'lowers'} the robustness by {number(abs(change))}"
        told.append(
            f"{_capital(_named(i))} back at nominal ({_usual(i)}) {how} and is not enough alone."
        )
    return told


def _points(i: "Influence", explained: "Explained") -> str:
    """Which control points do it alone, or count most."""
    if i.spans is None or len(i.spans) < 2:
        return ""
    alone = [span for span, gone in zip(i.spans, i.each_gone, strict=True) if gone]
    if len(alone) == len(i.spans):
        return " Each of its control points alone does it."
    if alone:
        return f" Its part {told_spans(alone)} alone does it."
    gain = np.nan_to_num(i.each - explained.rho)
    most = gain.max(initial=0.0)
    if most <= 0:
        return " No part of it does it alone."
    strong = [span for span, g in zip(i.spans, gain, strict=True) if g > 0.3 * most]
    return f" No part of it does it alone; what counts most is {told_spans(strong)}."


def told_spans(spans: list[Span]) -> str:
    """`from 0 s to 10 s and from 20 s to 25 s`, with neighbours joined."""
    joined: list[Span] = []
    for span in spans:
        if joined and span.begin <= joined[-1].end + 1e-6:
            joined[-1] = Span(joined[-1].begin, max(span.end, joined[-1].end))
        else:
            joined.append(span)
    return _listed([f"from {s.begin:.3g} s to {s.end:.3g} s" for s in joined])


def steepest(explained: "Explained") -> str:
    """Where the robustness has a slope, which small change would help most."""
    found = [
        (abs(slope), slope, i, k)
        for i in explained.influences
        for k, slope in enumerate(i.slope)
        if np.isfinite(slope)
    ]
    if not found or max(found, key=lambda f: f[0])[0] == 0:
        return ""
    size, slope, i, k = max(found, key=lambda f: f[0])
    what = i.name if len(i.slope) == 1 else i.coordinates[k]
    if i.spans is not None:
        what = f"{i.name} {told_spans([i.spans[k]])}"
    way = "less" if slope < 0 else "more"
    return (
        f"A small change helps most in {what}: {way} of it, by a hundredth of its range, raises "
        f"the robustness by about {number(0.01 * size, 2)}."
    )


def _named(i: "Influence") -> str:
    return i.name if i.spans is None else f"the signal {i.name}"


def _usual(i: "Influence") -> str:
    values = list(dict.fromkeys(i.nominal))
    return ", ".join(map(number, values[:4])) + ", ..." * (len(values) > 4)


def _capital(text: str) -> str:
    return text[0].upper() + text[1:] if text.startswith("the signal") else text


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
