"""The text of a translated program: pieces of straight-line code inside loops and branches.

A block of simulations is `K` vectors. A piece runs for one vector after another, with its values in
registers; values needed by a later piece are stored in memory. Values equal for all simulations are
computed once, before the piece.
"""

import math
import re
from collections import Counter
from collections.abc import Sequence

import numpy as np

from verifai_jax.addons.native.native_code.values import (
    TYPES,
    Element,
    Memory,
    Untranslatable,
    constant,
)

MAX_LINES = 30_000
"""The maximum number of lines of a program; a compiler takes seconds for that many."""
STACK = 4096
"""Numbers of a simulation in arrays on the stack at most; others are in the thread's memory."""
MANY_DIVISIONS = 0.03
"""Share of divisions in a piece from which on they are made of products: the unit that divides
would make the others wait."""
_DIVISION = re.compile(r"F (v\d+) = (\S+) / (v\d+|\(?-?[\d.e+-]+f\)?);")
_NAME = re.compile(r"\bv\d+\b")
_MADE = re.compile(r"\b([uvimw])\d+\b")


class Piece:
    """Code without branches: lines before the loop over vectors, in it, and after it."""

    def __init__(self) -> None:
        self.together: list[str] = []
        self.each: list[str] = []
        self.after: list[str] = []
        self.defined: list[str] = []
        self.known: dict[str, Element] = {}
        self.stored: dict[tuple[Element, ...], Memory] = {}


class Code:
    """Code of a program, to which lines are added."""

    def __init__(self) -> None:
        self.items: list[Piece | str] = []
        self.globals: list[str] = []
        self.declared: list[str] = []
        self.kinds: dict[str, str] = {}
        self.kept: set[str] = set()
        self._arrays: dict[str, tuple[str, int]] = {}
        self._count = 0
        self._lines = 0
        self._constants: dict[tuple[str, bytes], str] = {}
        # The pieces before the loops that are open, and in how many of these a name has its value.
        self._before: list[Piece] = []
        self._depths: dict[str, int] = {}

    @property
    def piece(self) -> Piece:
        """The piece to which lines are added."""
        if not self.items or isinstance(self.items[-1], str):
            self.items.append(Piece())
        last = self.items[-1]
        assert isinstance(last, Piece)
        return last

    def control(self, text: str) -> None:
        """Add a line between pieces, such as the head of a loop."""
        self.items.append(text)

    def open_loop(self, head: str, counter: str = "") -> None:
        """Open a loop; expressions that do not change in it are computed before it.

        - `counter`: its variable, if there is one.
        """
        self._before.append(self.piece)
        self._depths[counter] = len(self._before)
        self.control(head)

    def close_loop(self) -> None:
        """End the innermost loop."""
        self.control("}")
        self._before.pop()
        depth = len(self._before)
        for name, inside in self._depths.items():
            self._depths[name] = min(inside, depth)

    def mark(self) -> tuple[int, int]:
        """Return the present position, for `back_to`."""
        self.control("")
        return len(self.items), len(self._before)

    def back_to(self, mark: tuple[int, int]) -> None:
        """Remove all lines since a position."""
        del self.items[mark[0] :]
        del self._before[mark[1] :]

    def _depth_of(self, text: str) -> int:
        """Return in how many of the open loops an expression has to be computed."""
        now = len(self._before)
        # An array may be written to, and what `fresh` makes is.
        names = ((m[0], now if m[1] in "imw" else 0) for m in _MADE.finditer(text))
        return min(now, max((self._depths.get(*each) for each in names), default=0))

    def is_older(self, one: Element, other: Element) -> bool:
        """Return whether a number that is not constant was defined in fewer loops than another."""
        return one.value is None and self._depth_of(one.text) < self._depth_of(other.text)

    def _piece_of(self, depth: int) -> Piece:
        return self.piece if depth == len(self._before) else self._before[depth]

    def name(self, prefix: str) -> str:
        """Return an unused name."""
        self._count += 1
        return f"{prefix}{self._count}"

    def define(self, text: str, kind: str, uniform: bool) -> Element:
        """Add a line that computes a number, and return it."""
        depth = self._depth_of(text)
        piece = self._piece_of(depth)
        known = piece.known.get(text)
        if known is not None and known.kind == kind and known.uniform == uniform:
            return known
        self._count_line()
        if uniform:
            name = self.name("u")
            self.declared.append(f"{TYPES[kind][1]} {name};")
            piece.together.append(f"{name} = {text};")
        else:
            name = self.name("v")
            self.kinds[name] = kind
            piece.defined.append(name)
            piece.each.append(f"{TYPES[kind][0]} {name} = {text};")
        self._depths[name] = depth
        return piece.known.setdefault(text, Element(name, kind, uniform))

    def fresh(self, kind: str, uniform: bool) -> Element:
        """Return a number that the next line will compute."""
        name = self.name("w")
        text = f"{TYPES[kind][1]}()" if uniform else f"{TYPES[kind][0]}()"
        # With its own name, so that it is no number that is known already.
        return self.define(f"{text} /* {name} */", kind, uniform)

    def keep(self, kind: str, uniform: bool) -> Element:
        """Return a variable that `assign` changes in the loop that is opened next."""
        if uniform:
            name = self.name("u")
            self.declared.append(f"{TYPES[kind][1]} {name};")
        else:
            name = self.name("v")
            self.kinds[name] = kind
            self.kept.add(name)
        self._depths[name] = len(self._before) + 1
        return Element(name, kind, uniform)

    def assign(self, changed: list[Element], values: list[Element]) -> None:
        """Assign values to several variables of `keep` simultaneously, at the end of a piece."""
        last: list[str] = []
        for name, value in zip(changed, values, strict=True):
            self._count_line()
            if name.text == value.text:
                continue
            if not name.uniform:
                self.piece.each.append(f"{name.text}_[k] = {widened(value)};")
            else:
                copy = self.fresh(value.kind, True)
                self.piece.after.append(f"{copy.text} = {value.text};")
                last.append(f"{name.text} = {copy.text};")
        self.piece.after += last

    def carried(self, name: str) -> None:
        """Record that an array is changed by the loop that is opened next, and only by it."""
        self._depths[f"array {name}"] = len(self._before) + 1

    def is_carried(self, name: str) -> bool:
        """Return whether the innermost open loop changes a variable of `keep`, or such an array."""
        key = name if name in self.kept else f"array {name}"
        return bool(self._before) and self._depths.get(key) == len(self._before)

    def memory(self, shape: tuple[int, ...], kind: str, uniform: bool = False) -> Memory:
        """Return a new array in memory."""
        memory = Memory(self.name("m"), kind, uniform, shape)
        self._arrays[memory.name] = (TYPES[kind][uniform], 0 if uniform else memory.size)
        if uniform:
            self.declared.append(f"{TYPES[kind][1]} {memory.name}[{max(memory.size, 1)}];")
        return memory

    def table(self, values: np.ndarray, kind: str) -> str:
        """Return the name of an array of constants."""
        array = np.ascontiguousarray(values)
        key = (kind, array.tobytes())
        if key not in self._constants:
            name = self._constants[key] = self.name("t")
            texts = ", ".join(constant(each, kind).text for each in array.ravel())
            self._count_line(1 + array.size // 16)
            self.globals.append(
                f"static const {TYPES[kind][1]} {name}[{max(array.size, 1)}] = {{{texts or 0}}};"
            )
        return self._constants[key]

    def store(self, target: str, value: Element) -> None:
        """Add a line that writes an element of an array that differs between simulations."""
        self._count_line()
        self.piece.each.append(f"{target} = {widened(value)};")

    def stored(self, values: Sequence[Element], shape: tuple[int, ...]) -> Memory:
        """Return a constant array of these elements."""
        depth = max(self._depth_of(each.text) for each in values)
        piece, uniform = self._piece_of(depth), all(each.uniform for each in values)
        known = piece.stored.get(tuple(values))
        if known is not None:
            return known._replace(shape=shape)
        self._count_line(len(values))
        memory = self.memory(shape, values[0].kind, uniform)
        self._depths[memory.name] = depth
        lines = piece.together if uniform else piece.each
        for i, each in enumerate(values):
            lines.append(f"{memory.at(i)} = {each.text if uniform else widened(each)};")
        return piece.stored.setdefault(tuple(values), memory)

    def _count_line(self, lines: int = 1) -> None:
        self._lines += lines
        if self._lines > MAX_LINES:
            raise Untranslatable(f"a program of more than {MAX_LINES:,} lines")

    def body(self) -> tuple[list[str], int]:
        """Return the lines of the function, and the number of vectors of memory for a thread."""
        crossing = set(self.kept)
        used = {}
        for item in self.items:
            if isinstance(item, Piece):
                names = {name for line in item.each for name in _NAME.findall(line)}
                used[id(item)] = names - set(item.defined)
                crossing |= used[id(item)]
        lines = list(self.declared)
        text = "\n".join("\n".join(i.each) if isinstance(i, Piece) else i for i in self.items)
        arena, stack = 0, 0
        written = set(re.findall(r"\bm\d+\b", text))
        for name, (form, size) in self._arrays.items():
            if name not in written or not size:
                continue
            if stack + size > STACK:
                lines.append(f"{form} (*{name})[K] = ({form} (*)[K])(arena + {arena} * (long)K);")
                arena += size
            else:
                stack += size
                lines.append(f"{form} {name}[{size}][K];")
        lines += [f"{TYPES[self.kinds[n]][0]} {n}_[K];" for n in sorted(crossing)]
        for item in self.items:
            if isinstance(item, str):
                lines.append(item)
                continue
            lines += item.together
            if not item.each:
                lines += item.after
                continue
            loads = [
                f"{TYPES[self.kinds[name]][0]} {name} = {name}_[k];"
                for name in sorted(used[id(item)])
            ]
            each = shared_divisions(item.each)
            stores = [f"{name}_[k] = {name};" for name in item.defined if name in crossing]
            lines += ["REPEAT {", *loads, *each, *stores]
            lines += ["}", *item.after]
        return lines, arena


def shared_divisions(lines: list[str]) -> list[str]:
    """Replace divisions by constants and by repeated divisors with products of the reciprocal.

    A division takes as long as a dozen multiplications.
    """
    found = [_DIVISION.match(line) for line in lines]
    counts = Counter(each[3] for each in found if each)
    single = sum(counts[each] == 1 and each[0] == "v" for each in counts)
    many = single >= MANY_DIVISIONS * len(lines)
    done, known = [], set[str]()
    for line, each in zip(lines, found, strict=True):
        if each is None:
            done.append(line)
            continue
        name, number, divisor = each.groups()
        if divisor[0] != "v":
            size = abs(float(divisor.strip("()f")))
            exact = not 1e-30 < size < 1e30 or math.frexp(size)[0] == 0.5
            by = f"divided(wide({number}), wide({divisor}), wide(1.f / {divisor}))"
            done.append(line if exact else f"F {name} = {by};")
        elif counts[divisor] > 1:
            if divisor not in known:
                known.add(divisor)
                done.append(f"F r{divisor} = 1.f / {divisor};")
            done.append(f"F {name} = divided(wide({number}), {divisor}, r{divisor});")
        else:
            done.append(f"F {name} = ratio(wide({number}), {divisor});" if many else line)
    return done


def widened(value: Element) -> str:
    """Return the expression of an element as a vector."""
    return f"wide({value.text})" if value.uniform else value.text
