"""The description of an FMU: its variables with types, units and ranges, and its capabilities.

    description = read_description("model.fmu")
    description.variables["m"].unit, description.identifier

A document type declaration is refused, since it could make XML read files or grow without bound.
"""

import math
import platform
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element

from verifai_jax.core.messages.errors import missing_name
from verifai_jax.core.messages.text import one_line
from verifai_jax.core.store.foreign_archives import open_archive, read_member
from verifai_jax.core.store.foreign_files import read_xml

MAX_BYTES = 64 << 20
"""Bytes of a description at most."""
TYPES = {
    "Real": "Real", "Integer": "Integer", "Boolean": "Boolean", "String": "String",
    "Enumeration": "Integer",
}  # fmt: skip
"""Types of variables of FMI 2, and by which functions their values are set and read."""
FLOATS = ("Real", "Float64", "Float32")
"""Types of real numbers."""
TYPES3 = {
    **{name: name for name in ("Float64", "Float32", "Boolean", "String")},
    **{f"{sign}Int{bits}": f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)},
    "Enumeration": "Int64",
}
"""The same of FMI 3."""


@dataclass(frozen=True)
class Variable:
    """A scalar variable of an FMU.

    - `type`: the type in the names of its set and get functions, such as `Real` or `Float64`.
    - `causality`: `parameter`, `input`, `output`, `local` ...
    - `variability`: `constant`, `fixed`, `tunable`, `discrete` or `continuous`.
    - `start`: its start value as text; None without one.
    - `low`, `high`: declared range; infinite if it has no end.
    - `scalar`: False for an array.
    - `items`: the values of an enumeration by the names of its items.
    """

    name: str
    reference: int
    type: str
    causality: str
    variability: str
    unit: str = ""
    start: str | None = None
    low: float = -math.inf
    high: float = math.inf
    description: str = ""
    scalar: bool = True
    items: Mapping[str, int] = field(default_factory=dict)

    def number(self, value: object) -> float:
        """Return a value as a number: an item of an enumeration by its name, any other as it is.

        **Raises:** `UnknownNameError` for a text that names no item; `ValueError` for a number that
        a variable of whole numbers cannot have.
        """
        if isinstance(value, str):
            if value not in self.items:
                raise missing_name(f"the variable {self.name}", "item", value, self.items)
            return self.items[value]
        number = float(value)  # pyright: ignore[reportArgumentType]
        if self.real:
            return number
        if self.type == "Boolean":
            wanted, fits = "0 or 1", number in (0, 1)
        elif self.items:
            wanted = ", ".join(f"{value} ({name})" for name, value in self.items.items())
            fits = number in self.items.values()
        else:
            wanted, fits = "a whole number", number.is_integer()
        if not fits:
            raise ValueError(f"{self.name} is of type {self.type}: {wanted}; got {number:zg}")
        return number

    @property
    def real(self) -> bool:
        """True if its values are real numbers."""
        return self.type in FLOATS

    @property
    def settable(self) -> bool:
        """True if its value can be set before a simulation starts."""
        return self.causality == "input" or (
            self.variability != "constant" and self.start is not None
        )


@dataclass(frozen=True)
class Description:
    """The description of an FMU, read from its archive.

    - `version`: the version of FMI, 2 or 3.
    - `identifier`, `token`: those of the binary, by which it recognises its description.
    - `exchange`: whether to simulate it by model exchange instead of co-simulation.
    - `sizes`: numbers of continuous states and event indicators, which FMI 2 declares.
    - `varies_step`: whether a communication step may differ from the others.
    - `keeps_states`: whether the FMU can save and restore its state.
    - `only_once`: whether a process can only have one instance of it.
    - `asks_after_steps`: whether it must be called after each step of the integrator.
    """

    file: Path
    version: int
    name: str
    identifier: str
    token: str
    variables: dict[str, Variable] = field(repr=False)
    exchange: bool = False
    sizes: tuple[int, int] = (0, 0)
    varies_step: bool = False
    keeps_states: bool = False
    only_once: bool = False
    asks_after_steps: bool = True

    def variable(self, name: str) -> Variable:
        """Return a variable; refuse one that does not exist, or is an array or a text."""
        if name not in self.variables:
            raise missing_name(f"the FMU {self.file.name}", "variable", name, list(self.variables))
        found = self.variables[name]
        if not found.scalar or found.type == "String":
            kind = "a text" if found.scalar else "an array"
            raise ValueError(f"{name} of the FMU {self.file.name} is {kind}, not one number")
        return found

    @property
    def binary(self) -> str:
        """Path in the archive of the binary for this machine; `ValueError` if there is none."""
        system = {"linux": "linux", "darwin": "darwin", "win32": "win"}.get(sys.platform, "linux")
        ending = {"linux": "so", "darwin": "dylib", "win": "dll"}[system]
        machine = platform.machine()
        machine = {"AMD64": "x86_64", "arm64": "aarch64"}.get(machine, machine)
        folder = f"{system}64" if self.version == 2 else f"{machine}-{system}"
        folder = f"{machine}-windows" if folder.endswith("-win") else folder
        wanted = f"binaries/{folder}/{self.identifier}.{ending}"
        names = open_archive(self.file, self.file.name).namelist()
        if wanted not in names:
            there = sorted({n.split("/")[1] for n in names if n.startswith("binaries/")} - {""})
            raise ValueError(
                f"the FMU {self.file.name} has no binary for this machine ({wanted}); it has "
                f"{', '.join(there) or 'none'}. Export it for this platform, or simulate where "
                "it runs (vj.remote)"
            )
        return wanted


def read_description(file: str | Path, exchange: bool | None = None) -> Description:
    """Read the description of an FMU.

    **Arguments:**
    - `exchange`: whether to read its model exchange; by default its co-simulation, if it has one.
    **Raises:** `FileNotFoundError`; `ValueError` for a file that is not an FMU of FMI 2 or 3, lacks
    the requested interface, or declares a document type.
    """
    path = Path(file).absolute()
    if not path.exists():
        raise FileNotFoundError(f"there is no FMU {path}")
    what = f"the modelDescription.xml of {path.name}"
    try:
        archive = open_archive(path, path.name)
        text = read_member(archive, "modelDescription.xml", path.name, MAX_BYTES)
    except ValueError as error:
        raise ValueError(
            f"{path.name} is not an FMU: an archive with modelDescription.xml is expected ({error})"
        ) from error
    root = read_xml(text, what)
    declared = root.get("fmiVersion", "without a version")
    if (version := declared.split(".")[0]) not in ("2", "3"):
        raise ValueError(f"{path.name} is of FMI {declared}; 2 and 3 can be simulated")
    kinds = {False: "CoSimulation", True: "ModelExchange"}
    there = {k: found for k, tag in kinds.items() if (found := root.find(tag)) is not None}
    exchange = next(iter(there), None) if exchange is None else exchange
    if exchange not in there:
        wanted = "co-simulation or model exchange" if exchange is None else kinds[exchange]
        raise ValueError(
            f"the FMU {path.name} does not offer {wanted}; it has "
            f"{' and '.join(kinds[k] for k in there) or 'neither'}. Export it again with this "
            "interface"
        )
    token = root.get("guid") if version == "2" else root.get("instantiationToken")
    states = len(root.findall("ModelStructure/Derivatives/Unknown"))
    try:
        variables = _variables(root, int(version))
        indicators = int(root.get("numberOfEventIndicators", "0"))
    except ValueError as error:
        raise ValueError(f"{what} is damaged: {one_line(str(error))}") from None
    kind, two = there[exchange], version == "2"

    def says(attribute: str) -> bool:
        return kind.get(attribute, "false") in ("true", "1")

    return Description(
        path, int(version), root.get("modelName", path.stem),
        kind.get("modelIdentifier", ""), token or "", variables,
        exchange, (states, indicators),
        says("canHandleVariableCommunicationStepSize") or exchange,
        says("canGetAndSetFMUstate" if two else "canGetAndSetFMUState"),
        says("canBeInstantiatedOnlyOncePerProcess"),
        not says("completedIntegratorStepNotNeeded") if two
        else says("needsCompletedIntegratorStep"),
    )  # fmt: skip


def _variables(root: Element, version: int) -> dict[str, Variable]:
    declared: dict[str, dict[str, str]] = {}
    items: dict[str, dict[str, int]] = {}
    for each in root.iterfind("TypeDefinitions/*"):
        inner = each if version == 3 else next(iter(each), each)
        name, entries = each.get("name", ""), inner.iterfind("Item")
        declared[name] = dict(inner.attrib)
        items[name] = {item.get("name", ""): int(item.get("value", "0")) for item in entries}
    found = {}
    for element in root.iterfind("ModelVariables/*"):
        value = element if version == 3 else next(iter(element), element)
        attributes = {**declared.get(value.get("declaredType", ""), {}), **value.attrib}
        kind = (TYPES3 if version == 3 else TYPES).get(value.tag)
        if kind is None:  # Clocks and binary data.
            continue
        name, texts = element.get("name", ""), value.find("Start")
        start = value.get("start", None if texts is None else texts.get("value"))
        found[name] = Variable(
            name, int(element.get("valueReference", "0")), kind,
            element.get("causality", "local"),
            element.get("variability", "continuous" if value.tag in FLOATS else "discrete"),
            attributes.get("unit", ""), start, float(attributes.get("min", "-inf")),
            float(attributes.get("max", "inf")), element.get("description", ""),
            value.find("Dimension") is None, items.get(value.get("declaredType", ""), {}),
        )  # fmt: skip
    return found
