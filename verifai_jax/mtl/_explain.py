"""The reason why a trace satisfies or breaks a formula: a predicate, an instant and a path to it.

    why = explain("always[0, 4] (abs(x) <= 2.4 & abs(theta) <= 0.2095)", trace)
    print(why)                                        # the path, the tree, the critical instants
    why.predicate, why.time, why.robustness
    draw(why)                                         # see `plot.py`

The hard robustness is the value of one predicate at one instant. Walking from the root to the
operand that decides each minimum or maximum finds it.
"""

import functools
import math
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from verifai_jax.core.notebook import InNotebook
from verifai_jax.core.text import LONG, STAMPS, format_seconds, format_time
from verifai_jax.core.trace import Trace
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl._robustness import satisfied
from verifai_jax.mtl.evaluate import End, Evaluator
from verifai_jax.mtl.formula import Formula, surface
from verifai_jax.mtl.semantics import hard
from verifai_jax.mtl.setting import Setting, check_trace, evaluator_of, prepare
from verifai_jax.mtl.tree import missing_case


@dataclass(frozen=True)
class Node:
    """A sub-formula at the instant at which its parent asked for it.

    `decides` says whether it lies on the path to the responsible predicate. `series` is its
    robustness at every sample.
    """

    formula: Formula
    time: float
    robustness: float
    decides: bool
    children: tuple["Node", ...]
    series: Float[np.ndarray, " time"] = field(repr=False)

    def path(self) -> tuple["Node", ...]:
        """Return the nodes from here down to the responsible leaf."""
        below = next((child for child in self.children if child.decides), None)
        return (self,) if below is None else (self, *below.path())

    def flat(self) -> list[tuple[int, "Node"]]:
        """Return itself and all nodes below with their depths, parents first.

        A node that occurs several times (as both sides of `<->` do) is followed by what is below it
        at its first occurrence only.
        """
        rows: list[tuple[int, Node]] = []
        listed: set[int] = set()
        stack: list[tuple[int, Node]] = [(0, self)]
        while stack:
            depth, node = stack.pop()
            rows.append((depth, node))
            if id(node) not in listed:
                listed.add(id(node))
                stack.extend((depth + 1, child) for child in reversed(node.children))
        return rows


@dataclass(frozen=True)
class Instant:
    """A predicate at an instant that matters, with its share of the robustness.

    The shares are those of the smooth robustness's gradient: all predicates and instants add to 1.
    """

    predicate: Formula
    time: float
    robustness: float
    share: float


@dataclass(frozen=True)
class Explanation(InNotebook):
    """The reason why a formula holds or fails on a trace; `str()` writes it, `draw` shows it."""

    formula: Formula
    holds: bool
    robustness: float
    tree: Node
    critical: tuple[Instant, ...]
    trace: Trace = field(repr=False)

    @property
    def path(self) -> tuple[Node, ...]:
        """Return the nodes from here down to the responsible leaf."""
        return self.tree.path()

    @property
    def predicate(self) -> Formula:
        """The predicate whose value is the robustness, up to sign."""
        return self.path[-1].formula

    @property
    def time(self) -> float:
        """When, in seconds."""
        return self.path[-1].time

    def __str__(self) -> str:
        lines = [
            f"{'Holds' if self.holds else 'Fails'} with robustness {self.robustness:z.4g}, decided "
            f"by  {self.predicate}  at {format_seconds(self.time)}",
            "",
        ]
        listed: set[int] = set()
        flat = self.tree.flat()
        instants = [node.time for _, node in flat] + [i.time for i in self.critical]
        # Of a long trace with their units, which of a short one are seconds throughout.
        long = any(LONG <= abs(instant) < STAMPS for instant in instants)
        write = format_seconds if long else format_time
        width = max(8, *(len(write(instant)) for instant in instants))
        for depth, node in flat:
            mark = "*" if node.decides else " "
            name = str(node.formula) if not node.children else heading(node.formula)
            if node.children and id(node) in listed:
                name += "  (as above)"
            listed.add(id(node))
            at = write(node.time)
            lines.append(f"{mark} {node.robustness:>z10.4g} at {at:<{width}} {'  ' * depth}{name}")
        lines += ["", "Most critical instants:"]
        lines += [
            f"  {i.share:>6.1%} at {at:<{width}} {i.robustness:>z10.4g}  {i.predicate}"
            for i, at in zip(self.critical, map(write, instants[len(flat) :]), strict=True)
        ]
        return "\n".join(lines)


def heading(f: Formula) -> str:
    """Return the operator alone, as in `always[0,4]`; a leaf in full."""
    if not f.operands():
        return str(f)
    word, _, interval = surface(f)
    return word if interval is None or interval.everything else f"{word}{interval}"


def explain(
    formula: Formula | str,
    trace: Trace,
    k: int = 5,
    end: End = "hold",
    tau: float | None = None,
) -> Explanation:
    """Find the predicate, instant and path that decide a formula on one trace.

    **Arguments:**

    - `formula`, `trace`, `end`: as for `robustness`; the trace is concrete, not under `jit`.
    - `k`: how many critical instants to report at most: the peaks, over time, of each predicate's
      influence.
    - `tau`: temperature at which influence is measured; a tenth of the predicates' spread when
      left out.

    **Raises:** as `robustness`, and `ValueError` for a NaN among the samples that matter.
    """
    check_trace(trace)
    trace = trace.trim()
    holds = bool(satisfied(formula, trace, end))
    setting, signals, _, _ = prepare(formula, trace, hard, end, None)
    formula = setting.formula
    series = dict(
        zip(_distinct(formula), map(np.asarray, _all_values(setting, signals)), strict=True)
    )
    walk = _Walk(evaluator_of(setting, signals, None, None, 0), series, trace)
    tree = walk.node(formula, 0, True)
    leaves: dict[Formula, np.ndarray] = {f: series[f] for f in series if f.is_predicate}
    critical: tuple[Instant, ...] = ()
    if leaves:
        if tau is None:
            finite = np.concatenate([v[np.isfinite(v)] for v in leaves.values()])
            tau = 0.1 * float(np.std(finite)) or 1e-3
        shares = [np.asarray(s) for s in _influence(setting, signals, tau)]
        critical = _critical(list(leaves), leaves, shares, walk, k)
    return Explanation(formula, holds, tree.robustness, tree, critical, trace)


def _distinct(formula: Formula) -> tuple[Formula, ...]:
    """Return itself and every formula that its value is computed from, each once."""
    return tuple(dict.fromkeys(formula.subformulas(valued=True)))


@functools.partial(jax.jit, static_argnums=0)
def _all_values(setting: Setting, signals: dict[str, Array]) -> list[Array]:
    """Compute every sub-formula, each to where it settles and at least to the last sample."""
    e = evaluator_of(setting, signals, None, None, 0)
    values = []
    for f in _distinct(setting.formula):
        value = e.value(f, 0, max(e.settles(f), setting.length - 1))
        values.append(value)
    return values


@functools.partial(jax.jit, static_argnums=0)
def _influence(
    setting: Setting, signals: dict[str, Array], tau: float | Float[Array, ""]
) -> list[Float[Array, " time"]]:
    """Compute the gradient of the smooth robustness with respect to every leaf at every sample."""
    leaves = [f for f in _distinct(setting.formula) if f.is_predicate]
    dtype = next(iter(signals.values())).dtype if signals else jnp.result_type(float)

    def rho(nudges: list[Array]) -> Array:
        e = Evaluator(
            signals,
            setting.length,
            setting.dt,
            "smooth",
            jnp.asarray(tau, dtype),
            setting.end,
            stride=setting.stride,
            nudges=dict(zip(leaves, nudges, strict=True)),
        )
        return e.value(setting.formula, 0, 0)[0]

    return jax.grad(rho)([jnp.zeros(setting.length, dtype) for _ in leaves])


class _Walk:
    """Follows the operand that decides each minimum and maximum."""

    def __init__(
        self, evaluator: Evaluator, series: dict[Formula, np.ndarray], trace: Trace
    ) -> None:
        self.evaluator = evaluator
        self.series = series
        self.clock = trace.finely().clock()
        self.last = evaluator.length - 1
        self._nodes: dict[tuple[Formula, int, bool], Node] = {}

    def time(self, i: int) -> float:
        # Beyond the end a trace repeats its last sample, so that is where to look.
        return float(self.clock[min(i, self.last)])

    def at(self, f: Formula, i: int) -> float:
        values = self.series[f]
        return float(values[min(i, len(values) - 1)])

    def node(self, f: Formula, i: int, decides: bool) -> Node:
        """Return the node of `f` at sample `i`: one object, wherever it stands."""
        if (f, i, decides) not in self._nodes:
            self._nodes[f, i, decides] = self._node(f, i, decides)
        return self._nodes[f, i, decides]

    def _node(self, f: Formula, i: int, decides: bool) -> Node:
        operands = self.operands(f, i)
        deciding = self.deciding(f, i, operands) if decides else None
        if not operands:
            children = ()
        else:
            children = tuple(
                self.node(part, j, decides and k == deciding)
                for k, (part, j) in enumerate(operands)
            )
        series = self.series[f][: self.last + 1 : self.evaluator.stride]
        return Node(f, self.time(i), self.at(f, i), decides, children, series)

    def operands(self, f: Formula, i: int) -> list[tuple[Formula, int]]:
        """Return the operands at the instants that matter for `f` at `i`; none if vacuous."""
        match f:
            case ast.Not(p):
                return [(p, i)]
            case ast.Join(parts):
                return [(p, i) for p in parts]
            case ast.Derived():
                return [(f.meaning, i)]
            case ast.Next(p):
                later = i + self.evaluator.stride
                return [(p, later if self.evaluator.end != "truncate" else min(later, self.last))]
            case ast.Prev(p):
                earlier = i - self.evaluator.stride
                return [(p, earlier)] if earlier >= 0 else []
            case ast.Window(p):
                return self.best(p, self.window(f, i), f.sign < 0)
            case ast.Witness(p, q):
                return self.witness(p, q, self.window(f, i), i, 1 if f.side == "ahead" else -1)
            case ast.Leaf():
                return []
        raise missing_case("the explanation", f)

    def deciding(self, f: Formula, i: int, operands: list[tuple[Formula, int]]) -> int | None:
        """Return the number of the operand that has the value of `f`."""
        if not operands:
            return None
        values = [self.at(p, j) for p, j in operands]
        if isinstance(f, ast.Join) and f.sign > 0:
            return int(np.argmax(values))
        return int(np.argmin(values)) if len(values) > 1 else 0

    def window(self, f: Formula, i: int) -> range:
        """Return the samples at which an operator with an interval looks from sample `i` on."""
        a, b = self.evaluator.span(f.interval)
        if f.side == "back":
            return range(0 if math.isinf(b) else max(0, i - int(b)), i - a + 1)
        if self.evaluator.end == "truncate":
            stop = self.last
        else:
            stop = max(i + a, *(len(self.series[p]) - 1 for p in f.operands()))
        return range(i + a, (stop if math.isinf(b) else min(i + int(b), stop)) + 1)

    def best(self, p: Formula, window: range, lowest: bool) -> list[tuple[Formula, int]]:
        if not window:
            return []
        values = [self.at(p, j) for j in window]
        return [(p, window[int(np.argmin(values) if lowest else np.argmax(values))])]

    def witness(
        self, p: Formula, q: Formula, window: range, i: int, step: int
    ) -> list[tuple[Formula, int]]:
        """Find where until (since) is most nearly fulfilled: the witness and the weakest link."""
        if not window:
            return []
        best, found = -math.inf, None
        weakest, link = math.inf, i
        ordered = window if step > 0 else reversed(window)
        k = i
        for j in ordered:
            while k != j:
                if self.at(p, k) < weakest:
                    weakest, link = self.at(p, k), k
                k += step
            value = min(self.at(q, j), weakest)
            if found is None or value > best:
                best, found = value, (j, link)
        assert found is not None
        return [(p, found[1]), (q, found[0])] if found[0] != i else [(q, i)]


def _critical(
    leaves: list[Formula],
    values: dict[Formula, np.ndarray],
    shares: list[np.ndarray],
    walk: _Walk,
    k: int,
) -> tuple[Instant, ...]:
    """Find the greatest local peaks of each leaf's share over time."""
    total = sum(float(np.abs(share).sum()) for share in shares) or 1.0
    instants = []
    for leaf, share in zip(leaves, shares, strict=True):
        share = np.abs(share) / total
        padded = np.concatenate([[-1.0], share, [-1.0]])
        peaks = (padded[1:-1] > padded[:-2]) & (padded[1:-1] >= padded[2:]) & (share > 1e-4)
        for i in map(int, np.flatnonzero(peaks)):
            instants.append(Instant(leaf, walk.time(i), float(values[leaf][i]), float(share[i])))
    return tuple(sorted(instants, key=lambda instant: -instant.share)[:k])
