"""Requirements that contradict, repeat or imply each other: `lint` on a set of them.

    found = across({"R1": parse("always speed < 30"), "R2": parse("always speed > 35")}, {})
    found[0].kind, found[0].sentence       # contradiction, ... (by proof)

A proof reads from each formula what it asks of linear expressions at all instants of a window, and
compares ranges in exact arithmetic (`demands`). What it does not settle is searched for on freely
varying signals, and what is not found there is said to be so by search.
"""

import itertools
from collections.abc import Iterator, Mapping

import numpy as np

from verifai_jax.addons.monitoring.demands import Demands
from verifai_jax.addons.monitoring.findings import Finding
from verifai_jax.addons.monitoring.free_traces import FreeTraces
from verifai_jax.core.messages.text import format_seconds
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.host_values import HostValues, Values
from verifai_jax.mtl.rewriting import nnf, simplify

SEARCHED = 100
"""Pairs that are searched at most: each takes up to some seconds."""
PROOF, SEARCH = "(by proof)", "(by search, which found no trace to the contrary: no proof)"


def across(formulas: Mapping[str, Formula], searched: int = SEARCHED) -> tuple[list[Finding], int]:
    """Find requirements of a set that do not go together, or are not needed beside another.

    **Arguments:**
    - `formulas`: formulas by identifier, in the units of their signals.
    - `searched`: number of pairs that are searched at most, where nothing is proved.
    **Returns:** the findings, each with the later requirement of its pair; and the number of pairs
    that share a signal, and for which only proofs were tried.
    """
    demands = {name: Demands.of(formula) for name, formula in formulas.items()}
    plain = {name: simplify(nnf(formula)) for name, formula in formulas.items()}
    found: list[Finding] = []
    left = 0
    for one, other in itertools.combinations(formulas, 2):
        if not set(formulas[one].signals()) & set(formulas[other].signals()):
            continue
        if plain[one] == plain[other]:
            proved = [_duplicate(one, other, formulas)]
        else:
            proved = list(_proved(one, other, formulas, demands))
        if proved:
            found += proved
        elif searched:
            searched -= 1
            found += _searched(one, other, formulas)
        else:
            left += 1
    return found, left


def _duplicate(one: str, other: str, formulas: Mapping[str, Formula]) -> Finding:
    said = f"it says the same as {one} {PROOF}"
    return Finding(other, "duplicate", str(formulas[other]), said, "Keep one of the two.")


def _implied(strong: str, weak: str, formulas: Mapping[str, Formula], how: str) -> Finding:
    said = f"it holds wherever {strong} holds, which is {formulas[strong]} {how}"
    advice = "It may be left out, unless its margin is of interest."
    return Finding(weak, "implied", str(formulas[weak]), said, advice)


def _proved(
    one: str, other: str, formulas: Mapping[str, Formula], demands: Mapping[str, Demands]
) -> Iterator[Finding]:
    a, b = demands[one], demands[other]
    clash = a.clash(b) or b.clash(a)
    if clash is not None:
        first, second, at, guards = clash
        where = " and ".join(dict.fromkeys(map(str, guards)))
        if where:
            said = (
                f"together with {one} it asks for {first} and {second} at once where {where}: both "
                f"hold only if that never happens {PROOF}"
            )
        else:
            said = (
                f"it contradicts {one}: {first} and {second} cannot hold together at "
                f"{format_seconds(at)} {PROOF}"
            )
        yield Finding(other, "contradiction", str(formulas[other]), said)
        return
    forward, backward = a.implies(b), b.implies(a)
    if forward and backward:
        yield _duplicate(one, other, formulas)
    elif forward or backward:
        yield _implied(*((one, other) if forward else (other, one)), formulas, PROOF)


def _searched(one: str, other: str, formulas: Mapping[str, Formula]) -> Iterator[Finding]:
    f, g = formulas[one], formulas[other]
    try:
        free = FreeTraces.of([f, g])
        drawn = free.values(free.drawn(np.random.default_rng(0)))
        a, b = (drawn.truth(each)[0] > 0 for each in (f, g))
    except ValueError:
        return

    def seen(wanted: tuple[bool, ...]) -> bool:
        """Return whether a trace is found on which each formula holds, or not, as is wanted."""
        if ((a == wanted[0]) & (b == wanted[1])).any():
            return True

        def score(values: HostValues) -> Values:
            signs = (1 if each else -1 for each in wanted)
            own = [s * values(each)[0] for s, each in zip(signs, (f, g), strict=True)]
            truths = [values.truth(each)[0] > 0 for each in (f, g)]
            met = (truths[0] == wanted[0]) & (truths[1] == wanted[1])
            return np.clip(np.minimum(*own), -1e9, 1e9) + 1e12 * met

        return free.search(score, np.random.default_rng(1), 5e11)[1] > 5e11

    held = {wanted: seen(wanted) for wanted in itertools.product((True, False), repeat=2)}
    ever = [held[True, True] or held[True, False], held[True, True] or held[False, True]]
    if not all(ever):
        return  # One of them never holds, which is a finding of its own.
    never_fails = [not (held[False, True] or held[False, False]),
                   not (held[True, False] or held[False, False])]  # fmt: skip
    if not held[True, True]:
        said = f"no trace was found on which it and {one}, {f}, hold together {SEARCH}"
        yield Finding(other, "contradiction", str(g), said)
    elif any(never_fails):
        return
    elif not held[True, False] and not held[False, True]:
        said = f"it has the truth of {one}, {f}, on all traces {SEARCH}"
        yield Finding(other, "duplicate", str(g), said, "Keep one of the two.")
    elif not held[True, False]:
        yield _implied(one, other, formulas, SEARCH)
    elif not held[False, True]:
        yield _implied(other, one, formulas, SEARCH)
