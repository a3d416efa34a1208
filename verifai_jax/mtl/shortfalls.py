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
from verifai_jax.mtl.evaluate import End
from verifai_jax.mtl.formula import Formula, Interval, surface
from verifai_jax.mtl.rewriting import rebuild, replaced
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
    - `part`: the part of the formula.
    - `sentence`: what is the matter with it.
    - `meant`: the formula that was probably meant, if that is known.
    """

    kind: str
    part: Formula
    sentence: str
    meant: str = ""

    def __str__(self) -> str:
        return f"{self.sentence}{self.meant and f'. Probably meant: {self.meant}'}"


class _Outer(NamedTuple):
    """A window around a part, as what may choose the instant at which the part is evaluated.

    - `sign`: 1 if one good instant is enough, -1 if each has to be good.
    - `asked`: the instant, in seconds, at which the window itself is evaluated: the first one, or
      the last one for a window that looks back.
    - `later`, `sooner`: how far the windows in between move the part.
    - `joined`: whether another part has a say in the choice.
    """

    window: Formula
    sign: int
    asked: float
    later: float = 0.0
    sooner: float = 0.0
    joined: bool = False


class _State(NamedTuple):
    """A part, its polarity, and the first and last instant at which it is evaluated."""

    part: Formula
    positive: bool
    first: float
    last: float
    around: tuple[_Outer, ...] = ()


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
    walk = _Walk(whole, 1.01 * dt, END_OF_TRACE[end])
    walk.over(formula)
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
        meant = replaced(formula, {whole: ast.Always(whole)}) if last == 0 else ""
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


def _changed(f: Formula, intervals: Mapping[Formula, Interval]) -> Formula:
    """Return a formula with other intervals for some of its windows."""
    same = rebuild(f, tuple(_changed(part, intervals) for part in f.operands()))
    return replace(same, interval=intervals[f]) if f in intervals else same  # pyright: ignore


class _Walk:
    """A walk over a formula that compares its windows with the duration of a trace."""

    def __init__(self, duration: float, slack: float, end: str) -> None:
        self.duration, self.slack, self.end = duration, slack, end
        self.beyond: dict[Formula, Shortfall] = {}
        self.cut: dict[Formula, tuple[_Outer, Formula, Interval | None]] = {}
        """By outer window: the inner one that is cut, and the outer interval in which it fits."""

    def over(self, formula: Formula) -> None:
        todo, seen = [_State(formula, True, 0.0, 0.0)], set[_State]()
        while todo and len(seen) < MAX_STATES:
            state = todo.pop()
            if state not in seen:
                seen.add(state)
                todo += self._below(state)

    def _below(self, at: _State) -> Iterator[_State]:
        part = at.part
        if isinstance(part, ast.Not):
            yield at._replace(part=part.operand, positive=not at.positive)
        elif isinstance(part, ast.Join):
            sign = part.sign if at.positive else -part.sign
            around = tuple(o._replace(joined=o.joined or sign != o.sign) for o in at.around)
            yield from (at._replace(part=each, around=around) for each in part.parts)
        elif part.side and part.operator.timed:
            yield from self._window(at, part.interval, part.side == "ahead")
        else:  # The next and the previous sample are within the slack.
            yield from (at._replace(part=each) for each in part.valued())

    def _window(self, at: _State, span: Interval, ahead: bool) -> Iterator[_State]:
        part, a, b = at.part, span.start, span.end
        sign = (part.sign if isinstance(part, ast.Window) else 1) * (1 if at.positive else -1)
        endless = math.isinf(b)
        reach = at.first + (a if endless else b)
        # An endless window that is there for one sample alone might as well not be.
        slack = -self.slack / 2 if endless and a else self.slack
        if ahead and reach > self.duration + slack:
            text = f"{part} looks {format_seconds(reach)} ahead and a trace lasts "
            text += f"{format_seconds(self.duration)}: {self.end}"
            self.beyond.setdefault(part, Shortfall("beyond", part, text))
            return
        for outer in at.around:
            if outer.sign != sign:
                self._compare(outer, part, ahead)
        if ahead:
            around = tuple(o._replace(later=o.later + b) for o in at.around)
            first, last = at.first + a, min(at.last + b, max(self.duration, at.first + a))
        else:
            around = tuple(o._replace(sooner=o.sooner + b) for o in at.around)
            first, last = max(at.first - b, 0.0), max(at.last - a, 0.0)
        own = _Outer(part, sign, at.first if ahead else at.last)
        chosen = (*around, own) if b > a else around
        if isinstance(part, ast.Window):
            yield _State(part.operand, at.positive, first, last, chosen)
        elif isinstance(part, ast.Witness):
            yield _State(part.right, at.positive, first, last, chosen)
            # From now on to the witness.
            first, last = (at.first, last) if ahead else (first, at.last)
            yield _State(part.left, at.positive, first, last, around)

    def _compare(self, outer: _Outer, inner: Formula, ahead: bool) -> None:
        """Keep an inner window that is cut where an outer one may choose to begin it."""
        start, end = outer.window.interval.start, outer.window.interval.end
        length, lets = inner.interval.end, outer.sign > 0
        follows = outer.window.side == "ahead"
        fitted = None
        if not ahead:
            earliest = outer.asked - outer.sooner + (start if follows else -end)
            wrong = lets and (earliest <= 0 if math.isinf(length) else length - earliest > 1e-9)
            wrong &= math.isfinite(length) or not outer.joined
            start += length - earliest
            if follows and start <= min(end, self.duration) < math.inf:
                fitted = Interval(start, end)
        elif not follows:
            return
        elif math.isinf(length):
            latest = outer.asked + end + outer.later
            wrong = math.isinf(latest) or latest >= self.duration - self.slack / 2
            wrong &= lets or not outer.joined
            # Nobody knows what was meant: half of the trace is an example.
            middle = (start + self.duration - outer.asked) / 2
            if start < middle < math.inf:
                fitted = Interval(start, middle)
        else:
            latest = self.duration - outer.asked - outer.later - length
            # Everybody writes always (x -> eventually[0,5] y) for traces that end.
            wrong = lets if math.isinf(end) else end - latest > self.slack
            if start <= latest < math.inf:
                fitted = Interval(start, latest)
            # One that fits nowhere is beyond the trace.
            wrong &= math.isinf(self.duration) or fitted is not None
        _, _, known = self.cut.get(outer.window, (None, None, None))
        if wrong and not (known and (not fitted or known.end <= fitted.end)):
            self.cut[outer.window] = outer, inner, fitted

    def cuts(self, formula: Formula, dt: float) -> Iterator[Shortfall]:
        """Yield the windows that are cut, with the formula in which none is."""
        changes: dict[Formula, Interval] = {}
        for outer, inner, fitted in self.cut.values():
            if fitted is None:
                continue
            changes[outer.window] = fitted
            if math.isinf(inner.interval.end) and outer.sign < 0:
                wait = self.duration - outer.asked - fitted.end
                changes[inner] = Interval(inner.interval.start, inner.interval.start + wait)
        meant = _changed(formula, {part: _on_grid(each, dt) for part, each in changes.items()})
        for outer, inner, _ in self.cut.values():
            sentence = self._sentence(outer, inner)
            advice = "" if meant == formula else str(meant)
            yield Shortfall("cut", outer.window, sentence, advice)

    def _sentence(self, outer: _Outer, inner: Formula) -> str:
        span, length = outer.window.interval, inner.interval.end
        lets = f"{_head(outer.window)} {'lets' if outer.sign > 0 else 'asks for'} {_head(inner)}"
        begin = " begin" if outer.sign > 0 else ""
        alone = "where that sample alone decides"
        if inner.side == "back":
            seen = outer.asked - outer.sooner
            seen = max(seen + (span.start if outer.window.side == "ahead" else -span.end), 0.0)
            if math.isinf(length):
                return f"{lets} end at the first sample, {alone}"
            passed = f"{format_seconds(seen)} of its {format_seconds(length)}"
            return f"{lets} end at {format_seconds(seen)}, when {passed} have passed"
        if math.isinf(length):
            return f"{lets}{begin} at the last sample, {alone}"
        if math.isinf(self.duration):
            return f"{lets}{begin} up to the end of the trace, which cuts its window"
        latest = min(outer.asked + span.end + outer.later, self.duration)
        left = f"{format_seconds(self.duration - latest)} of its {format_seconds(length)}"
        return (
            f"{lets}{begin} as late as {format_seconds(latest)}, when {left} are left of a trace "
            f"of {format_seconds(self.duration)}"
            f"{'' if begin else ', so that the end alone may break it'}"
        )


def _head(window: Formula) -> str:
    """Return the operator of a window with its interval."""
    span = window.interval
    return f"{window.word}{'' if span.everything else span}"


def _on_grid(span: Interval, dt: float) -> Interval:
    """Return an interval whose ends are multiples of the sampling period, where there is one."""

    def rounded(time: float) -> float:
        steps = time / dt if dt else math.nan
        return float(f"{math.floor(steps + 1e-6) * dt:.10g}") if math.isfinite(steps) else time

    start = -rounded(-span.start) if dt else span.start
    return Interval(start, max(rounded(span.end), start))
