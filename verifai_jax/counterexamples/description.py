"""Explanations of failures in English, for readers who know the system but not temporal logic."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from verifai_jax.core.messages.text import format_seconds, listed
from verifai_jax.counterexamples.influence import Influence, Span
from verifai_jax.mtl import Explanation, robustness_signal
from verifai_jax.mtl._explain import heading
from verifai_jax.mtl.formula import Formula, Term
from verifai_jax.mtl.formula import formula as as_formula

MUST = {
    "<": "has to be below",
    "<=": "may be at most",
    ">": "has to be above",
    ">=": "has to be at least",
}


def format_number(value: object, digits: int = 4) -> str:
    """Write a value for people: `120.4`, `on`."""
    if isinstance(value, (float, np.floating)):
        return f"{value:z.{digits}g}" if abs(value) < 1e5 else f"{value:z.3e}"
    return str(value)


def format_apart(value: float, bound: float) -> tuple[str, str]:
    """Write two numbers with enough digits to tell them apart."""
    for digits in range(4, 10):
        one, other = format_number(value, digits), format_number(bound, digits)
        if one != other:
            return one, other
    return repr(value), repr(bound)


def describe(
    name: str, row: int, why: Explanation, rho: float, influences: Sequence[Influence],
    matter: Sequence[Influence], notes: Sequence[str] = (),
) -> str:  # fmt: skip
    """Write the whole explanation of a counterexample as a paragraph.

    **Arguments:**
    - `name`: the name of the problem.
    - `row`: its number in the table.
    - `why`: the deciding predicate, its time, and the sub-formulas on the way to it.
    - `rho`: robustness of the row.
    - `influences`: the influences of the features.
    - `matter`: those that matter, by decreasing influence.
    - `notes`: notes on how the explanation was made.
    """
    sentences = [describe_verdict(name, row, why)]
    if any(np.isfinite(i.reverted) for i in influences):
        sentences += describe_reversals(matter, rho)
    rest = [i.name for i in influences if i not in matter]
    if rest and matter:
        sentences.append(f"{listed(rest)} {'does' if len(rest) == 1 else 'do'} not matter.")
    if gradient := describe_gradient(influences):
        sentences.append(gradient)
    sentences += [f"Note: {note}." for note in notes]
    return " ".join(sentences)


def describe_verdict(name: str, row: int, why: Explanation) -> str:
    """Write which predicate decides, when, by how much, and through which sub-formulas."""
    at = format_seconds(why.time, 4)
    formula = str(why.formula)
    first = f"Row {row} of {name} breaks  {formula}  with robustness {why.robustness:z.4g}"
    predicate = why.predicate
    broken = f"at {at}  {predicate}  decides"
    if predicate.compared:
        broken = describe_predicate(predicate, why, at)
    parts = [heading(node.formula) for node in why.path[:-1]]
    path = f", by way of {' > '.join(parts)}" if len(parts) > 1 else ""
    return f"{first}: {broken}{path}."


def describe_predicate(predicate: Formula, why: Explanation, at: str) -> str:
    """Write how a comparison decides: `at 17.9 s speed is 120.4, which has to be below 120`."""
    assert predicate.compared is not None
    left, comparison, right = predicate.compared
    value, must = value_at(left, why), MUST.get(comparison, f"has to be {comparison}")
    if right.number is None:
        shown, bound = format_apart(value, value_at(right, why))
        sides = f"at {at} {left} is {shown} and {right} is {bound}"
        if why.path[-1].robustness < 0:
            return f"{sides}; {left} {must} it"
        return f"{sides}: {predicate} holds where it must not"
    shown, bound = format_apart(value, right.number)
    if why.path[-1].robustness <= 0:
        return f"at {at} {left} is {shown}, which {must} {bound}"
    return f"at {at} {left} is {shown}: {predicate} holds where it must not"


def value_at(expression: Term, why: Explanation) -> float:
    """Return the value of an expression at the instant that decides."""
    trace = why.trace.finely()
    sample = int(np.argmin(np.abs(trace.clock() - why.time)))
    # Only the value is wanted, so that the clock may be any.
    signal = robustness_signal(as_formula(expression), replace(trace, dt=1.0, times=None))
    return float(np.asarray(signal)[sample])


def describe_reversals(matter: Sequence[Influence], rho: float) -> list[str]:
    """Write what happens to the failure when each feature is reset to nominal."""
    cures = [i for i in matter if i.gone]
    others = [i for i in matter if not i.gone and i.departs]
    sentences = []
    for i in cures[:4]:
        sentences.append(
            f"With {_named(i)} back at nominal ({_usual(i)}) the failure vanishes: the robustness "
            f"becomes {format_number(i.reverted)}.{_control_points(i, rho)}"
        )
    if len(cures) > 4:
        sentences.append(f"So it does with {listed([i.name for i in cures[4:]])}.")
    if not cures:
        sentences.append("No single feature back at nominal removes the failure.")
    for i in others[:3]:
        change = i.effect(rho)
        how = (
            f"{'raises' if change > 0 else 'lowers'} the robustness by {format_number(abs(change))}"
        )
        sentences.append(
            f"{_named(i, begins=True)} back at nominal ({_usual(i)}) {how} and is not enough alone."
        )
    return sentences


def _control_points(i: Influence, rho: float) -> str:
    """Write which control points remove the failure alone, or count most."""
    if i.spans is None or len(i.spans) < 2:
        return ""
    alone = [span for span, gone in zip(i.spans, i.each_gone, strict=True) if gone]
    if len(alone) == len(i.spans):
        return " Each of its control points alone does it."
    if alone:
        return f" Its part {format_spans(alone)} alone does it."
    gain = np.nan_to_num(i.each - rho)
    maximum = gain.max(initial=0.0)
    if maximum <= 0:
        return " No part of it does it alone."
    strong = [span for span, g in zip(i.spans, gain, strict=True) if g > 0.3 * maximum]
    return f" No part of it does it alone; what counts most is {format_spans(strong)}."


def format_spans(spans: list[Span]) -> str:
    """Write spans of time, neighbours joined: `from 0 s to 10 s and from 20 s to 25 s`."""
    joined: list[Span] = []
    for span in spans:
        if joined and span.begin <= joined[-1].end + 1e-6:
            joined[-1] = Span(joined[-1].begin, max(span.end, joined[-1].end))
        else:
            joined.append(span)
    ends = [(format_seconds(s.begin, 3), format_seconds(s.end, 3)) for s in joined]
    return listed([f"from {begin} to {end}" for begin, end in ends])


def describe_gradient(influences: Sequence[Influence]) -> str:
    """Write which small change helps most; empty if no gradient is known."""
    changes = [
        (abs(change), i, k)
        for i in influences
        for k, change in enumerate(i.gradient)
        if np.isfinite(change) and np.isfinite(i.slopes[k])
    ]
    if not changes or max(changes, key=lambda entry: entry[0])[0] == 0:
        return ""
    _, i, k = max(changes, key=lambda entry: entry[0])
    slope = float(i.slopes[k])
    what = i.name if len(i.gradient) == 1 else i.coordinates[k]
    if i.spans is not None:
        what = f"{i.name} {format_spans([i.spans[k]])}"
    direction = "less" if slope < 0 else "more"
    return (
        f"A small change helps most in {what}: {direction} of it raises the robustness by about "
        f"{format_number(abs(slope), 3)} for each unit, near this value."
    )


def _named(i: Influence, *, begins: bool = False) -> str:
    """Write the name of a feature, as it `begins` a sentence or stands within one."""
    return i.name if i.spans is None else f"{'The' if begins else 'the'} signal {i.name}"


def _usual(i: Influence) -> str:
    if len(i.nominal) == len(i.coordinates) and all("." in one for one in i.coordinates):
        # Of a structure, whose numbers say nothing without their names.
        names = [one.rpartition(".")[2] for one in i.coordinates]
        pairs = zip(names, map(format_number, i.nominal), strict=True)
        return ", ".join(f"{name} {value}" for name, value in pairs)
    values = list(dict.fromkeys(i.nominal))
    return ", ".join(map(format_number, values[:4])) + ", ..." * (len(values) > 4)
