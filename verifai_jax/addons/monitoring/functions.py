"""Functions of samples that the texts of formulas may call: counts, rates, means, frozen values.

    count(rise(signal("alarm") > 0), 60) <= 3         # at most three alarms in any 60 s
    mean(signal("power"), 10) <= 5                    # of the last 10 s
    at_last(rise(signal("brake") > 0), signal("x"))   # where braking began

Each reads the present sample and earlier ones, so a monitor knows it at once; there are no samples
before the first one. `docs/formulas.md` has the definitions.
"""

from collections.abc import Sequence

from verifai_jax.mtl.expression import expression
from verifai_jax.mtl.formula import Formula, Interval, Term, formula
from verifai_jax.mtl.sampled import Operations, Sampled, V


class Count(Sampled):
    """The number of samples of a window at which a formula holds."""

    function = "count"
    english = "the number of samples of {window} at which {0}"

    def value(self, of: Operations[V], operands: Sequence[V], first: int, last: int) -> V:
        return of.total(of.before(operands[0], first), last - first + 1)


class Mean(Sampled):
    """The mean of the samples of a window."""

    function = "mean"
    english = "the mean of {0} over {window}"

    def value(self, of: Operations[V], operands: Sequence[V], first: int, last: int) -> V:
        one = of.number(1.0)
        total, number = (
            of.total(of.before(each, first), last - first + 1) for each in (operands[0], one)
        )
        if first:  # A window before the first sample has that one.
            none = of.apply("-", one, of.apply("min", number, one))
            held = of.before(operands[0], first, held=True)
            total = of.apply("+", total, of.apply("*", none, held))
        return of.apply("/", total, of.apply("max", number, one))


class PeakToPeak(Sampled):
    """The greatest sample of a window minus the least one."""

    function = "peak_to_peak"
    english = "the peak-to-peak value of {0} over {window}"

    def value(self, of: Operations[V], operands: Sequence[V], first: int, last: int) -> V:
        x = of.before(operands[0], first, held=True)
        n = last - first + 1
        return of.apply("-", of.extreme("max", x, n), of.extreme("min", x, n))


class Rate(Sampled):
    """The change over a window by its time; without a window since the sample before."""

    function = "rate"
    english = "the rate of change of {0}"

    def value(self, of: Operations[V], operands: Sequence[V], first: int, last: int) -> V:
        # The last 1 s are as many samples, and so many before is where the change began.
        start = last + (self.window is None or self.window.open_end)
        newer, older = (of.before(operands[0], n, held=True) for n in (first, start))
        return of.apply("/", of.apply("-", newer, older), of.number((start - first) * of.dt))


class AtLast(Sampled):
    """The value that an expression had at the last sample at which a formula held."""

    function = "at_last"
    english = "the value of {1} when last {0}"

    def value(self, of: Operations[V], operands: Sequence[V], first: int, last: int) -> V:
        return of.latest(operands[0], operands[1])


def count(operand: Formula | Term, window: Term | Interval | float) -> Sampled:
    """Count the samples of a window at which a formula holds; of events, `rise` and `fall`.

    **Arguments:**
    - `window`: the last so many seconds, as in `count(rise(alarm), 60) <= 3`, or an interval of
      seconds ago, such as `[0,60]`.
    **Raises:** `ValueError` for a formula that looks ahead, and for a window that is not positive.
    """
    return Count.of([formula(operand)], window)


def mean(operand: Term | float, window: Term | Interval | float) -> Sampled:
    """Return the mean of the samples of a window, such as the last 10 s in `mean(power, 10)`."""
    return Mean.of([expression(operand)], window)


def peak_to_peak(operand: Term | float, window: Term | Interval | float) -> Sampled:
    """Return the greatest minus the least sample of a window, as in `peak_to_peak(x, 5) <= 0.1`."""
    return PeakToPeak.of([expression(operand)], window)


def rate(operand: Term | float, window: Term | Interval | float | None = None) -> Sampled:
    """Return the rate of change by the second: since the sample before, or over a window.

    At the first sample, before which there is none, it is 0.

    **Arguments:**
    - `window`: the seconds over which it is measured, for a signal with noise.
    """
    return Rate.of([expression(operand)], window)


def at_last(event: Formula | Term, operand: Term | float) -> Sampled:
    """Return the value of an expression at the last sample at which `event` held, also now.

    Before the first event it is the value at the first sample.
    """
    return AtLast.of([formula(event), expression(operand)], None)
