"""The reason why a trace satisfies or breaks a formula: a predicate, an instant and a path to it.

    why = explain("always[0, 4] (abs(x) <= 2.4 & abs(theta) <= 0.2095)", trace)
    print(why)                                        # the path, the tree, the critical instants
    why.predicate, why.time, why.robustness

The hard robustness is the value of one predicate at one instant, found by walking from the root to
the operand that decides each minimum or maximum.
"""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from verifai_jax.core.compute.compilation import jit_each
from verifai_jax.core.display.notebook import InNotebook
from verifai_jax.core.messages.text import LONG, STAMPS, format_seconds, format_time
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl._robustness import satisfied
from verifai_jax.mtl.evaluate import End, Evaluator
from verifai_jax.mtl.formula import Formula, surface
from verifai_jax.mtl.semantics import hard
from verifai_jax.mtl.setting import Setting, check_trace, evaluator_of, prepare
from verifai_jax.mtl.walk import Walk


@dataclass(frozen=True)
class Node:
    """A sub-formula at the instant at which its parent evaluates it.

    `decides` says whether it lies on the path to the deciding predicate. `series` is its robustness
    at every sample.
    """

    formula: Formula
    time: float
    robustness: float
    decides: bool
    children: tuple["Node", ...]
    series: Float[np.ndarray, " time"] = field(repr=False)

    def path(self) -> tuple["Node", ...]:
        """Return the nodes from this one down to the deciding leaf."""
        below = next((child for child in self.children if child.decides), None)
        return (self,) if below is None else (self, *below.path())

    def flat(self) -> list[tuple[int, "Node"]]:
        """Return this node and all nodes below with their depths, parents first.

        For a node that occurs several times (such as both sides of `<->`), the nodes below follow
        only its first occurrence.
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
    """A predicate at an influential instant, and its share of the robustness.

    Shares are computed from the gradient of the smooth robustness; those of all predicates and
    instants sum to 1.
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
        """Return the nodes from the formula down to the deciding leaf."""
        return self.tree.path()

    @property
    def predicate(self) -> Formula:
        """The predicate whose value is the robustness, up to sign."""
        return self.path[-1].formula

    @property
    def time(self) -> float:
        """The deciding time in seconds."""
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
    """Return the operator alone, such as `always[0,4]`; a leaf in full."""
    if not f.operands():
        return str(f)
    word, _, interval = surface(f)
    return word if interval is None or interval.everything else f"{word}{interval}"


def explain(
    formula: Formula | str, trace: Trace, k: int = 5, end: End = "hold", tau: float | None = None
) -> Explanation:
    """Find the predicate, instant and path that decide a formula on one trace.

    **Arguments:**
    - `formula`, `trace`, `end`: as in `robustness`; the trace must be concrete, not under `jit`.
    - `k`: maximum number of critical instants: the peaks, over time, of each predicate's influence.
    - `tau`: temperature at which influence is measured; by default a tenth of the predicates'
      spread.
    **Raises:** the errors of `robustness`, and `ValueError` for a NaN among the relevant samples.
    """
    check_trace(trace)
    trace = trace.trim()
    holds = bool(satisfied(formula, trace, end))
    setting, signals, _, _ = prepare(formula, trace, hard, end, None)
    formula = setting.formula
    series = dict(
        zip(_distinct(formula), map(np.asarray, _all_values(setting, signals)), strict=True)
    )
    evaluator = evaluator_of(setting, signals, None, None, 0)
    walk = Walk(series.__getitem__, evaluator.span, setting.length, setting.end, setting.stride)
    nodes = _Tree(walk, np.asarray(trace.finely().clock()))
    tree = nodes.node(formula, 0, True)
    leaves: dict[Formula, np.ndarray] = {f: series[f] for f in series if f.is_predicate}
    critical: tuple[Instant, ...] = ()
    if leaves:
        if tau is None:
            finite = np.concatenate([v[np.isfinite(v)] for v in leaves.values()])
            tau = 0.1 * float(np.std(finite)) or 1e-3
        shares = [np.asarray(s) for s in _influence(setting, signals, tau)]
        critical = _critical(leaves, shares, nodes, k)
    return Explanation(formula, holds, tree.robustness, tree, critical, trace)


def _distinct(formula: Formula) -> tuple[Formula, ...]:
    """Return itself and every formula that its value is computed from, each once."""
    return tuple(dict.fromkeys(formula.subformulas(valued=True)))


@jit_each()
def _all_values(setting: Setting, signals: dict[str, Array]) -> list[Array]:
    """Compute every sub-formula, each to where it settles and at least to the last sample."""
    e = evaluator_of(setting, signals, None, None, 0)
    values = []
    for f in _distinct(setting.formula):
        value = e.value(f, 0, max(e.settles(f), setting.length - 1))
        values.append(value)
    return values


@jit_each()
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
            truths=setting.truths,
            units=dict(setting.units),
            nudges=dict(zip(leaves, nudges, strict=True)),
        )
        return e.value(setting.formula, 0, 0)[0]

    return jax.grad(rho)([jnp.zeros(setting.length, dtype) for _ in leaves])


class _Tree:
    """The nodes of an explanation, made along a walk."""

    def __init__(self, walk: Walk, clock: Float[np.ndarray, " time"]) -> None:
        self.walk, self.clock = walk, clock
        self._nodes: dict[tuple[Formula, int, bool], Node] = {}

    def time(self, i: int) -> float:
        """Return the time of a sample in seconds."""
        # Beyond the end a trace repeats its last sample, so that is where to look.
        return float(self.clock[min(i, self.walk.length - 1)])

    def node(self, f: Formula, i: int, decides: bool) -> Node:
        """Return the node of `f` at sample `i`: one object, wherever it stands."""
        if (f, i, decides) not in self._nodes:
            walk = self.walk
            operands = walk.operands(f, i)
            deciding = walk.deciding(f, i, operands) if decides else None
            children = tuple(
                self.node(part, j, decides and k == deciding)
                for k, (part, j) in enumerate(operands)
            )
            series = walk.values_of(f)[: walk.length : walk.stride]
            self._nodes[f, i, decides] = Node(
                f, self.time(i), walk.at(f, i), decides, children, series
            )
        return self._nodes[f, i, decides]


def _critical(
    leaves: dict[Formula, np.ndarray], shares: list[np.ndarray], nodes: _Tree, k: int
) -> tuple[Instant, ...]:
    """Find the greatest local peaks of each leaf's share over time."""
    total = sum(float(np.abs(share).sum()) for share in shares) or 1.0
    instants = []
    for (leaf, values), share in zip(leaves.items(), shares, strict=True):
        share = np.abs(share) / total
        padded = np.concatenate([[-1.0], share, [-1.0]])
        peaks = (padded[1:-1] > padded[:-2]) & (padded[1:-1] >= padded[2:]) & (share > 1e-4)
        for i in map(int, np.flatnonzero(peaks)):
            instants.append(Instant(leaf, nodes.time(i), float(values[i]), float(share[i])))
    return tuple(sorted(instants, key=lambda instant: -instant.share)[:k])
