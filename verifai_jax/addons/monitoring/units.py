"""Units of signals and of expressions over them.

units_of(["speed (m/s)", "dist"], {"dist": "m"})        # {'speed (m/s)': 'm/s', 'dist': 'm'}
unit_of(term, units, faults)                            # 'm', and what does not go together
"""

import re
from collections.abc import Iterable, Mapping

from verifai_jax.mtl.expression import Arithmetic, Component, Signal
from verifai_jax.mtl.formula import Formula, Term
from verifai_jax.mtl.sampled import Sampled

IN_NAME = re.compile(r"[(\[]\s*([^()\[\]\d][^()\[\]]*?)\s*[)\]]\s*$")
"""A unit in brackets at the end of a signal's name."""
SUFFIXES = {
    "mps": "m/s", "kmh": "km/h", "kph": "km/h", "mph": "mph", "kts": "kt", "deg": "deg",
    "rad": "rad", "degc": "degC", "mgdl": "mg/dL", "mmol": "mmol/L", "pct": "%", "kpa": "kPa",
    "psi": "psi", "rpm": "rpm", "km": "km", "ft": "ft", "kg": "kg", "ms": "ms",
}  # fmt: skip
"""Units at the end of a signal's name, after an underscore."""
SAME = {
    "°": "deg", "degree": "deg", "degrees": "deg", "radian": "rad", "radians": "rad", "sec": "s",
    "seconds": "s", "meter": "m", "meters": "m", "metre": "m", "metres": "m", "m s-1": "m/s",
    "m s^-1": "m/s", "m.s-1": "m/s", "mps": "m/s", "kmh": "km/h", "kph": "km/h", "km/hr": "km/h",
    "°c": "degC", "c": "degC", "celsius": "degC", "percent": "%", "mg/dl": "mg/dL", "knots": "kt",
}  # fmt: skip
"""Other ways of writing a unit, in small letters."""
NONE = {"", "1", "-", "none", "n/a", "bool", "boolean", "flag", "enum", "mode", "text"}
"""Words for a signal without a unit; it goes together with every unit."""


def units_of(names: Iterable[str], given: Mapping[str, str]) -> dict[str, str]:
    """Return the units of signals: the given ones, or else those in their names."""
    found = {}
    for name in names:
        said = IN_NAME.search(name)
        unit = given.get(name) or (said[1] if said else "")
        unit = plain_unit(unit or SUFFIXES.get(name.rpartition("_")[2].lower(), ""))
        if unit:
            found[name] = unit
    return found


def plain_unit(unit: str) -> str:
    """Return the usual spelling of a unit; empty for an unknown one."""
    unit = " ".join(unit.split())
    return "" if unit.lower() in NONE else SAME.get(unit.lower(), unit.replace(" / ", "/"))


def unit_of(e: Term, units: Mapping[str, str], faults: list[str]) -> str | None:
    """Return the unit of an expression; None if it is unknown, as for a number alone.

    The unit of `2 * speed` is unknown too, since the number may have a unit.

    **Arguments:**
    - `faults`: a list that receives a sentence on each sum of two units, and on a sine of degrees.
    """
    match e:
        case Sampled():
            return _unit_of_sampled(e, units, faults)
        case Signal(name):
            return units.get(name)
        case Component(vector, _):
            return unit_of(vector, units, faults)
        case Arithmetic(word, arguments):
            parts = [unit_of(a, units, faults) for a in arguments]
            if word in ("sin", "cos") and parts[0] == "deg":
                faults.append(f"{e} takes an angle in rad, and {arguments[0]} is in deg")
            if word in ("neg", "abs", "norm", "+", "-", "min", "max"):
                known = sorted({part for part in parts if part})
                if len(known) > 1:
                    faults.append(f"{e} computes with {' and '.join(known)} together")
                return known[0] if len(known) == 1 else None
    return None


def _unit_of_sampled(e: Sampled, units: Mapping[str, str], faults: list[str]) -> str | None:
    if e.function == "duration":
        return "s"
    inner = [unit_of(each, units, faults) for each in e.operands if not isinstance(each, Formula)]
    if e.function == "rate" and inner[0]:
        return f"{inner[0]}^2" if inner[0].endswith("/s") else f"{inner[0]}/s"
    return inner[-1] if inner else None
