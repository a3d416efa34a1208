"""Checks for formulas that may not say what their author means.

    found = lint("always (speed > 120 -> eventually[0, 5] brake > 0)", ["drive-1.csv"])
    print(found)                    # the left side never holds in the recording; ...
    found.table

The formula alone shows parts without effect and parts that cannot be true; recordings show parts
that never hold, are never near to a change, or look beyond the end.
"""

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from verifai_jax.addons.monitoring.across import across
from verifai_jax.addons.monitoring.distinguishing import free_difference
from verifai_jax.addons.monitoring.findings import Finding, Findings
from verifai_jax.addons.monitoring.free_traces import FreeTraces
from verifai_jax.addons.monitoring.recorded import Recordings, named_traces
from verifai_jax.addons.monitoring.requirement_files import Requirements, requirements_of
from verifai_jax.addons.monitoring.units import plain_unit, unit_of, units_of
from verifai_jax.core.messages.errors import nearest_names
from verifai_jax.core.messages.text import counted, listed
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl import formula as ast
from verifai_jax.mtl.bounds import predicates_of
from verifai_jax.mtl.evaluate import End
from verifai_jax.mtl.fitting import assumptions, fitted, sizes_of
from verifai_jax.mtl.formula import FALSE, TRUE, Formula, surface
from verifai_jax.mtl.host_values import HostValues
from verifai_jax.mtl.requirements import Requirement
from verifai_jax.mtl.rewriting import nnf, replaced
from verifai_jax.mtl.sampled import sampled_in
from verifai_jax.mtl.shortfalls import Shortfall, shortfalls, shortfalls_in

FAR, NEVER = 2.5, 0.5
"""Distances of a bound from all values, in widths of their range, from which on a predicate that
always holds, and one that never does, are suspicious: 2.5 lets a limit of 30 m/s pass where speeds
go from 0 to 10, and finds 120 km/h where they go from 0 to 33 m/s, and degrees for radians."""
STILL = 0.2
"""Share of the value of a signal that never changes, which stands for the width of its range."""
Check = Iterator["Finding"]


def lint(
    formulas: Requirements, signals: Recordings | None = None, *,
    units: Mapping[str, str] | None = None, end: End = "hold",
) -> Findings:  # fmt: skip
    """Find parts of formulas that may not say what their author meant, and formulas of a set that
    do not go together: contradictions, duplicates, one implied by another, several units.

    **Arguments:**
    - `formulas`: a formula, a sequence of formulas, or a dictionary by identifier;
      `read_requirements` reads them from a file.
    - `signals`: recordings (traces, files, folders, tables), or a problem, which is simulated 64
      times. Without them only checks that need no data are made.
    - `units`: the units of signals by name, in addition to those in recordings and names (`speed
      (m/s)`, `speed_kmh`).
    - `end`: how a trace continues after the last sample, `"hold"` or `"truncate"`.
    **Raises:** `FormulaSyntaxError`; the errors of `read` for recordings that cannot be read.
    """
    requirements = tuple(r for r in requirements_of(formulas) if r.formula is not None)
    traces = {} if signals is None else named_traces(signals)
    names = dict.fromkeys(name for trace in traces.values() for name in trace.signals)
    read = dict.fromkeys(name for each in requirements for name in each.formalized.signals())
    said = {name: unit for trace in traces.values() for name, unit in trace.units.items()}
    known = units_of([*names, *read], said | dict(units or {}))
    traces = {
        name: replace(trace, units=units_of(trace.signals, dict(trace.units) | dict(units or {})))
        for name, trace in traces.items()
    }
    found: list[Finding] = []
    for each in requirements:
        found += _Linter(each, traces, known, end).findings()
    found += _units_in_set(requirements, traces)
    whole: dict[str, Formula] = {}
    sizes = {n: k for t in traces.values() for n, k in sizes_of(t.signals).items()}
    for each in requirements:
        with contextlib.suppress(ValueError):  # Which its own findings tell.
            whole[each.id] = fitted(each.formalized, known, sizes)
    pairs, left = across(whole)
    unread = tuple(name for name in names if name not in read)
    return Findings(requirements, (*found, *pairs), len(traces), unread, left)


def _units_in_set(requirements: Sequence[Requirement], traces: Mapping[str, Trace]) -> Check:
    """Find signals that have one unit here and another there."""
    said: dict[str, dict[str, str]] = {}
    for source, trace in traces.items():
        for name, unit in trace.units.items():
            said.setdefault(name, {}).setdefault(unit, source)
    for each in requirements:
        names = each.formalized.signals()
        if len(names) == 1 and (unit := plain_unit(each.unit)):
            said.setdefault(names[0], {}).setdefault(unit, each.id)
    reading = {name: each for each in reversed(requirements) for name in each.formalized.signals()}
    for name, sources in said.items():
        if len(sources) > 1 and name in reading:
            where = " and ".join(f"{unit} in {source}" for unit, source in sources.items())
            said_so = f"{name} is in {where}"
            advice = "Convert one of them, or give the unit with the number, as in 130 km/h."
            yield Finding(reading[name].id, "units", name, said_so, advice)


class _Recording(NamedTuple):
    """A recording that has the signals of a formula, and is as long as `duration` in seconds."""

    name: str
    values: HostValues
    duration: float


@dataclass
class _Linter:
    """All checks of one formula."""

    requirement: Requirement
    traces: Mapping[str, Trace]
    units: Mapping[str, str]
    end: End
    recordings: list[_Recording] = field(default_factory=list)

    @property
    def formula(self) -> Formula:
        return self.requirement.formalized

    def findings(self) -> list[Finding]:
        """Return the findings of all checks, one for each kind and part."""
        found = [*self._signals(), *self._judged(), *self._dimensions()]
        dt = self.recordings[0].values.dt if self.recordings else 0.0
        spans = self.formula.asked(dt).items()
        self.asked = {part: span for part, span in spans if isinstance(part, Formula)}
        found += [*self._shortfalls(), *self._implications(), *self._without_effect()]
        if self.recordings:
            idle = {f.part for f in found if f.kind == "vacuous"}
            found += [*self._predicates(idle), *self._witnesses()]
        first: dict[tuple[str, str], Finding] = {}
        for finding in found:
            first.setdefault((finding.kind, finding.part), finding)
        return list(first.values())

    def _found(self, kind: str, part: object, sentence: str, advice: str = "") -> Finding:
        return Finding(self.requirement.id, kind, str(part), sentence, advice)

    def _signals(self) -> Check:
        """Find signals that recordings lack."""
        for name in self.formula.signals() if self.traces else ():
            lacking = [trace for trace in self.traces.values() if name not in trace.signals]
            if lacking:
                share = f"{len(lacking)} of {counted(len(self.traces), 'recording')}"
                near = nearest_names(name, lacking[0].signals).removeprefix("; ")
                near = near[:1].upper() + near[1:]
                yield self._found("signal", name, f"{share} have no signal {name!r}", near)

    def _judged(self) -> Check:
        """Find windows and signals that cannot be judged; keep the recordings that can."""
        for name, trace in self.traces.items():
            if any(each not in trace.signals for each in self.formula.signals()):
                continue
            try:
                values = HostValues.of(trace, self.end)
                values.holds(self.formula)
            except (ValueError, TypeError, IndexError) as error:
                yield self._found("no verdict", self.formula, f"{name}: {error}")
                continue
            duration = (values.length // values.stride - 1) * values.dt
            self.recordings.append(_Recording(name, values, duration))

    def _within(
        self, each: _Recording, part: Formula, of: Callable[[Formula], np.ndarray]
    ) -> np.ndarray:
        """Return the values of a part at the samples at which it is asked in a recording."""
        values = np.broadcast_to(of(part), each.values.length)
        span = self.asked.get(part, (0.0, math.inf))
        first, last = (t / each.values.dt * each.values.stride for t in span)
        last = min(max(last, 0.0), len(values) - 1.0)
        return values[int(min(max(first, 0.0), last)) : int(last) + 1]

    def _ever(self, part: Formula, everywhere: bool = False) -> list[str]:
        """Return the recordings in which a part holds where it is asked, or anywhere."""
        return [each.name for each in self.recordings if self._comes(each, part, everywhere)]

    def _comes(self, each: _Recording, part: Formula, everywhere: bool = False) -> bool:
        truth = each.values.truth
        return bool(((truth(part) if everywhere else self._within(each, part, truth)) > 0).any())

    @property
    def _all(self) -> str:
        count = len(self.recordings)
        return "the recording" if count == 1 else f"any of {count} recordings"

    def _shortfalls(self) -> Check:
        """Find windows that the ends of recordings cut, and parts that one sample decides."""
        found: dict[tuple[str, Formula], tuple[Shortfall, list[str]]] = {}
        for each in self.recordings:
            signals, dt = each.values.signals, each.values.dt
            for fall in shortfalls_in(signals, self.formula, dt, each.duration, self.end):
                found.setdefault((fall.kind, fall.part), (fall, []))[1].append(each.name)
        if not self.recordings:
            found = {(each.kind, each.part): (each, []) for each in shortfalls(self.formula)}
        for fall, names in found.values():
            if 2 * len(names) < len(self.recordings):
                continue
            where = f"{len(names)} of {counted(len(self.recordings), 'recording')}"
            said = f"{fall.sentence}, in {where}, such as {names[0]}" if names else fall.sentence
            advice = f"Probably meant: {fall.meant}" if fall.meant else ""
            if fall.kind == "beyond":
                advice = "Times are in seconds unless a unit follows, as in [0, 500 ms]."
            yield self._found("window", fall.part, said, advice)

    def _implications(self) -> Check:
        """Find implications that mean nothing: under eventually, or whose left side never holds."""
        for part in list(self.asked):
            if isinstance(part, ast.Window) and part.sign > 0 and _implied(part.operand):
                left, right = surface(part.operand)[1]
                yield self._found(
                    "vacuous", part, f"{part} holds as soon as {left} is false at one instant",
                    f"If both are meant together, write {left} & {right} within it.",
                )  # fmt: skip
            if not _implied(part) or not self.recordings:
                continue
            left = surface(part)[1][0]
            if self._ever(left):
                continue
            if self.asked[part] == (0.0, 0.0) and (later := self._ever(left, everywhere=True)):
                yield self._found(
                    "vacuous", left,
                    f"{left} is evaluated only at the first sample, where it never holds; it holds "
                    f"later, as in {later[0]}",
                    f"Write always ({part}) if it is meant at every instant.",
                )  # fmt: skip
                continue
            near = max(float(np.nanmax(self._within(e, left, e.values))) for e in self.recordings)
            yield self._found(
                "vacuous", left,
                f"{left} never holds in {self._all}, so that nothing is asked of "
                f"{surface(part)[1][1]}; it comes no nearer than {-near:z.3g}",
                "Check its bounds and units, or take recordings in which it holds.",
            )  # fmt: skip

    def _without_effect(self) -> Check:
        """Find parts that are true or false on all traces, and parts that change nothing."""
        try:
            free = FreeTraces.of([self.formula])
        except ValueError:
            return
        drawn = free.values(free.drawn(np.random.default_rng(0)))
        constant, covered = set[Formula](), set[Formula]()
        written = _written(self.formula)
        for part, (_, operands) in reversed(written.items()):
            if constant.intersection(operands):
                constant.add(part)
                continue
            for truth in (TRUE, FALSE):
                if self._same(drawn, part, truth):
                    constant.add(part)
                    covered.update(part.subformulas())
                    said = f"{part} is {str(truth).lower()} on every trace that was tried"
                    yield self._found(f"always {truth}".lower(), part, said)
                    break
        droppable = (each for word, parts in written.values() for each in _droppable(word, parts))
        for part in dict.fromkeys(droppable):
            without = (replaced(self.formula, {part: truth}) for truth in (TRUE, FALSE))
            if part in constant | covered:
                continue
            if any(self._same(drawn, self.formula, each) for each in without):
                yield self._found(
                    "no effect", part,
                    f"{part} affects the truth of the formula on no trace that was tried",
                    "Leave it out, or check what was meant by it.",
                )  # fmt: skip

    def _same(self, drawn: HostValues, one: Formula, other: Formula) -> bool:
        """Return whether no trace is found on which two formulas differ."""
        differ = (drawn.truth(one) > 0) != (drawn.truth(other) > 0)
        return not differ.any() and free_difference(one, other, end=self.end) is None

    def _predicates(self, idle: set[str]) -> Check:
        """Find predicates that never hold, and those whose bound no value comes near."""
        optional = [part for part in self.asked if str(part) in idle]
        for word, parts in _written(self.formula).values():
            optional += {"weak_until": parts[1:], "release": parts[:1]}.get(word, ())
        guards = {leaf for part in optional for leaf in predicates_of(part)}
        negative = _negative(self.formula)
        for leaf in predicates_of(self.formula):
            if leaf in guards:
                continue
            seen = [[self._within(e, leaf, e.values) for e in self.recordings]]
            seen += [[self._within(e, leaf, e.values.truth) for e in self.recordings]]
            margins, truths = (each[np.isfinite(each)] for each in map(np.concatenate, seen))
            if not margins.size or (truths > 0).any() != (truths > 0).all():
                continue
            never, compared = bool((truths < 0).all()), leaf.compared
            if never and leaf not in negative and compared and compared[1] == "==":
                yield self._found(
                    "never holds", leaf, f"{leaf} never holds in {self._all}",
                    f"A measured number hardly ever equals another: allow a tolerance, as in "
                    f"abs({compared[0]} - {compared[2]}) <= 0.1.",
                )  # fmt: skip
                continue
            nearest, spread = float(np.abs(margins).min()), self._spread(leaf)
            wanted = NEVER if never and leaf not in negative else FAR
            if nearest > wanted * spread:
                yield self._far(leaf, never, nearest)

    def _spread(self, leaf: Formula) -> float:
        """Return how far the margin of a predicate moves in the recordings."""
        every = np.concatenate([np.ravel(each.values(leaf)) for each in self.recordings])
        spread = float(np.ptp(every[np.isfinite(every)]))
        # What is counted, in seconds or samples, may be all of its window.
        dt = min(each.values.dt for each in self.recordings)
        for each in sampled_in(leaf):
            if each.counted and each.window is not None:
                spread = max(spread, each.window.end, each.window.end / dt)
        sizes = [np.abs(e.values.signals[n]).max() for e in self.recordings for n in leaf.signals()]
        # Flags, modes and counts are often constant, so that a bound next to one says nothing.
        still = STILL * float(max(sizes)) if max(sizes) > 3 or max(sizes) % 1 else math.inf
        return spread or still

    def _far(self, leaf: Formula, never: bool, nearest: float) -> Finding:
        ranges = []
        for name in leaf.signals():
            own = self._all_of(name)
            unit = f" {self.units[name]}" if name in self.units else ""
            ranges.append(f"{name} is from {np.nanmin(own):z.4g} to {np.nanmax(own):z.4g}{unit}")
        where = self._all if never else self._all.replace("any", "all")
        said = f"{leaf} {'never' if never else 'always'} holds in {where}"
        return self._found(
            "never holds" if never else "never near", leaf,
            f"{said}, and never by less than {nearest:z.3g}: {listed(ranges)}",
            "Check the unit of the bound, as in 12deg for an angle in rad, or tighten it.",
        )  # fmt: skip

    def _witnesses(self) -> Check:
        """Find untils that fail because their right side never comes, and that are never needed."""
        written = _written(self.formula)
        guarded = {part for word, parts in written.values() if word == "implies" for part in parts}
        for part, (word, _) in written.items():
            if word != "until" or not isinstance(part, ast.Until):
                continue
            weak = part.left.weak_until(part.right, part.interval)
            changed = replaced(self.formula, {part: weak})
            only = [
                each.name
                for each in self.recordings
                # Of one that is asked again and again the last may be asked too late.
                if not (part in guarded and self._comes(each, part.right))
                and not each.values.holds(self.formula)
                and each.values.holds(changed)
            ]
            if only:
                yield self._found(
                    "until", part,
                    f"the formula fails in {len(only)} of "
                    f"{counted(len(self.recordings), 'recording')} only because {part.right} never "
                    f"happens, while {part.left} holds to the end, as in {only[0]}",
                    f"If {part.right} need not happen, write weak_until.",
                )  # fmt: skip
            elif part.interval.start == 0 and self._at_once(part):
                yield self._found(
                    "vacuous", part.left,
                    f"{part.right} holds at once wherever {part} is evaluated, so {part.left} is "
                    f"never required in {self._all}",
                )  # fmt: skip

    def _at_once(self, part: ast.Until) -> bool:
        """Return whether the right side holds wherever the until is asked."""
        spans = (
            self._within(each, part, lambda _, each=each: each.values.truth(part.right))
            for each in self.recordings
        )
        return all((span > 0).all() for span in spans)

    def _dimensions(self) -> Check:
        """Find units that do not go together, and a robustness of several units."""
        for sentence in assumptions(self.formula, self.units) if self.traces else ():
            yield self._found("units", self.formula, sentence)
        owners: dict[str, Formula] = {}
        for leaf in predicates_of(self.formula):
            faults: list[str] = []
            sides = dict.fromkeys(unit_of(term, self.units, faults) for term in leaf.terms())
            known = [unit for unit in sides if unit]
            if len(known) > 1:
                faults.append(f"{leaf} compares {known[0]} with {known[1]}")
            yield from (self._found("units", leaf, fault) for fault in faults)
            for unit in known[: 0 if faults else 1]:
                owners.setdefault(unit, leaf)
        wanted = plain_unit(self.requirement.unit)
        if wanted and owners and wanted not in owners:
            yield self._found(
                "units", self.formula,
                f"the robustness is said to be in {wanted}, and its predicates are in "
                f"{listed(list(owners))}",
            )  # fmt: skip
        if len(owners) > 1:
            each = listed([f"{leaf} in {unit}" for unit, leaf in owners.items()])
            yield self._found(
                "units", self.formula,
                f"one robustness compares margins of several units: {each}{self._deciding()}",
                f"Weigh them: vj.mtl.normalize(formula, {self._weights()}).",
            )  # fmt: skip

    def _deciding(self) -> str:
        """Say which predicate decides in how many recordings."""
        count: dict[Formula, int] = {}
        for each in self.recordings:
            value = abs(float(each.values(self.formula)[0]))
            for leaf in predicates_of(self.formula):
                if (np.abs(each.values(leaf)) == value).any():
                    count[leaf] = count.get(leaf, 0) + 1
                    break
        return "".join(f"; {leaf} decides in {n}" for leaf, n in count.items())

    def _weights(self) -> str:
        """Write a scale for each signal: the width of its range, or 1."""
        scales = {}
        for name in self.formula.signals():
            width = float(np.ptp(self._all_of(name))) if self.recordings else 0.0
            scales[name] = float(f"{width:z.2g}") or 1.0
        return str(scales)

    def _all_of(self, name: str) -> np.ndarray:
        return np.concatenate([np.ravel(each.values.signals[name]) for each in self.recordings])


def _implied(formula: Formula) -> bool:
    return surface(formula)[0] == "implies" if formula.operands() else False


def _written(formula: Formula) -> dict[Formula, tuple[str, tuple[Formula, ...]]]:
    """Return all parts as they are written, parents first, each with its word and its operands."""
    found: dict[Formula, tuple[str, tuple[Formula, ...]]] = {}
    parts = [formula]
    while parts:
        part = parts.pop()
        if part not in found and not isinstance(part, ast.Constant):
            word, operands, _ = surface(part) if part.operands() else ("", (), None)
            found[part] = word, operands
            parts += operands
    return found


def _droppable(word: str, parts: tuple[Formula, ...]) -> tuple[Formula, ...]:
    """Return the operands that an operator could do without, as others stand next to them."""
    if word in ("until", "weak_until", "since"):
        # `!b until b` is how people write that b comes.
        return () if nnf(parts[0]) == nnf(ast.Not(parts[1])) else parts[:1]
    return parts if word in ("and", "or") else ()


def _negative(formula: Formula) -> set[Formula]:
    """Return the predicates that stand under an odd number of negations."""
    found: set[Formula] = set()
    stack = [(formula, True)]
    while stack:
        part, positive = stack.pop()
        if part.is_predicate and not positive:
            found.add(part)
        positive ^= isinstance(part, ast.Not)
        stack += [(below, positive) for below in part.valued()]
    return found
