"""The sheet of an FMEA: the words of its authors beside what the simulations measured.

sheet = table.sheet({"gyro_dropout": {"component": "gyro", "severity": 8}})
sheet.table, sheet.to_csv("fmea.csv"), sheet.to_xlsx("fmea.xlsx")
"""

import io
import itertools
import math
from bisect import bisect_right
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from verifai_jax.core.display.notebook import Tabular
from verifai_jax.core.messages.checks import check_fraction
from verifai_jax.core.messages.errors import check_names, require
from verifai_jax.core.messages.text import format_seconds, printable
from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.core.store.foreign_files import read_text

if TYPE_CHECKING:
    import pandas as pd

Words: TypeAlias = Mapping[str, Mapping[str, Any]] | str | Path | None
"""Columns by the name of a fault or a pair, or the path of a CSV file with them."""
TEXTS = ("component", "cause", "effect", "mitigation", "owner")
"""Columns whose texts the authors give."""
SHARED = ("component", "cause", "owner")
"""Columns of a pair that join the texts of its faults if it has none of its own."""
MEASURED = {
    "probability": "probability", "low": "low", "high": "high", "missed": "missed",
    "missed_high": "missed_high", "alarm_after": "alarm_after", "fails_from": "severity",
    "verdict": "verdict", "replay": "replay",
}  # fmt: skip
"""Columns of measured values, each with the column of the failure table that it repeats."""


@dataclass(frozen=True)
class Scale:
    """Ratings from 1 to 10 of probabilities and of missed failures.

    - `name`: the name of the scale, with its source, which stands in the sheet.
    - `occurrence`: nine rising probabilities, each of which raises the rating by one where the
      upper end of the interval of a failure's probability reaches it.
    - `detection`: nine rising shares, likewise for the failures that the detector misses.
    - `priority`: a function of the ratings of severity, occurrence and detection, for a column
      `priority`, such as the table of action priorities of a handbook.
    """

    name: str
    occurrence: tuple[float, ...]
    detection: tuple[float, ...]
    priority: Callable[[int, int, int], str] | None = None

    def __post_init__(self) -> None:
        for name in ("occurrence", "detection"):
            ends = getattr(self, name)
            if len(ends) != 9 or any(b <= a for a, b in itertools.pairwise(ends)):
                raise ValueError(f"{name} of a scale must be nine rising numbers; got {ends!r}")
            for end in ends:
                check_fraction(f"{name} of a scale", end, one=True)


DECADES = Scale(
    "verifai_jax: decades of the probability, from 1e-9; tenths of missed failures",
    tuple(float(f"1e-{k}") for k in range(9, 0, -1)),
    tuple(k / 10 for k in range(1, 10)),
)
"""The scale that is used by default; it is that of no standard."""


@dataclass(frozen=True, eq=False)
class Sheet(Tabular):
    """An FMEA sheet with a row for each fault; made by `FailureTable.sheet`.

    - `name`: the name of the problem.
    - `table`: the rows as a DataFrame. `rpn` is `severity * occurrence * detection`; it is missing
      where one of them is.
    - `notes`: what the ratings and the probabilities mean.
    """

    name: str
    table: "pd.DataFrame"
    notes: Mapping[str, str]

    def to_xlsx(self, path: str | Path) -> Path:
        """Write the sheet as a workbook of Excel, with its notes on a second page.

        **Raises:** `MissingExtra` without openpyxl; `OSError` that names the file.
        """
        book = require("openpyxl", "xlsx").Workbook()
        rows = [["fault", *self.table.columns]]
        rows += [
            [name, *row] for name, row in zip(self.table.index, self.table.values, strict=True)
        ]
        for title, lines in (
            ("FMEA", rows),
            ("Notes", [list(pair) for pair in self.notes.items()]),
        ):
            page = book.active if title == "FMEA" else book.create_sheet()
            page.title = title
            for i, line in enumerate(lines, 1):
                for j, value in enumerate(line, 1):
                    _fill(page.cell(i, j), value)
        book.worksheets[0].freeze_panes = "B2"
        with replacing(path) as partial:
            book.save(partial)
        return Path(path)

    def __str__(self) -> str:
        return self.table.to_string()


def _fill(cell: Any, value: Any) -> None:
    if isinstance(value, str) and value:
        cell.value = printable(value)
        cell.data_type = "s"  # A text that begins with = is no formula.
    elif not isinstance(value, str) and value is not None and value == value:
        cell.value = value


def make_sheet(name: str, measured: "pd.DataFrame", notes: Mapping[str, str], words: Words,
               scale: Scale) -> Sheet:  # fmt: skip
    """Make a sheet of the rows of a failure table; see `FailureTable.sheet`."""
    import pandas as pd

    given = _checked(_read(words) if isinstance(words, str | Path) else words or {}, measured.index)
    rows = []
    columns: list[dict[str, Any]] = measured.to_dict("records")
    for fault, found in zip(map(str, measured.index), columns, strict=True):
        row: dict[str, Any] = {column: _text(fault, column, given) for column in TEXTS}
        if found["property"] and not row["effect"]:
            after = format_seconds(found["onset_to_violation"], 3)
            row["effect"] = f"breaks {found['property']} {after} after the onset"
        severity = given.get(fault, {}).get("severity")
        ratings = [severity, _rating(found["high"], scale.occurrence),
                   _rating(found["missed_high"], scale.detection)]  # fmt: skip
        known = [each for each in ratings if each is not None]
        row |= dict(zip(("severity", "occurrence", "detection"), ratings, strict=True))
        row["rpn"] = math.prod(known) if len(known) == 3 else None
        if scale.priority is not None:
            row["priority"] = scale.priority(*known) if len(known) == 3 else ""
        rows.append(row | {column: found[of] for column, of in MEASURED.items()})
    table = pd.DataFrame(rows, pd.Index(list(measured.index), name="fault"))
    for column in ("severity", "occurrence", "detection", "rpn"):  # As whole numbers, or missing.
        table[column] = pd.Series([row[column] for row in rows], table.index, dtype=object)
    return Sheet(name, table, {"problem": name, "scale": scale.name, **notes})


def _rating(value: float, ends: tuple[float, ...]) -> int | None:
    return None if math.isnan(value) else 1 + bisect_right(ends, value)


def _text(fault: str, column: str, given: Mapping[str, Mapping[str, Any]]) -> str:
    text = given.get(fault, {}).get(column) or ""
    if not text and column in SHARED:
        parts = [given.get(one, {}).get(column) or "" for one in fault.split(" + ")]
        text = "; ".join(dict.fromkeys(filter(None, parts)))
    return text


def _checked(
    given: Mapping[str, Mapping[str, Any]], rows: "pd.Index"
) -> Mapping[str, Mapping[str, Any]]:
    """Check words; faults of pairs may have some, too."""
    singles = [one for name in rows for one in str(name).split(" + ")]
    check_names("row of the failure table", given, dict.fromkeys([*rows, *singles]))
    for fault, columns in given.items():
        check_names(f"column of {fault!r}", columns, (*TEXTS, "severity"))
        for column, value in columns.items():
            if column == "severity" and (type(value) is not int or not 1 <= value <= 10):
                raise ValueError(
                    f"severity of {fault!r} must be a whole number from 1 to 10; got {value!r}"
                )
            if column != "severity" and not isinstance(value, str):
                raise ValueError(f"{column} of {fault!r} must be a text; got {value!r}")
    return given


def _read(path: str | Path) -> dict[str, dict[str, Any]]:
    """Read the words of faults from a CSV file, whose entries are separated by , or ;."""
    import pandas as pd

    text = read_text(path)
    first = text.partition("\n")[0]
    mark = ";" if first.count(";") > first.count(",") else ","
    try:
        table = pd.read_csv(io.StringIO(text), dtype=str, keep_default_na=False, sep=mark)
    except ValueError as error:
        raise ValueError(f"{path} is not a table of words: {error}") from None
    if "fault" not in table.columns:
        raise ValueError(f"{path} needs a column 'fault'; it has {', '.join(table.columns)}")
    found: dict[str, dict[str, Any]] = {}
    for row in table.to_dict("records"):
        words: dict[str, Any] = {k: v.strip() for k, v in row.items() if k != "fault" and v.strip()}
        if words.get("severity", "").isdecimal():
            words["severity"] = int(words["severity"])
        if row["fault"].strip() in found:
            raise ValueError(f"{path} has two rows for fault {row['fault'].strip()!r}")
        found[row["fault"].strip()] = words
    return found
