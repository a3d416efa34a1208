"""The definitions of metric temporal logic, written out: slow, and independent of the package."""

import functools
import math
import operator

from hypothesis import strategies as st

from verifai_jax.mtl import formula as ast
from verifai_jax.mtl.expression import Arithmetic, Component, Number, Signal, signal
from verifai_jax.mtl.sampled import Duration, duration

DT = 0.5
COMPARE = {
    ">": operator.gt, ">=": operator.ge, "<": operator.lt, "<=": operator.le,
    "==": operator.eq, "!=": operator.ne,
}  # fmt: skip


def past_reach(f):
    """Samples after which a held trace can no longer change the formula's value."""
    own = 0
    if isinstance(f, (ast.Once, ast.Historically, ast.Since)):
        end = f.interval.end if math.isfinite(f.interval.end) else f.interval.start
        own = round(end / DT) + 1
    elif isinstance(f, ast.Prev):
        own = 1
    return own + max((past_reach(p) for p in f.operands()), default=0)


class Oracle:
    """`rho(f, i)` and `holds(f, i)` of lists of floats, sample by sample."""

    def __init__(self, signals, end="hold", open_right=False):
        self.signals = signals
        self.length = len(next(iter(signals.values())))
        self.end = end
        self.open_right = open_right
        self.rho = functools.cache(self._rho)
        self.holds = functools.cache(self._holds)

    def number(self, e, i):
        match e:
            case Number(value):
                return value
            case Duration(_, (counted,), window):
                now = min(i, self.length - 1)
                ago = max(0, now - round(window.end / DT) + 1)
                return DT * sum(self.holds(counted, k) for k in range(ago, now + 1))
            case Signal(name):
                return self.signals[name][min(i, self.length - 1)]
            case Component(Signal(name), k):
                return self.signals[name][min(i, self.length - 1)][k]
            case Arithmetic("norm", (Signal(name),)):
                return math.hypot(*self.signals[name][min(i, self.length - 1)])
            case Arithmetic(name, arguments):
                values = [self.number(a, i) for a in arguments]
                return {
                    "+": lambda: values[0] + values[1],
                    "-": lambda: values[0] - values[1],
                    "*": lambda: values[0] * values[1],
                    "/": lambda: values[0] / values[1],
                    "**": lambda: values[0] ** values[1],
                    "neg": lambda: -values[0],
                    "abs": lambda: abs(values[0]),
                    "sqrt": lambda: math.sqrt(values[0]),
                    "sin": lambda: math.sin(values[0]),
                    "cos": lambda: math.cos(values[0]),
                    "min": lambda: min(values),
                    "max": lambda: max(values),
                }[name]()

    def window(self, interval, i, root, direction=1):
        """Instants of an interval ahead of `i` (behind, for direction -1)."""
        a = round(interval.start / DT)
        b = math.inf if math.isinf(interval.end) else round(interval.end / DT)
        if self.open_right and b > a:
            b -= 1
        if direction < 0:
            return range(max(0, i - b) if b < math.inf else 0, i - a + 1)
        final = self.length - 1
        if self.end != "truncate":
            # Far enough that everything below has settled.
            final = max(final + past_reach(root), i + a) if b == math.inf else i + a + (b - a)
        return range(i + a, min(i + b, final) + 1)

    def _rho(self, f, i):
        r = self.rho
        match f:
            case ast.Constant(value):
                return math.inf if value else -math.inf
            case ast.Predicate(comparison, left, right):
                a, b = self.number(left, i), self.number(right, i)
                return {
                    ">": a - b, ">=": a - b, "<": b - a, "<=": b - a,
                    "==": -abs(a - b), "!=": abs(a - b),
                }[comparison]  # fmt: skip
            case ast.Atom(e):
                return self.number(e, i)
            case ast.Not(p):
                return -r(p, i)
            case ast.And(parts):
                return min(r(p, i) for p in parts)
            case ast.Or(parts):
                return max(r(p, i) for p in parts)
            case ast.Next(p):
                return r(p, min(i + 1, self.length - 1) if self.end == "truncate" else i + 1)
            case ast.Prev(p, weak):
                return r(p, i - 1) if i > 0 else (math.inf if weak else -math.inf)
            case ast.Always(p, s):
                return min((r(p, j) for j in self.window(s, i, p)), default=math.inf)
            case ast.Eventually(p, s):
                return max((r(p, j) for j in self.window(s, i, p)), default=-math.inf)
            case ast.Historically(p, s):
                return min((r(p, j) for j in self.window(s, i, p, -1)), default=math.inf)
            case ast.Once(p, s):
                return max((r(p, j) for j in self.window(s, i, p, -1)), default=-math.inf)
            case ast.Until(p, q, s):
                return max(
                    (min([r(q, j), *(r(p, k) for k in range(i, j))]) for j in self.window(s, i, f)),
                    default=-math.inf,
                )
            case ast.Since(p, q, s):
                return max(
                    (
                        min([r(q, j), *(r(p, k) for k in range(j + 1, i + 1))])
                        for j in self.window(s, i, f, -1)
                    ),
                    default=-math.inf,
                )

    def _holds(self, f, i):
        h = self.holds
        match f:
            case ast.Constant(value):
                return value
            case ast.Predicate(comparison, left, right):
                return COMPARE[comparison](self.number(left, i), self.number(right, i))
            case ast.Atom(e):
                return self.number(e, i) > 0
            case ast.Not(p):
                return not h(p, i)
            case ast.And(parts):
                return all(h(p, i) for p in parts)
            case ast.Or(parts):
                return any(h(p, i) for p in parts)
            case ast.Next(p):
                return h(p, min(i + 1, self.length - 1) if self.end == "truncate" else i + 1)
            case ast.Prev(p, weak):
                return h(p, i - 1) if i > 0 else weak
            case ast.Always(p, s):
                return all(h(p, j) for j in self.window(s, i, p))
            case ast.Eventually(p, s):
                return any(h(p, j) for j in self.window(s, i, p))
            case ast.Historically(p, s):
                return all(h(p, j) for j in self.window(s, i, p, -1))
            case ast.Once(p, s):
                return any(h(p, j) for j in self.window(s, i, p, -1))
            case ast.Until(p, q, s):
                return any(
                    h(q, j) and all(h(p, k) for k in range(i, j)) for j in self.window(s, i, f)
                )
            case ast.Since(p, q, s):
                return any(
                    h(q, j) and all(h(p, k) for k in range(j + 1, i + 1))
                    for j in self.window(s, i, f, -1)
                )


# Random formulas

_quarters = st.integers(-8, 8).map(lambda n: n / 4)
_signals = st.sampled_from([signal("x"), signal("y")])
_expressions = st.one_of(
    _signals,
    _signals,
    st.builds(abs, _signals),
    st.builds(lambda a, b: a - b, _signals, _signals),
    st.builds(lambda a, b: a * 2 + b, _signals, _quarters),
    st.builds(lambda a, k: a**k, _signals, st.integers(0, 3)),
    st.builds(lambda a, b: a.min(b), _signals, _quarters),
    st.builds(lambda k: signal("p")[k], st.integers(0, 1)),
)
_leaves = st.one_of(
    st.builds(
        ast.Predicate,
        st.sampled_from(["<", "<=", ">", ">="]),
        _expressions,
        _quarters.map(Number),
    ),
    st.builds(ast.Predicate, st.sampled_from(["==", "!="]), _signals, _quarters.map(Number)),
    st.builds(ast.Atom, _signals),
    st.sampled_from([ast.TRUE, ast.FALSE]),
)


@st.composite
def intervals(draw):
    a = draw(st.integers(0, 4))
    b = draw(st.one_of(st.integers(a, a + 5), st.just(math.inf)))
    return ast.Interval(a * DT, b * DT)


def _grown(inner):
    unary = st.sampled_from([ast.Always, ast.Eventually, ast.Historically, ast.Once])
    binary = st.sampled_from([ast.Until, ast.Since])
    return st.one_of(
        st.builds(ast.Not, inner),
        st.builds(ast.Next, inner),
        st.builds(ast.Prev, inner, st.booleans()),
        st.builds(lambda k, f, i: k(f, i), unary, inner, intervals()),
        st.builds(lambda k, f, i: k(f, i), unary, inner, intervals()),
        st.builds(lambda k, f, g, i: k(f, g, i), binary, inner, inner, intervals()),
        st.lists(inner, min_size=2, max_size=3).map(lambda p: ast.And(tuple(p))),
        st.lists(inner, min_size=2, max_size=3).map(lambda p: ast.Or(tuple(p))),
        st.builds(lambda f, g: f >> g, inner, inner),
        st.builds(lambda f, g: f.iff(g), inner, inner),
        st.builds(lambda f, g: f ^ g, inner, inner),
        st.builds(lambda f, g, i: f.weak_until(g, i.start, i.end), inner, inner, intervals()),
        st.builds(lambda f, g, i: f.release(g, i.start, i.end), inner, inner, intervals()),
    )


@st.composite
def _counted(draw):
    """A comparison of what is counted, of formulas that look back."""
    x, y = (draw(_signals) > draw(_quarters) for _ in range(2))
    past = st.sampled_from([
        x, x & ~y, ast.Once(x, draw(intervals())), ~ast.Since(x, y, draw(intervals())),
        ast.Prev(x, True), ast.Historically(duration(y, 2 * DT) > 0.5, draw(intervals())),
    ])  # fmt: skip
    seconds = duration(draw(past), draw(st.integers(1, 5)) * DT)
    other = draw(st.one_of(_quarters.map(Number), _expressions))
    return ast.Predicate(draw(st.sampled_from(["<", "<=", ">", "=="])), seconds, other)


def formulas(depth=4, counted=False):
    leaves = st.one_of(_leaves, _counted()) if counted else _leaves
    grown = leaves
    for _ in range(depth):
        grown = st.one_of(leaves, _grown(grown))
    return _grown(grown) if depth else leaves


def numbers(size):
    return st.lists(_quarters, min_size=size, max_size=size)


@st.composite
def recordings(draw, sizes=(1, 2, 5, 9)):
    n = draw(st.sampled_from(sizes))
    p = draw(st.lists(st.tuples(_quarters, _quarters), min_size=n, max_size=n))
    return {"x": draw(numbers(n)), "y": draw(numbers(n)), "p": p}
