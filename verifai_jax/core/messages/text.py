"""Text for people: numbers, shares, features and errors in one line."""

import math
import unicodedata
from collections.abc import Mapping, Sequence

import numpy as np


def listed(names: Sequence[str]) -> str:
    """Write names as a sentence does: `a`, `a and b`, `a, b and c`."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def counted(count: int, noun: str) -> str:
    """Write a number with its noun: `1 row`, `2 rows`, `1,024 rows of a table`."""
    noun, of, rest = noun.partition(" of ")
    return f"{count:,} {noun}{'s' * (count != 1)}{of}{rest}"


def format_percent(share: float) -> str:
    """Format a share as a percentage with three digits: `3.8 %`, `0.00171 %`, `>99.9 %`.

    Only a share of exactly 1 becomes `100 %`; one that is not finite becomes `unknown`.
    """
    if not math.isfinite(share):
        return "unknown"
    percent = 100 * share
    # Between 99.95 and 100 three digits would round to 100.
    if 99.95 <= percent < 100:
        return ">99.9 %"
    return f"{percent:z.3g} %"


def format_time(seconds: float, digits: int = 6) -> str:
    """Format an instant in seconds with enough digits to distinguish samples: `1700000003.5`.

    Up to 1000 s a few digits suffice; later instants keep their microseconds.
    """
    if abs(seconds) < 1000 or not math.isfinite(seconds):
        return f"{seconds:z.{digits}g}"
    return repr(round(float(seconds), 6)).removesuffix(".0")


_UNITS_OF_TIME = (("d", 86_400), ("h", 3600), ("min", 60))
"""Units of time above the second, as formulas take them, by their seconds."""
LONG = 600.0
"""Seconds from which on a time is written in minutes, hours and days; ..."""
STAMPS = 1e8
"""... up to this, three years: what is later is a stamp of a calendar's clock, not a duration."""


def format_seconds(seconds: float, digits: int = 6) -> str:
    """Format a time with its unit, in hours and minutes from ten minutes on: `11 h 3 min 0.5 s`.

    No digit that `format_time` would write is lost. Time stamps, such as 1700000003.5 s since 1970,
    stay in seconds.

    **Arguments:**
    - `seconds`: instant or duration.
    - `digits`: number of digits of a duration below ten minutes.
    """
    if not LONG <= abs(seconds) < STAMPS:
        return f"{format_time(seconds, digits)} s"
    rest, parts = round(abs(seconds), 6 if digits > 4 else 2), []
    for unit, size in _UNITS_OF_TIME:
        count, rest = divmod(rest, size)
        if count:
            parts.append(f"{int(count)} {unit}")
    rest = round(rest, 6 if digits > 4 else 2)
    if rest:
        parts.append(f"{rest:z.8g} s")
    return f"{'-' if seconds < 0 else ''}{' '.join(parts)}"


MAX_ENTRIES = 4
"""Numbers of one feature that are written one by one; of more, their range."""


def format_features(features: Mapping[str, object], labels: Mapping[str, str] | None = None) -> str:
    """Format features with four digits: `x0=0.1353, alg=sac, wind=16 values from -1 to 0.93`.

    For more than four columns `wind[0]`, `wind[1]`, ... only the range is written; absent items,
    such as `cars[3].x`, are left out.

    **Arguments:**
    - `features`: values by column.
    - `labels`: readable names of columns, where they differ.
    """
    labels = labels or {}
    entries: dict[str, list[tuple[str, object]]] = {}
    for name, value in features.items():
        if "]." in name and (value is None or value == "" or value != value):
            continue
        stem = name.partition("[")[0] if name.endswith("]") and _is_real(value) else name
        entries.setdefault(stem, []).append((name, value))
    parts = []
    for stem, columns in entries.items():
        there = [value for _, value in columns if value == value]
        if len(columns) <= MAX_ENTRIES or not there:
            parts += [f"{labels.get(n, n)}={_format_value(value)}" for n, value in columns]
            continue
        values = np.array([value for _, value in columns], float)
        values = values[~np.isnan(values)]  # Items that do not exist.
        low, high = (_format_value(float(end(values))) for end in (np.min, np.max))
        span = f"all {low}" if low == high else f"from {low} to {high}"
        parts.append(f"{stem}={len(values)} values {span}")
    return ", ".join(parts)


def _is_real(value: object) -> bool:
    return isinstance(value, float | int | np.number) and not isinstance(value, bool)


def _format_value(value: object) -> str:
    return f"{value:z.4g}" if isinstance(value, float | np.floating) else one_line(str(value))


def format_error(error: BaseException) -> str:
    """Format an exception in one line: its type and the first line of its message, shortened."""
    first = shorten((storable(error).splitlines() or [""])[0], MAX_MESSAGE_LENGTH)
    return f"{type(error).__name__}: {first}" if first else type(error).__name__


def shorten(text: str, maximum: int = 60) -> str:
    """Shorten a text to at most this many characters, leaving out a part before its end.

    The end is kept because the end of a name is more specific than its middle.
    """
    return (
        text
        if len(text) <= maximum
        else f"{text[: maximum // 3]}...{text[len(text) - maximum // 2 :]}"
    )


MAX_MESSAGE_LENGTH = 500
"""Maximum printed characters of a system's message; the table has the whole text."""


def printable(text: str, maximum: int | None = None) -> str:
    r"""Replace characters that control a terminal by escapes: `\x1b[2J`, `\u202e`.

    Otherwise texts of systems, tables and files could clear the screen, or reorder its content.
    Line breaks and tabs stay.

    **Arguments:**
    - `maximum`: maximum number of characters, from its start and its end; all when left out.
    """
    text = text if maximum is None else shorten(text, maximum)
    if text.isascii() and text.isprintable():
        return text
    return "".join(_escaped(each) if _steers(each) else each for each in text)


def storable(text: object, maximum: int = 2000) -> str:
    r"""Return a text from user code in a form that files and sockets accept, of bounded length.

    A lone surrogate, which UTF-8 cannot encode, becomes its escape: `\ud800`.

    **Arguments:**
    - `text`: the text; other objects are converted by `str`.
    - `maximum`: maximum number of characters, from its start and its end.
    """
    try:
        written = text if isinstance(text, str) else str(text)
    except BaseException as error:  # `__str__` is code of the user too, which may raise anything.
        if isinstance(error, KeyboardInterrupt):
            raise
        written = f"({type(text).__name__} whose text cannot be written)"
    return shorten(written, maximum).encode("utf-8", "backslashreplace").decode("utf-8")


def is_control(character: str) -> bool:
    """Return whether a character is a line break or controls a terminal."""
    return unicodedata.category(character) in ("Cc", "Zl", "Zp")


def _steers(character: str) -> bool:
    # Controls, formats (such as the direction of writing), surrogates, and separators of lines.
    return character not in "\n\t" and (
        unicodedata.category(character) in ("Cc", "Cf", "Cs", "Zl", "Zp")
    )


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


def one_line(text: str, maximum: int = MAX_MESSAGE_LENGTH) -> str:
    """Convert a text to one line of at most this many characters, safe for a terminal."""
    return printable(" ".join(shorten(text, maximum).split()))


def folder_name(text: str) -> str:
    """Return a folder name made from any text: `a_b` from `../a/b`.

    Letters, digits and a few signs stay, others become `_`; at most 100 characters remain.
    """
    kept = "".join(c if c.isalnum() or c in " ._-+=,()" else "_" for c in shorten(text, 100))
    return kept.strip(" ._") or "unnamed"
