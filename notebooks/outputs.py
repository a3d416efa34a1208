"""Text outputs of a notebook, compared with those it had before.

differences(stored, executed)       # ["cell 11 ...: differs ...", ...]; empty where they agree

Two outputs agree where their words agree, integers are equal, and other numbers differ by less than
a thousandth. Durations and speeds are left out, and pictures have no text. A cell with the tag
`machine-dependent`, such as one that trains a network, needs only the same kinds of output. Where
another JAX computed the stored outputs, only words are compared: compilers round differently, and a
search that learns of other roundings simulates other points.
"""

import difflib
import math
import re
from collections.abc import Iterator
from typing import Any

TAG = "machine-dependent"
"""Tag of cells whose text depends on the machine."""

RELATIVE, ABSOLUTE = 1e-3, 1e-6
"""Tolerances of numbers with a decimal point or an exponent."""

NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?", re.IGNORECASE)
"""A number, perhaps with commas between its thousands."""

NOT_A_NUMBER = re.compile(r"-?\b(?:nan|inf)\b", re.IGNORECASE)
"""Entries of a table that are no finite numbers."""

SPENT = re.compile(
    r"[\d.,]+ (?:ms|s|min|h)(?= to compile| to search| to simulate| to confirm| to run| of a core)"
    r"|(?<=failing, )[\d.,]+ (?:ms|s|min|h)\b"
    r"|(?<=simulations in )[\d.,]+ (?:ms|s|min|h)(?=, stopped)"
    r"|(?<=% intervals; )[\d.,]+ (?:ms|s|min|h)\b"
    r"|[\d.,]+ (?=(?:simulations|steps)/s\b)"
)
"""Time that the machine needed, and its speed."""

REST = re.compile(r", [\d.,]+ s for callbacks and files")
"""A time that is only stated where it is not next to nothing, which differs from run to run."""

PICTURES = ("image/png", "image/gif", "image/svg+xml", "image/jpeg")


def texts(cell: Any) -> dict[str, str]:
    """Return what a code cell shows, by kind: its printed text, results and pictures.

    **Arguments:**

    - `cell`: a code cell of nbformat 4.

    **Returns:** `"stdout"` for all that it prints, `"result 0"` and so on for what it displays. A
    picture is an empty text of the kind `"picture"`. What goes to stderr is left out.
    """
    shown: dict[str, str] = {}
    for output in cell.get("outputs", []):
        if output["output_type"] == "stream":
            if output["name"] == "stdout":
                shown["stdout"] = shown.get("stdout", "") + "".join(output["text"])
            continue
        data = output.get("data", {})
        picture = any(kind in data for kind in PICTURES)
        name = f"{'picture' if picture else 'result'} {len(shown)}"
        shown[name] = "" if picture else "".join(data.get("text/plain", ""))
    return shown


def agree(stored: str, new: str, same_compiler: bool = True) -> bool:
    """Check that two texts agree: words and integers exactly, other numbers nearly.

    **Arguments:**

    - `stored`, `new`: the texts.
    - `same_compiler`: one version of JAX computed both; otherwise numbers are not compared.
    """
    stored, new = (SPENT.sub("TIME ", REST.sub("", text)) for text in (stored, new))
    if not same_compiler:
        return _words(NOT_A_NUMBER.sub("0", stored)) == _words(NOT_A_NUMBER.sub("0", new))
    numbers, new_numbers = NUMBER.findall(stored), NUMBER.findall(new)
    return (
        _words(stored) == _words(new)
        and len(numbers) == len(new_numbers)
        and all(map(_same_number, numbers, new_numbers))
    )


def _words(text: str) -> list[str]:
    # Rules of tables are as long as their numbers.
    return [re.sub("[-─=]{2,}", "--", word) for word in NUMBER.sub("#", text).split()]


def _same_number(before: str, after: str) -> bool:
    whole = not any(mark in text.lower() for text in (before, after) for mark in ".e")
    if whole:
        return before.replace(",", "") == after.replace(",", "")
    one, other = (float(text.replace(",", "")) for text in (before, after))
    return math.isclose(one, other, rel_tol=RELATIVE, abs_tol=ABSOLUTE)


def jax_version(notebook: Any) -> str | None:
    """Return the version of JAX that computed a notebook's outputs; None if it is not recorded."""
    return notebook.get("metadata", {}).get("verifai_jax", {}).get("jax")


def differences(stored: Any, executed: Any) -> list[str]:
    """List the cells whose outputs differ, each with its difference.

    **Arguments:**

    - `stored`: the notebook as it was.
    - `executed`: the same notebook, executed.

    **Returns:** a text for each cell that differs.
    """
    same = jax_version(stored) == jax_version(executed)
    return [
        f"cell {number}, {_first_line(cell)}\n{difference}"
        for number, (cell, new) in enumerate(zip(stored["cells"], executed["cells"], strict=True))
        if cell["cell_type"] == "code"
        for difference in _difference(cell, new, same)
    ]


def _difference(cell: Any, new_cell: Any, same_compiler: bool) -> Iterator[str]:
    before, after = texts(cell), texts(new_cell)
    if list(before) != list(after):
        yield f"  stored outputs: {', '.join(before) or 'none'}; new: {', '.join(after) or 'none'}"
        return
    if TAG in cell.get("metadata", {}).get("tags", []):
        return
    for kind, text in before.items():
        if not agree(text, after[kind], same_compiler):
            lines = difflib.unified_diff(
                text.splitlines(), after[kind].splitlines(), "stored", "new", n=0, lineterm=""
            )
            yield "\n".join(f"  {line}" for line in lines)


def _first_line(cell: Any) -> str:
    source = "".join(cell["source"]).strip()
    return source.splitlines()[0] if source else "(empty)"
