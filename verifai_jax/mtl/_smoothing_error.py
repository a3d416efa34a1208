"""The greatest distance of the smooth robustness from the hard one, in temperatures.

A smooth maximum of n values exceeds the hard one by at most tau log n, a smooth minimum lies as far
below. Along a path of sub-formulas these errors add up; adjacent maxima count as one.
"""

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl.evaluate import End, Evaluator
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.semantics import hard
from verifai_jax.mtl.setting import Setting, evaluator_of, prepare
from verifai_jax.mtl.tree import missing_case


class SmoothingError(NamedTuple):
    """Bounds of the hard robustness: `smooth - tau * above <= hard <= smooth + tau * below`.

    - `above`, `below`: the two bounds, in units of the temperature.
    """

    above: float
    below: float

    @property
    def total(self) -> float:
        """The larger of the two: `|smooth - hard| <= tau * total`."""
        return max(self.above, self.below)


def smoothing_error(
    formula: Formula | str, trace: Trace, end: End = "hold", compat: str | None = None
) -> SmoothingError:
    """Bound the difference between smooth and hard robustness for traces of this form.

    **Arguments:** those of `robustness`; only the trace's length and period matter, not its values.
    **Returns:** `above` and `below`, in units of the temperature: `smooth - tau * above <= hard <=
    smooth + tau * below`.
    """
    setting, _, _, _ = prepare(formula, trace, hard, end, compat)
    return error_of_setting(setting)


@functools.lru_cache(maxsize=1024)
def error_of_setting(setting: Setting, last: int = 0) -> SmoothingError:
    """Bound the difference at any of the instants 0 to `last`."""
    return slack(evaluator_of(setting, {}, None, None, 0), setting.formula, 0, last)


@dataclass(frozen=True)
class _Slack:
    """Slack of a value that is itself a maximum (or minimum) of exp(`log_count`) values.

    `above` and `below` are those of the values it joins, without the join itself.
    """

    above: float = 0.0
    below: float = 0.0
    kind: str = ""
    log_count: float = 0.0

    def settled(self) -> tuple[float, float]:
        above = self.above + (self.log_count if self.kind == "max" else 0.0)
        below = self.below + (self.log_count if self.kind == "min" else 0.0)
        return above, below

    def negated(self) -> "_Slack":
        kind = {"max": "min", "min": "max", "": ""}[self.kind]
        return _Slack(self.below, self.above, kind, self.log_count)


def slack(evaluator: Evaluator, f: Formula, first: int, last: int) -> SmoothingError:
    """Return bounds on the error of `f`'s smooth value at any instant from `first` to `last`."""
    return SmoothingError(*_slack(evaluator, f, first, last).settled())


def _joined(kind: str, parts: list[_Slack], repeats: float = 1.0) -> _Slack:
    """Join the `parts`, each of them `repeats` times."""
    above = below = 0.0
    logs = []
    for part in parts:
        if part.kind in (kind, ""):
            above, below = max(above, part.above), max(below, part.below)
            logs.append(part.log_count)
        else:
            a, b = part.settled()
            above, below = max(above, a), max(below, b)
            logs.append(0.0)
    top = max(logs)
    log_count = top + math.log(sum(math.exp(x - top) for x in logs)) + math.log(repeats)
    return _Slack(above, below, kind, log_count)


_KIND = {-1: "min", 1: "max"}


def _slack(e: Evaluator, f: Formula, first: int, last: int) -> _Slack:
    match f:
        case ast.Not(operand):
            return _slack(e, operand, first, last).negated()
        case ast.Join(parts):
            return _joined(_KIND[f.sign], [_slack(e, p, first, last) for p in parts])
        case ast.Window(operand, interval):
            window = _future if f.side == "ahead" else _past
            return window(e, operand, _KIND[f.sign], *e.span(interval), first, last)
        case ast.Derived():
            return _slack(e, f.meaning, first, last)
        case ast.Next(operand) | ast.Prev(operand):
            step = e.stride if isinstance(f, ast.Next) else -e.stride
            return _slack(e, operand, max(0, first + step), max(0, last + step))
        case ast.Witness(left, right, interval):
            a, b = e.span(interval)
            ahead = f.side == "ahead"
            window = _future if ahead else _past
            end = max(e.settles(left), e.settles(right), first + a) if ahead else max(last - a, 0)
            begin = min(first + a, end) if ahead else 0
            terms = [_until(e, left, right, end - begin + 1, begin, end)]
            if math.isfinite(b):
                terms.append(window(e, right, "max", a, b, first, last))
            if a > 0:
                terms.append(window(e, left, "min", 0, a - 1, first, last))
            return _joined("min", terms) if len(terms) > 1 else terms[0]
        case ast.Constant() | ast.Predicate() | ast.Atom():
            return _Slack()
    raise missing_case("the smoothing error", f)


def _until(e: Evaluator, f: Formula, g: Formula, n: int, first: int, last: int) -> _Slack:
    # By induction along the recursion each sample adds one to the count under the logarithm, on
    # both sides.
    parts = [_slack(e, h, first, last).settled() for h in (f, g)]
    above, below = (max(side) + math.log(n) for side in zip(*parts, strict=True))
    return _Slack(above, below)


def _future(e: Evaluator, f: Formula, kind: str, a: int, b: float, first: int, last: int) -> _Slack:
    end = max(e.settles(f), first + a)
    stop = end if math.isinf(b) else min(last + int(b), end)
    count = min(stop - (first + a) + 1, b - a + 1)
    begin = min(first + a, e.settles(f))
    return _joined(kind, [_slack(e, f, begin, max(begin, stop))], max(1.0, count))


def _past(e: Evaluator, f: Formula, kind: str, a: int, b: float, first: int, last: int) -> _Slack:
    stop = max(0, last - a)
    begin = 0 if math.isinf(b) else max(0, first - int(b))
    count = min(stop - begin + 1, b - a + 1)
    return _joined(kind, [_slack(e, f, begin, stop)], max(1.0, count))
