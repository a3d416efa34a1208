"""Parts of a formula that a finite trace makes ask for less, or more, than was probably meant.

    for each in shortfalls(parse("eventually[0, 5] always[0, 1] x < 2"), 0.1, 5.0):
        print(each.sentence, each.meant)                # ... eventually[0,4] always[0,1] (x < 2)

Nothing is simulated: the windows of a formula and the duration of a trace are compared. Each
operator is considered at the first instant at which it is evaluated. At later instants many windows
are cut by the end of a trace and nobody can help it, as in `always (x > 1 -> eventually[0,5] y)`.
"""

import functools
import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from verifai_jax.core.messages.text import format_seconds
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl._explain import heading
from verifai_jax.mtl.evaluate import End
from verifai_jax.mtl.formula import Formula, Interval, surface
from verifai_jax.mtl.rewriting import rebuild
from verifai_jax.mtl.tree import postorder
from verifai_jax.mtl.words import OPERATORS

MAX_STATES = 5000
"""Maximum number of pairs of a part and the windows around it that are considered."""
END_OF_TRACE = {
    "hold": "its last sample is taken for all that comes after",
    "truncate": "what comes after is left out",
    "strict": "there is no verdict",
}


class Shortfall(NamedTuple):
    """A part of a formula that says something else than it seems to say.

    - `kind`: `"beyond"` (the end), `"start"` (the first sample decides), or `"cut"`.
    - `sentence`: what is the matter with the part.
    - `meant`: the formula that was probably meant, if that is known.
    """

    kind: str
    part: Formula
    sentence: str
    meant: str = ""

    def __str__(self) -> str:
        return f"{self.sentence}{self.meant and f'. Probably meant: {self.meant}'}"


class _Outer(NamedTuple):
    """A window ahead around a part, which chooses when the part is evaluated.

    - `sign`: 1 if one good instant is enough, -1 if each has to be good.
    - `asked`: the first instant at which the window itself is evaluated, in seconds.
    - `later`, `sooner`: how far the windows in between move the part.
    - `joined`: whether another part has a say in the choice.
    """

    window: Formula
    sign: int
    asked: float
    later: float = 0.0
    sooner: float = 0.0
    joined: bool = False


@functools.lru_cache(1024)
def shortfalls(
    formula: Formula, dt: float = 0.0, duration: float | None = None, end: End = "hold"
) -> tuple[Shortfall, ...]:
    """Return the parts of a formula that fit a trace less than was probably meant.

    **Arguments:**
    - `dt`: sampling period in seconds, by which `next` and `prev` look.
    - `duration`: seconds from the first to the last sample; None if that is not known.
    - `end`: how a trace continues after its last sample.
    """
    if duration == 0:
        return ()
    whole = math.inf if duration is None else duration
    # A trace of n samples lasts n - 1 periods, and many count n.
    walk = _Walk(formula, whole, 1.01 * dt, END_OF_TRACE[end])
    return *_at_the_start(formula, dt, whole), *walk.beyond.values(), *walk.cuts(formula, dt)


def shortfalls_in(
    signals: Mapping[str, np.ndarray], formula: Formula, dt: float, duration: float, end: End
) -> list[Shortfall]:
    """Return the parts of a formula that fit a recording less than was probably meant.

    The time at which something that never changes is tested does not matter.

    **Arguments:**
    - `signals`: the signals of the recording by name; others as in `shortfalls`.
    """
    return [
        fall
        for fall in shortfalls(formula, dt, duration, end)
        if fall.kind != "start"
        or any((signals[name] != signals[name][:1]).any() for name in fall.part.signals())
    ]


def _at_the_start(formula: Formula, dt: float, duration: float) -> Iterator[Shortfall]:
    """Yield the parts that only the first sample decides."""
    asked = formula.asked(dt)
    todo, seen = [(formula, formula)], set[Formula]()
    while todo:
        part, whole = todo.pop()
        if part in seen or isinstance(part, ast.Constant):
            continue
        seen.add(part)
        word, operands, span = surface(part) if part.operands() else ("", (), None)
        last = min(asked[part][1], duration) if part in asked else math.inf
        meant = _changed(formula, {whole: None}) if last == 0 else ""
        if word and OPERATORS[word].side == "back" and last <= (span.start if span else 0.0):
            where = "at the first sample" if last == 0 else f"up to {format_seconds(last)}"
            text = f"{part} is evaluated only {where}, and there is nothing where it looks"
        elif part.temporal_depth or asked.get(part) != (0.0, 0.0):
            # What only the first sample decides may lead to something later.
            todo += [(each, part if word == "implies" else each) for each in operands]
            continue
        elif part == formula:
            text = "there is no temporal operator, so that only the first sample is tested"
        else:
            text = f"{part} stands below no temporal operator: only the first sample is tested"
        yield Shortfall("start", part, text, str(meant))


def _changed(f: Formula, changes: Mapping[Formula, Interval | None]) -> Formula:
    """Return a formula with other intervals for some parts, or, for None, always these parts."""
    known: dict[Formula, Formula] = {}
    for part in postorder(f):
        if isinstance(part, Formula):
            same = rebuild(part, tuple(known[each] for each in part.operands()))
            if part in changes:
                span = changes[part]
                same = replace(same, interval=span) if span else ast.Always(same)  # pyright: ignore
            known[part] = same
    return known[f]


class _Walk:
    """A walk over a formula that compares its windows with the duration of a trace."""

    def __init__(self, formula: Formula, duration: float, slack: float, end: str) -> None:
        self.duration, self.slack, self.end = duration, slack, end
        self.beyond: dict[Formula, Shortfall] = {}
        self.cut: dict[Formula, tuple[str, dict[Formula, Interval]]] = {}
        """By outer window: what is the matter, and the intervals with which all windows fit."""
        # A part, whether it stands below no negation, when it is first evaluated, what is around.
        todo: list[tuple[Formula, bool, float, tuple[_Outer, ...]]] = [(formula, True, 0.0, ())]
        seen = set[object]()
        while todo and len(seen) < MAX_STATES:
            state = todo.pop()
            if state not in seen:
                seen.add(state)
                todo += self._below(*state)

    def _below(
        self, part: Formula, positive: bool, first: float, around: tuple[_Outer, ...]
    ) -> Iterator[tuple[Formula, bool, float, tuple[_Outer, ...]]]:
        sign = getattr(part, "sign", 1) * (1 if positive else -1)
        if isinstance(part, ast.Join):
            around = tuple(o._replace(joined=o.joined or sign != o.sign) for o in around)
        if not (part.side and part.operator.timed):
            # The next and the previous sample are within the slack.
            positive ^= isinstance(part, ast.Not)
            yield from ((each, positive, first, around) for each in part.valued())
            return
        start, end, ahead = part.interval.start, part.interval.end, part.side == "ahead"
        endless = math.isinf(end)
        reach = first + (start if endless else end)
        # An endless window that is there for one sample alone might as well not be.
        if ahead and reach > self.duration + (-self.slack / 2 if endless and start else self.slack):
            lasts = f"and a trace lasts {format_seconds(self.duration)}: {self.end}"
            text = f"{part} looks {format_seconds(reach)} ahead {lasts}"
            self.beyond.setdefault(part, Shortfall("beyond", part, text))
            return
        for outer in around:
            if outer.sign != sign and (ahead or outer.sign > 0):
                (self._cut_at_the_end if ahead else self._cut_at_the_start)(outer, part)
        moved = "later" if ahead else "sooner"
        around = tuple(o._replace(**{moved: getattr(o, moved) + end}) for o in around)
        left, *rest = part.valued()
        if rest:  # From now on to the witness.
            yield left, positive, first if ahead else max(first - end, 0.0), around
        chosen = (*around, _Outer(part, sign, first)) if ahead and end > start else around
        first = first + start if ahead else max(first - end, 0.0)
        yield (rest or [left])[-1], positive, first, chosen

    def _cut_at_the_end(self, outer: _Outer, inner: Formula) -> None:
        (start, end), length = _ends(outer.window), inner.interval.end
        fits = {}
        text = "begin" if outer.sign > 0 else "that begins"
        latest = self.duration - outer.asked - outer.later
        if math.isinf(length):
            wrong = math.isinf(end + outer.later) or end >= latest - self.slack / 2
            wrong &= outer.sign > 0 or not outer.joined
            text += " at the last sample, where that sample alone decides"
            # Nobody knows what was meant: half of the trace is an example.
            latest = (start + latest) / 2
            if outer.sign < 0 and math.isfinite(latest):
                wait = self.duration - outer.asked - latest + inner.interval.start
                fits[inner] = Interval(inner.interval.start, wait)
        else:
            latest -= length
            # Everybody writes always (x -> eventually[0,5] y) for traces that end.
            wrong = outer.sign > 0 if math.isinf(end) else end - latest > self.slack
            # One that fits nowhere is beyond the trace.
            wrong &= start <= latest
            if math.isfinite(self.duration):
                at = min(outer.asked + end + outer.later, self.duration)
                left = f"{format_seconds(self.duration - at)} of its {format_seconds(length)}"
                text += f" as late as {format_seconds(at)}, when {left} are left of a trace of "
                text += format_seconds(self.duration)
                text += "" if outer.sign > 0 else ", so that the end alone may break it"
            else:
                text += " up to the end of the trace, which cuts its window"
        if wrong:
            fits = {outer.window: Interval(start, latest), **fits} if latest < math.inf else {}
            self._keep(outer, inner, text, fits)

    def _cut_at_the_start(self, outer: _Outer, inner: Formula) -> None:
        (start, end), length = _ends(outer.window), inner.interval.end
        earliest = outer.asked + start - outer.sooner
        missing = length - earliest
        if math.isinf(length):
            if earliest <= 0 and not outer.joined:
                text = "end at the first sample, where that sample alone decides"
                self._keep(outer, inner, text, {})
        elif missing > 1e-9:
            at = format_seconds(max(earliest, 0.0))
            text = f"end at {at}, before its {format_seconds(length)} have passed"
            fits = start + missing <= min(end, self.duration)
            fitted = {outer.window: Interval(start + missing, end)} if fits else {}
            self._keep(outer, inner, text, fitted)

    def _keep(
        self, outer: _Outer, inner: Formula, text: str, fitted: dict[Formula, Interval]
    ) -> None:
        window = outer.window
        known = self.cut.get(window, ("", {}))[1]
        if not known or (fitted and fitted[window].end < known[window].end):
            verb = "lets" if outer.sign > 0 else "asks for"
            self.cut[window] = f"{heading(window)} {verb} {heading(inner)} {text}", fitted

    def cuts(self, formula: Formula, dt: float) -> Iterator[Shortfall]:
        """Yield the windows that are cut, with the formula in which none is."""
        changes = {part: span for _, fitted in self.cut.values() for part, span in fitted.items()}
        meant = _changed(formula, {part: _on_grid(span, dt) for part, span in changes.items()})
        for window, (sentence, _) in self.cut.items():
            yield Shortfall("cut", window, sentence, "" if meant == formula else str(meant))


def _ends(window: Formula) -> tuple[float, float]:
    return window.interval.start, window.interval.end


def _on_grid(span: Interval, dt: float) -> Interval:
    """Return the widest interval in another one whose ends are multiples of the period."""
    if not dt:
        return span
    start, end = math.ceil(span.start / dt - 1e-6), span.end / dt + 1e-6
    last = end if math.isinf(end) else max(math.floor(end), start)
    low, high = (float(f"{steps * dt:z.10g}") for steps in (start, last))
    # An end that moved inwards belongs to the interval.
    ends = span.open_start and low == span.start, span.open_end and high == span.end
    return Interval(low, high, *ends)
