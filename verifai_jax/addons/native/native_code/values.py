"""Values of a translated program: elements, which are C expressions, and arrays of them.

    Element("v7", "f")                                  # differs between simulations
    Element("0x1p-1f", "f", True, np.float32(0.5))      # a constant
    names = elements(value)                             # an object array in the shape of the value

So a step that only moves elements, such as a transposition, is done by NumPy and generates no code.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np


class Untranslatable(Exception):
    """An error for a part of a program that this translator does not support; the text names it."""


class Element(NamedTuple):
    """One number of a simulation.

    - `text`: its C expression.
    - `kind`: `f`, `i`, `u` or `b`, for float, int, unsigned and truth values.
    - `uniform`: whether it is equal for all simulations.
    - `value`: the value of a constant; otherwise None.
    """

    text: str
    kind: str
    uniform: bool = False
    value: Any = None


class Memory(NamedTuple):
    """An array in the memory of the program, with contiguous elements.

    - `name`: the name of the C array.
    - `kind`, `uniform`: as in `Element`.
    - `shape`: the shape of the array.
    - `offset`: C expression of the index of its first element; empty for 0.
    - `values`: the values of a constant; otherwise None.
    - `formula`: for an array that is computed when used instead of stored, the C expression of an
      element by its index; otherwise None.
    """

    name: str
    kind: str
    uniform: bool
    shape: tuple[int, ...]
    offset: str = ""
    values: np.ndarray | None = None
    formula: Callable[[str], str] | None = None

    def at(self, index: int | str) -> str:
        """Return the C expression of an element; the index may be a C expression, too."""
        if self.formula is not None:
            return f"({self.formula(f'({index})')})"
        index = f"{self.offset} + {index}" if self.offset else f"{index}"
        return f"{self.name}[{index}]" if self.uniform else f"{self.name}[{index}][k]"

    def part(self, begin: int, shape: tuple[int, ...]) -> "Memory":
        """Return the elements from an index on, as an array that differs between simulations."""
        formula = self.formula
        if formula is not None:
            return self._replace(shape=shape, formula=lambda i: formula(f"({i} + {begin})"))
        offset = f"{self.offset} + {begin}" if self.offset else str(begin)
        return self._replace(shape=shape, offset=offset)

    @property
    def size(self) -> int:
        """Number of elements."""
        return int(np.prod(self.shape, dtype=np.int64))


Equation: TypeAlias = Any
"""A step of a program."""
Program: TypeAlias = Any
"""A program of JAX, with or without its constants; newer versions have one class of both."""
Form: TypeAlias = Any
"""Shape and type of a value, or the type."""
Params: TypeAlias = Mapping[str, Any]
"""Parameters of a step."""
Number: TypeAlias = np.generic | float
"""A number of Python or NumPy."""
Elements: TypeAlias = Any
"""An object array of elements; those of random keys are pairs of elements."""
Value: TypeAlias = Elements | Memory
_NAME = re.compile(r"\b[a-z]+\d+\b")
TYPES = {"f": ("F", "float"), "i": ("I", "int"), "u": ("U", "unsigned"), "b": ("I", "int")}
"""C types of each kind: of a vector, and of a single number."""
KEY = "key"
"""Kind of random keys, whose elements are pairs."""


def kind_of(dtype: Form) -> str:
    """Return the kind of a JAX type.

    **Raises:** `Untranslatable` for types other than those of 32 bits, truth values, and keys.
    """
    if jnp.issubdtype(dtype, jax.dtypes.prng_key):
        if "fry" not in str(dtype):
            raise Untranslatable(f"random keys of type {dtype}")
        return KEY
    kinds = {"float32": "f", "int32": "i", "uint32": "u", "bool": "b"}
    if str(dtype) not in kinds:
        raise Untranslatable(f"numbers of type {dtype}")
    return kinds[str(dtype)]


DTYPES = {"f": np.float32, "i": np.int32, "u": np.uint32, "b": np.bool_}


def constant(number: Number, kind: str) -> Element:
    """Return the element of a number."""
    value: Any = DTYPES[kind](number)
    if kind == "b":
        return Element("-1" if value else "0", kind, True, value)
    if kind == "i":
        text = "(-2147483647 - 1)" if value == -(2**31) else str(int(value))
        return Element(f"({text})" if value < 0 else text, kind, True, value)
    if kind == "u":
        return Element(f"{int(value)}u", kind, True, value)
    if np.isnan(value):
        return Element('__builtin_nanf("")', kind, True, value)
    if np.isinf(value):
        return Element(f"({'-' if value < 0 else ''}__builtin_inff())", kind, True, value)
    text = f"{float(value)!r}f"
    return Element(f"({text})" if text.startswith("-") else text, kind, True, value)


def elements(value: Value) -> Elements:
    """Return the elements of a value, in its shape."""
    if isinstance(value, np.ndarray):
        return value
    out = np.empty(value.size, object)
    flat = None if value.values is None else value.values.ravel()
    for i in range(value.size):
        if flat is not None:
            out[i] = constant(flat[i], value.kind)
        else:
            out[i] = Element(value.at(i), value.kind, value.uniform)
    return out.reshape(value.shape)


def filled(shape: tuple[int, ...], element: Element | tuple[Element, Element]) -> Elements:
    """Return an array filled with one element."""
    out = np.empty(shape, object)
    flat = out.reshape(-1)
    for i in range(flat.size):
        flat[i] = element
    return out


def same(value: Elements) -> Any:
    """Return the element that an array is filled with; None if its elements differ."""
    flat = value.ravel()
    first = flat[0] if flat.size else None
    return first if all(each is first for each in flat) else None


def names_in(value: Value) -> Iterator[str]:
    """Yield the program variables that a value uses, each as often as it occurs."""
    if isinstance(value, Memory):
        yield from _NAME.findall(value.at("0"))
        return
    for each in value.ravel():
        for one in [each] if isinstance(each, Element) else each:
            if one.value is None:
                yield from _NAME.findall(one.text)
