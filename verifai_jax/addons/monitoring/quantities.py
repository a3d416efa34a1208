"""Numbers with units in formulas: `speed <= 130 km/h`, `duration(up, 1h)`.

    quantity(130, "km/h")                             # 36.11 m/s where no unit is known

A number becomes one in the unit of the signals that it is compared with. Where none of their units
is known it is in the coherent unit of the SI: m/s, rad, s, Pa.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import TypeAlias

from verifai_jax.addons.monitoring.units import plain_unit, units_of
from verifai_jax.core.messages.errors import unknown_name
from verifai_jax.core.messages.text import listed
from verifai_jax.mtl.expression import Arithmetic, Component, Number, Signal, constant_value
from verifai_jax.mtl.fitting import assumptions, fitted, with_terms
from verifai_jax.mtl.formula import Formula, Term
from verifai_jax.mtl.sampled import Sampled
from verifai_jax.mtl.setting import as_formula
from verifai_jax.mtl.tree import postorder
from verifai_jax.mtl.words import number_text

_DEGREE = Fraction(math.pi) / 180
_SIZES = """
m: m 1, km 1000, cm 0.01, mm 0.001, um 1e-6, ft 0.3048, mi 1609.344, nmi 1852
m/s: m/s 1, km/h 5/18, mph 0.44704, kt 463/900, cm/s 0.01, mm/s 0.001, ft/s 0.3048, ft/min 0.00508
m/s^2: m/s^2 1, m/s2 1, m/s**2 1, km/h/s 5/18
m/s^3: m/s^3 1, m/s3 1, m/s**3 1
s: s 1, ms 0.001, us 1e-6, ns 1e-9, min 60, h 3600, d 86400
kg: kg 1, g 0.001, t 1000
N: N 1, kN 1000
Nm: Nm 1, kNm 1000
W: W 1, mW 0.001, kW 1000, MW 1e6
J: J 1, kJ 1000, Wh 3600, kWh 3.6e6
V: V 1, mV 0.001, kV 1000
A: A 1, mA 0.001
Hz: Hz 1, kHz 1000, MHz 1e6
Pa: Pa 1, hPa 100, kPa 1000, MPa 1e6, mbar 100, bar 1e5, psi 6894.757
K: K 1
degC: degC 1
1: % 0.01
mg/dL: mg/dL 1
mmol/L: mmol/L 1
"""
SIZES: dict[str, dict[str, Fraction]] = {
    base: {unit: Fraction(size) for unit, size in map(str.split, sizes.split(","))}
    for base, sizes in (line.split(": ") for line in _SIZES.strip().splitlines())
} | {
    "rad": {"rad": Fraction(1), "deg": _DEGREE},
    "rad/s": {"rad/s": Fraction(1), "deg/s": _DEGREE, "rpm": _DEGREE * 6},
    "rad/s^2": {"rad/s^2": Fraction(1), "deg/s^2": _DEGREE, "deg/s2": _DEGREE},
}
"""Units by the coherent unit of their dimension, with their sizes in it. Temperatures in degrees
and in kelvin are not converted, as their zeros differ."""
RATES = {"m": "m/s", "m/s": "m/s^2", "m/s^2": "m/s^3", "rad": "rad/s", "rad/s": "rad/s^2"}
"""The coherent unit of the rate of change of a quantity."""
Scale: TypeAlias = tuple[str, Fraction]
"""A coherent unit, and the size of a unit in it."""
SCALES: dict[str, Scale] = {
    unit: (base, size) for base, units in SIZES.items() for unit, size in units.items()
}
UNITS = tuple(SCALES)
"""What may follow a number in a text."""
_LINEAR = ("+", "-", "neg", "abs", "min", "max", "norm")


@dataclass(frozen=True, eq=False, repr=False)
class Quantity(Number):
    """A number with a unit; its `value` is in the coherent unit."""

    amount: float = 0.0
    unit: str = ""
    opened = 2

    @property
    def scale(self) -> Scale:
        """The coherent unit, and the size of its own unit in it."""
        return SCALES[self.unit]

    @property
    def seconds(self) -> float:
        if self.scale[0] != "s":
            raise ValueError(f"a time is needed here; got {self}")
        return self.value

    def __neg__(self) -> "Quantity":
        return quantity(-self.amount, self.unit)

    def text(self, outer: int = 0) -> str:
        text = f"{number_text(self.amount)} {self.unit}"
        return f"({text})" if outer > 3 or (outer > 0 and self.amount < 0) else text

    @classmethod
    def fitted(cls, leaf: Formula, units: Mapping[str, str], sizes: Mapping[str, int]) -> Formula:
        """Return a predicate in the unit of the first signal whose unit is known.

        **Raises:** `ValueError` for units that do not go together.
        """
        own = _quantities(leaf)
        if not own:
            return leaf
        base = own[0].scale[0]
        known = {part: scale for part in _readings(leaf) if (scale := _scale(part, units))}
        if not _is_linear(leaf):
            if any(size != 1 for _, size in known.values()):
                raise ValueError(
                    f"{leaf} has a quantity in a product, where {next(iter(known))} is not "
                    "converted: write the number in its unit"
                )
            own, known = own[:1], {}
        for part, (other, _) in [*((each, each.scale) for each in own), *known.items()]:
            if other != base:
                raise ValueError(
                    f"{leaf} does not go together: {part} has a unit of {other}, and {own[0]} one "
                    f"of {base}"
                )
        target = next(iter(known.values()))[1] if known else 1

        def change(part: Term) -> Term | None:
            if isinstance(part, Quantity):
                return Number(float(Fraction(repr(part.amount)) * part.scale[1] / target))
            if part in known:
                size = known[part][1] / target
                return part if size == 1 else Arithmetic("*", (part, Number(float(size))))  # pyright: ignore
            return None

        return with_terms(leaf, change)

    @classmethod
    def assumed(cls, leaf: Formula, units: Mapping[str, str]) -> Iterator[str]:
        """Yield the unit in which signals of unknown units are taken to be.

        Angles and times have none: signals are in rad and in seconds, as in all formulas.
        """
        own = [each for each in _quantities(leaf) if each.scale[0] not in ("rad", "s")]
        unknown = [str(part) for part in _readings(leaf) if _scale(part, units) is None]
        if own and unknown:
            known = next((s for part in _readings(leaf) if (s := _scale(part, units))), None)
            taken = [*(unit for unit, s in SCALES.items() if s == known), own[0].scale[0]][0]
            yield (
                f"no unit is known of {listed(unknown)} in {leaf}, and {taken} "
                f"is taken for granted: give it, as in units={{{unknown[0]!r}: {own[0].unit!r}}}"
            )


def quantity(amount: float | str, unit: str) -> Quantity:
    """Return a number with a unit, such as `quantity(130, "km/h")`, in text `130 km/h`.

    **Raises:** `UnknownNameError` for a unit that is not known.
    """
    if unit not in SCALES:
        raise unknown_name("unit", unit, SCALES)
    value = Fraction(str(amount))
    return Quantity(float(value * SCALES[unit][1]), float(value), unit)


def completed(
    formulas: Formula | str | Mapping[str, Formula | str],
    units: Mapping[str, str] | None, sizes: Mapping[str, int] | None,
) -> dict[str, Formula]:  # fmt: skip
    """Return the formulas of a monitor, which meets no recording that could complete them.

    **Raises:** `ValueError` for a quantity compared with a signal whose unit is not given, and for
    a vector whose size is not given.
    """
    named = formulas if isinstance(formulas, Mapping) else {"": formulas}
    found: dict[str, Formula] = {}
    for name, each in named.items():
        formula = as_formula(each)
        known = units_of(formula.signals(), units or {})
        for sentence in assumptions(formula, known):
            raise ValueError(sentence.replace(" is taken for granted", " cannot be guessed"))
        found[name] = fitted(formula, known, sizes or {})
    return found


def _quantities(leaf: Formula) -> list[Quantity]:
    return [part for part in _parts(leaf) if isinstance(part, Quantity)]


def _parts(leaf: Formula) -> list[Term]:
    """Return all parts of the expressions of a predicate, also those in functions of samples."""
    found, todo = [], list(leaf.terms())
    while todo:
        for part in postorder(todo.pop()):
            found.append(part)
            if isinstance(part, Sampled) and not _is_reading(part):
                todo += [operand for operand in part.operands if isinstance(operand, Term)]
    return found


def _is_reading(part: Term) -> bool:
    """Return whether an expression is converted as a whole."""
    return isinstance(part, Component) or (isinstance(part, Signal) and not part.opened)


def _readings(leaf: Formula) -> list[Term]:
    parts = list(dict.fromkeys(filter(_is_reading, _parts(leaf))))
    vectors = {part.vector for part in parts if isinstance(part, Component)}
    return [part for part in parts if part not in vectors]


def _scale(part: Term, units: Mapping[str, str]) -> Scale | None:
    match part:
        case Component(vector, _):
            return _scale(vector, units)
        case Sampled():
            if part.function == "duration":
                return SCALES["s"]
            inner = [p for o in part.operands if isinstance(o, Term) for p in postorder(o)]
            known = [scale for p in inner if _is_reading(p) and (scale := _scale(p, units))]
            if part.function != "rate" or not known:
                return known[-1] if known else None
            base, size = known[-1]
            return (RATES.get(base, f"{base}/s"), size)
        case Signal(name):
            unit = " ".join(units.get(name, "").split())
            return SCALES.get(unit) or SCALES.get(plain_unit(unit))
    return None


def _is_linear(leaf: Formula) -> bool:
    """Return whether signals and quantities are added and compared, and multiplied by numbers."""
    for part in (part for term in leaf.terms() for part in postorder(term)):
        if isinstance(part, Arithmetic) and part.name not in _LINEAR:
            plain = [constant_value(a) is not None and not _has_unit(a) for a in part.arguments]
            scaled = part.name in ("*", "/") and any(plain[part.name == "/" :])
            if not scaled and (part.signals() or any(map(_has_unit, part.arguments))):
                return False
    return True


def _has_unit(e: Term) -> bool:
    return any(isinstance(part, Quantity) for part in postorder(e))
