"""Properties of networks in VNN-LIB, as boxes of inputs with a margin of the outputs.

A property describes its counterexamples: each of its assertions holds for one. So the network is
safe if every point of every box has a positive margin.

Source: S. Demarchi, D. Guidotti, L. Pulina, A. Tacchella, Supporting standardization of neural
networks verification with VNNLIB and CoCoNet (2023).
"""

import functools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from verifai_jax.core.store.foreign_files import read_text

CASES = 4096
"""Alternatives of a property, multiplied out, at most."""
MAX_DEPTH = 100
"""Brackets within brackets, at most."""
Linear: TypeAlias = dict[str, float]
"""A sum: the factors of variables, which are `X_0`, `Y_0` and so on, and a number, that of `""`."""


def _combined(one: Linear, other: Linear, times: float = 1.0) -> Linear:
    """Return a sum and a multiple of another."""
    return {n: one.get(n, 0.0) + times * other.get(n, 0.0) for n in {**one, **other}}


@dataclass
class Case:
    """A box of inputs, and alternatives of sums that are all at most zero for a counterexample."""

    low: Float[np.ndarray, " inputs"]
    high: Float[np.ndarray, " inputs"]
    alternatives: list[list[Linear]]

    def margin(self, inputs: Float[Array, " inputs"], outputs: Float[Array, " m"]) -> Array:
        """Return a number that is above zero only if no input here is a counterexample.

        Numbers that single precision does not have are replaced by such that make it less.
        """
        values = {"X": inputs, "Y": outputs}

        def value(each: Linear) -> Array:
            exact = each.get("", 0.0)
            offset = np.float32(exact)
            if float(offset) > exact:
                offset = np.nextafter(offset, np.float32(-np.inf))
            total = jnp.asarray(offset, outputs.dtype)
            for name, factor in each.items():
                if not name:
                    continue
                number, near = values[name[0]][int(name[2:])], float(np.float32(factor))
                total = total + (number if factor == 1 else near * number)
                if near != factor:
                    total = total - 2 * abs(near - factor) * jnp.abs(number)
            return total

        groups = [jnp.stack([value(one) for one in group]).max() for group in self.alternatives]
        return jnp.stack(groups).min()


def read_property(path: Path) -> list[Case]:
    """Read a property; cases are alternatives with different boxes.

    **Raises:** `ValueError` for a text that is no VNN-LIB, an input without a bound, and what is
    not linear, with the name of the file and the part.
    """
    text = re.sub(r";[^\n]*", "", read_text(path))
    tokens = re.findall(r"[()]|[^\s()]+", text)
    try:
        statements, rest = _parsed(tokens, 0)
        if rest != len(tokens):
            raise ValueError("a bracket closes that was not opened")
        return _cases(statements)
    except ValueError as error:
        raise ValueError(f"{path.name} is not a property in VNN-LIB: {error}") from error


def _parsed(tokens: Sequence[str], at: int, depth: int = 0) -> tuple[list[Any], int]:
    """Return the list that begins at a token, and where it ends."""
    if depth > MAX_DEPTH:
        raise ValueError(f"its brackets are nested deeper than {MAX_DEPTH}")
    found = list[Any]()
    while at < len(tokens) and tokens[at] != ")":
        if tokens[at] == "(":
            inner, at = _parsed(tokens, at + 1, depth + 1)
            if at >= len(tokens):
                raise ValueError("a bracket is not closed")
            found.append(inner)
        else:
            found.append(tokens[at])
        at += 1
    return found, at


def _cases(statements: Sequence[Any]) -> list[Case]:
    names, whole = list[str](), list[list[Linear]]([[]])
    for each in statements:
        match each:
            case ["declare-const", str(name), "Real"] | ["declare-fun", str(name), [], "Real"]:
                if not re.fullmatch(r"[XY]_\d+", name):
                    raise ValueError(
                        f"a variable {name!r}; names are X_0, X_1 ... and Y_0, Y_1 ..."
                    )
                names.append(name)
            case ["assert", condition]:
                whole = _joined(whole, _alternatives(condition, names))
            case ["set-logic" | "set-info" | "check-sat" | "get-model" | "exit", *_]:
                pass
            case _:
                raise ValueError(f"{_text(each)} is no declaration and no assertion")
    inputs = sum(name[0] == "X" for name in names)
    if not inputs or not any(name[0] == "Y" for name in names):
        raise ValueError("it declares no inputs, or no outputs")
    boxes: dict[tuple[Any, ...], list[list[Linear]]] = {}
    for group in whole:
        ends = np.array([[-math.inf, math.inf]] * inputs)
        others = list[Linear]()
        for one in group:
            known = {name: factor for name, factor in one.items() if factor and name}
            (name, factor), *more = known.items() or [("", 0.0)]
            if more or name[:1] != "X":
                others.append(one)
                continue
            number, end = int(name[2:]), -one.get("", 0.0) / factor
            side, tighter = (1, min) if factor > 0 else (0, max)
            ends[number, side] = tighter(ends[number, side], end)
        if (ends[:, 0] > ends[:, 1]).any():
            continue
        if not np.isfinite(ends).all():
            free = np.flatnonzero(~np.isfinite(ends).all(1))[0]
            raise ValueError(f"the input X_{free} has no bound on a side")
        # A counterexample that needs no condition on outputs is any input of the box.
        boxes.setdefault(tuple(ends.ravel()), []).append(others or [{"": 0.0}])
    found = [(np.reshape(ends, (-1, 2)), groups) for ends, groups in boxes.items()]
    return [Case(ends[:, 0], ends[:, 1], groups) for ends, groups in found]


def _joined(one: list[list[Linear]], other: list[list[Linear]]) -> list[list[Linear]]:
    """Return the alternatives of two conditions that hold together."""
    if len(one) * len(other) > CASES:
        raise ValueError(f"more than {CASES} alternatives")
    return [[*a, *b] for a in one for b in other]


def _alternatives(condition: Any, names: Sequence[str]) -> list[list[Linear]]:
    """Return a condition as alternatives of sums that are all at most zero."""
    match condition:
        case ["and", *parts]:
            return functools.reduce(_joined, (_alternatives(p, names) for p in parts), [[]])
        case ["or", *parts]:
            return [group for part in parts for group in _alternatives(part, names)]
        # A strict comparison excludes less, so what is proved without the end is proved.
        case ["<=" | "<", one, other]:
            return [[_combined(_sum(one, names), _sum(other, names), -1.0)]]
        case [">=" | ">", one, other]:
            return [[_combined(_sum(other, names), _sum(one, names), -1.0)]]
        case ["=" | "==", one, other]:
            gap = _combined(_sum(one, names), _sum(other, names), -1.0)
            return [[gap, _combined({}, gap, -1.0)]]
    raise ValueError(f"{_text(condition)} is no comparison, and no `and` or `or` of comparisons")


def _sum(term: Any, names: Sequence[str]) -> Linear:
    """Return a term as a sum."""
    if isinstance(term, str):
        try:
            return {term: 1.0} if term in names else {"": float(term)}
        except ValueError:
            raise ValueError(f"{term!r} is no number and no declared variable") from None
    parts = [_sum(part, names) for part in term[1:]]
    match term[:1]:
        case ["+"] if parts:
            return functools.reduce(_combined, parts)
        case ["-"] if parts:
            rest = functools.reduce(_combined, parts[len(parts) > 1 :])
            return _combined(parts[0] if len(parts) > 1 else {}, rest, -1.0)
        case ["*"] if len(parts) == 2 and not all(set(part) - {""} for part in parts):
            number, other = sorted(parts, key=lambda part: len(set(part) - {""}))
            return _combined({}, other, number.get("", 0.0))
    raise ValueError(f"{_text(term)} is not a linear term")


def _text(part: Any) -> str:
    return part if isinstance(part, str) else f"({' '.join(map(_text, part))})"
