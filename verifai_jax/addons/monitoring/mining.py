"""The tightest values of a formula's parameters for which recordings satisfy it.

    mined = mine("always (distance > ?d)", ["drive-1.csv", "drive-2.csv"])
    mined.values, mined.formula             # {'d': 4.217}, always (distance >= 4.217)
    mine("always[0, ?T] (distance > ?d)", recordings).front
    mine("always (distance > ?d)", problem, budget=2000)

The formula is monotone in each parameter, so its satisfying values are all those up to, or from, a
limit. Bisection finds this limit to the last double, and to the last instant for times. A front of
two parameters is followed from corner to corner by the same bisection.

Source: E. Asarin, A. Donze, O. Maler, D. Nickovic, "Parametric identification of temporal
properties", RV 2011.
"""

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from verifai_jax.addons.monitoring.parametric import Parametric, read_parametric
from verifai_jax.addons.monitoring.recorded import Recordings, Simulated, named_traces
from verifai_jax.core.display.figure import Drawn
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.checks import check_fraction
from verifai_jax.core.messages.text import format_percent
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl.evaluate import End
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.host_values import HostValues
from verifai_jax.mtl.words import number_text
from verifai_jax.statistics.binomial import Rate, clopper_pearson

LARGEST = 1e100
"""Numbers beyond it are taken for no bound at all: their products are still finite."""
MAX_CORNERS = 2000
"""Corners of a front at most; each takes two bisections of 64 steps."""
SAMPLED = 129
"""Values at which it is tried whether a formula is monotone, where its tree does not tell."""


@dataclass(frozen=True)
class Mined(Drawn, InNotebook):
    """The tightest parameters that recordings satisfy.

    - `text`: the formula with its parameters.
    - `values`: the tightest values by name; for a front, its most balanced corner.
    - `front`: the corners for two parameters: neither can be tighter unless the other gets looser.
      One entry for one parameter.
    - `formula`: the formula with `values`, which the recordings satisfy.
    - `tightest`: for each name `"least"` or `"greatest"`, the direction of a tighter formula.
    - `sampled`: parameters in which the formula was found monotone by trying values.
    - `recordings`, `satisfied`: number of recordings, and of those that satisfy `formula`.
    - `broken`: the rate of recordings that break it, with its interval.
    - `searched`: number of simulations that did not break it, if a problem was searched; else None.
    """

    text: str
    values: dict[str, float]
    front: tuple[dict[str, float], ...]
    formula: Formula
    tightest: dict[str, str]
    sampled: tuple[str, ...]
    recordings: int
    satisfied: int
    broken: Rate
    searched: int | None = None
    _picture = "verifai_jax.addons.monitoring.pictures", "plot_mined"

    def summary(self) -> str:
        """Write the parameters that were found, and the data that they rest on."""
        lines = [f"{self.text}"]
        for name, side in self.tightest.items():
            value = number_text(self.values[name])
            known = " (monotone by trial, not by the formula)" if name in self.sampled else ""
            lines.append(f"  {name:<10} {value}, the {side} that is satisfied{known}")
        if len(self.front) > 1:
            lines.append(f"  front      {len(self.front)} corners; the most balanced is shown")
        lines.append(f"  formula    {self.formula}")
        if self.searched is not None:
            said = "simulations did not break it: found by search, no proof"
            lines.append(f"  searched   {self.searched} {said}")
        else:
            low, high = 1 - self.broken.high, 1 - self.broken.low
            lines.append(
                f"  satisfied  {self.satisfied} of {self.recordings} recordings; of recordings "
                f"like these {format_percent(low)} to {format_percent(high)} "
                f"({format_percent(self.broken.confidence)} interval, if the values had been "
                "chosen beforehand)"
            )
        return "\n".join(lines)

    __str__ = summary


def mine(
    text: str,
    recordings: Recordings,
    *,
    share: float = 1.0,
    end: End = "hold",
    constants: Mapping[str, float] | None = None,
    definitions: Mapping[str, Formula | str] | None = None,
    confidence: float = 0.95,
    budget: int = 2000,
    seed: int = 0,
    progress: bool | None = None,
) -> Mined:
    """Find the tightest parameters with which recordings satisfy a formula.

    Thresholds are exact to the last digit of the data, times to the sample.

    **Arguments:**
    - `text`: a formula with one or two parameters `?name`, for numbers or ends of intervals.
    - `recordings`: traces, files or tables. For a `Problem` a search looks for the tightest values
      that it cannot break, which proves nothing.
    - `share`: the share of the recordings that must satisfy it.
    - `end`: how a trace continues after the last sample, `"hold"` or `"truncate"`.
    - `constants`, `definitions`: as in `parse`; a constant can fix a parameter's value.
    - `confidence`: the confidence of the interval for the rate of recordings that break it.
    - `budget`, `seed`: maximum number of simulations of the search for a problem, and its seed.
    - `progress`: whether to show one line of progress for a problem; see `core.display.progress`.
    **Raises:** `FormulaSyntaxError`; `ValueError` for more than two parameters, one in which the
    formula is not monotone, or one that the data do not bound or that no value satisfies.
    """
    template = read_parametric(text, constants, definitions)
    if len(template.names) > 2:
        raise ValueError(
            f"one parameter or two can be mined together; {text!r} has "
            f"{', '.join('?' + name for name in template.names)}: write numbers for the others"
        )
    check_fraction("share", share, one=True)
    if isinstance(recordings, Simulated):
        search = lazy_import("verifai_jax.addons.monitoring.mined_bounds", "mine_by_search")
        return search(template, recordings, budget, seed, confidence, progress)
    return mine_template(template, tuple(named_traces(recordings).values()), share, end, confidence)


def mine_template(
    template: Parametric, traces: Sequence[Trace], share: float = 1.0, end: End = "hold",
    confidence: float = 0.95,
) -> Mined:  # fmt: skip
    """Find the tightest parameters of a parsed formula; see `mine`."""
    if len(template.names) == 2 and template.together(*template.names):
        raise ValueError(
            f"{' and '.join('?' + name for name in template.names)} occur in one comparison, so "
            "each value of one determines the other: write a number for one of them"
        )
    values = [HostValues.of(trace, end) for trace in traces]
    satisfied = _Satisfied(template, values, math.ceil(share * len(values) - 1e-9))
    axes = [_axis(template, name, satisfied) for name in template.names]
    one, *others = axes
    corners = _staircase(one, others[0], satisfied) if others else _one(one, satisfied)
    front = tuple(dict(zip(template.names, corner, strict=True)) for corner in corners)
    chosen = front[_balanced(corners, axes)]
    formula, count = template.formula(chosen), len(values)
    held = sum(each.holds(formula) for each in values)
    tightest = {axis.name: "greatest" if axis.sign < 0 else "least" for axis in axes}
    sampled = tuple(axis.name for axis in axes if axis.sampled)
    broken = clopper_pearson(count - held, count, confidence)
    return Mined(template.text, chosen, front, formula, tightest, sampled, count, held, broken)


@dataclass
class _Satisfied:
    """Whether enough recordings satisfy a formula with values of its parameters."""

    template: Parametric
    values: Sequence[HostValues]
    needed: int

    def __post_init__(self) -> None:
        self._order = list(range(len(self.values)))

    def __call__(self, given: Mapping[str, float]) -> bool:
        formula = self.template.formula(given)
        allowed = len(self.values) - self.needed
        for number in self._order:
            allowed -= not self._holds(number, formula)
            if allowed < 0:
                return False
        return True

    def tightest(self, axis: "_Axis", given: Mapping[str, float], first: int = 0) -> int | None:
        """Return the number of the tightest value of an axis, from `first` on; None if none is."""
        if self.needed < len(self.values):
            return axis.tightest(lambda value: self({**given, axis.name: value}), first, axis.last)
        tight: int | None = axis.last
        for number in list(self._order):

            def holds(value: float, number: int = number) -> bool:
                return self._holds(number, self.template.formula({**given, axis.name: value}))

            # Few recordings are tighter than all before them, and they come first next time.
            if tight is not None and not holds(axis.value(tight)):
                tight = axis.tightest(holds, first, tight - 1)
                self._order.remove(number)
                self._order.insert(0, number)
        return tight

    def _holds(self, number: int, formula: Formula) -> bool:
        try:
            return self.values[number].holds(formula)
        except ValueError as error:
            raise type(error)(f"recording {number}: {error}") from None
        finally:
            self.values[number].forget()


@dataclass(frozen=True)
class _Axis:
    """The values of a parameter by whole numbers, from the loosest one to the tightest one.

    - `sign`: 1 where a greater value is easier to satisfy, so that tight is the least.
    - `last`: the number of the tightest value; the loosest has number 0.
    """

    name: str
    sign: int
    last: int
    value: Callable[[int], float]
    bounded: bool
    sampled: bool

    def tightest(self, holds: Callable[[float], bool], first: int, last: int) -> int | None:
        """Return the number of the tightest value that holds, or None if the first does not."""
        if first > last or not holds(self.value(first)):
            return None
        low, high = first, last + 1
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if holds(self.value(middle)) else (low, middle)
        return low

    def is_free(self, number: int) -> bool:
        """Return whether the number is the tightest or the loosest one, which bounds nothing."""
        return not self.bounded and number in (0, self.last)


def _axis(template: Parametric, name: str, satisfied: _Satisfied) -> _Axis:
    sign = template.direction(name)
    if name not in template.times:
        last = _ordinal(LARGEST) - _ordinal(-LARGEST)
        sampled = sign == 0
        if sampled:
            sizes = [np.nanmax(np.abs(s)) for v in satisfied.values for s in v.signals.values()]
            reach = 2.0 * max(map(float, sizes)) + 1.0
            sign = _tried(template, name, satisfied, np.linspace(-reach, reach, SAMPLED).tolist())
        return _Axis(name, sign, last, _doubles(-sign), False, sampled)
    periods = {each.dt for each in satisfied.values}
    if len(periods) > 1:
        raise ValueError(
            f"?{name} is a time, and the recordings have periods of "
            f"{', '.join(f'{dt:zg} s' for dt in sorted(periods))}: resample them to one"
        )
    (dt,) = periods
    duration = max((each.length // each.stride - 1) * dt for each in satisfied.values)
    low, high = template.range_of_time(name)
    first = math.ceil(low / dt - 1e-6)
    last = math.floor(min(high, max(duration, low)) / dt + 1e-6)

    def time(k: int) -> float:
        return round((last - k if sign > 0 else first + k) * dt, 12)

    sampled = sign == 0
    if sampled:
        sign = _tried(template, name, satisfied, [time(k) for k in range(last - first + 1)])
    return _Axis(name, sign, last - first, time, True, sampled)


def _tried(template: Parametric, name: str, satisfied: _Satisfied, values: Sequence[float]) -> int:
    """Return the direction of a parameter that trying values shows. **Raises:** `ValueError`."""
    others = [other for other in template.names if other != name]
    if others:
        raise ValueError(
            f"the form of the formula does not show whether it is monotone in ?{name}, and this "
            f"can be tried only for a single parameter: write a number for ?{others[0]}"
        )
    formulas = [template.formula({name: value}) for value in values]
    found = [[each.holds(formula) for formula in formulas] for each in satisfied.values]
    changes = np.diff(np.array(found, int))
    rises, falls = bool((changes > 0).any()), bool((changes < 0).any())
    if rises and falls:
        raise ValueError(
            f"{template.text!r} is not monotone in ?{name}: as it grows the formula becomes both "
            "true and false, so there is no tightest value. Use different names where it occurs "
            "several times"
        )
    if not (rises or falls):
        raise ValueError(f"no value of ?{name} that was tried changes the truth of the formula")
    return 1 if rises else -1


def _doubles(direction: int) -> Callable[[int], float]:
    """Return the doubles in order, from the loosest one on, which is that of number 0."""
    lowest = _ordinal(-LARGEST)
    return lambda k: direction * _double(lowest + k)


def _ordinal(value: float) -> int:
    """Return the position of a double among all doubles: those next to each other differ by 1."""
    (bits,) = struct.unpack("<q", struct.pack("<d", value))
    return bits if bits >= 0 else -(bits & (2**63 - 1))


def _double(ordinal: int) -> float:
    (size,) = struct.unpack("<d", struct.pack("<q", abs(ordinal)))
    return size if ordinal >= 0 else -size


def _one(axis: _Axis, satisfied: _Satisfied) -> list[tuple[float, ...]]:
    number = satisfied.tightest(axis, {})
    if number is None:
        raise ValueError(f"no value of ?{axis.name} satisfies {satisfied.template.text!r}")
    if axis.is_free(number):
        raise ValueError(
            f"every value of ?{axis.name} satisfies {satisfied.template.text!r}: the data do "
            "not bound it"
        )
    return [(axis.value(number),)]


def _staircase(one: _Axis, other: _Axis, satisfied: _Satisfied) -> list[tuple[float, ...]]:
    """Walk the corners of the front from the loosest value of one parameter to its tightest."""
    corners: list[tuple[float, ...]] = []
    number: int | None = 0
    while number is not None and len(corners) < MAX_CORNERS:
        a = one.value(number)
        tight = satisfied.tightest(other, {one.name: a})
        if tight is None:
            break
        b = other.value(tight)
        # The loosest value does hold here, and from there to the tightest that does.
        number = satisfied.tightest(one, {other.name: b}, number)
        assert number is not None
        if not (one.is_free(number) or other.is_free(tight)):
            corners.append((one.value(number), b))
        number = number + 1 if number < one.last else None
    if not corners:
        raise ValueError(
            f"{satisfied.template.text!r} has no tightest pair of ?{one.name} and ?{other.name}: "
            "the data do not bound one of them, or no values satisfy it"
        )
    return corners


def _balanced(corners: Sequence[tuple[float, ...]], axes: Sequence[_Axis]) -> int:
    """Return the corner whose looser parameter is tightest, each measured by its own spread."""
    points = np.array(corners) * [axis.sign for axis in axes]
    spread = np.ptp(points, axis=0)
    looseness = (points - points.min(axis=0)) / np.where(spread > 0, spread, 1.0)
    return int(np.argmin(looseness.max(axis=1)))
