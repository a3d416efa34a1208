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
    """Write a share as a percentage of three digits: `3.8 %`, `0.00171 %`, `>99.9 %`.

    Only a share of exactly 1 is written `100 %`; one that is not finite is `unknown`.
    """
    if not math.isfinite(share):
        return "unknown"
    percent = 100 * share
    # Between 99.95 and 100 three digits would round to 100.
    if 99.95 <= percent < 100:
        return ">99.9 %"
    return f"{percent:z.3g} %"


def format_probability(probability: float) -> str:
    """Write a probability with three digits, or with as many as tell it from 1: `0.99993`."""
    if 0.999 < probability < 1:
        digits = -math.floor(math.log10(1 - probability))
        return f"{probability:z.{digits}f}".rstrip("0")
    return f"{probability:z.3g}"


def format_time(seconds: float, digits: int = 6) -> str:
    """Write an instant in seconds so that it can be told from its neighbours: `1700000003.5`.

    A few digits suffice up to 1000 s; of later instants the microseconds are kept.
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
    """Write a time with its unit, from ten minutes on in those of a person: `11 h 3 min 0.5 s`.

    Nothing is rounded away that `format_time` would write. Stamps, such as 1700000003.5 s since
    1970, stay in seconds.

    **Arguments:**
    - `seconds`: instant or duration.
    - `digits`: the digits of a duration below ten minutes.
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
    """Write features with four digits: `x0=0.1353, alg=sac, wind=16 values from -1 to 0.93`.

    Of columns `wind[0]`, `wind[1]`, ... that are more than four only the range is written; parts of
    items that do not exist, such as `cars[3].x`, are left out.

    **Arguments:**
    - `features`: values by column.
    - `labels`: names for people by column, where they differ.
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
    """Write an exception in one line: its type and the first line of its message, shortened."""
    first = shorten((storable(error).splitlines() or [""])[0], MAX_MESSAGE_LENGTH)
    return f"{type(error).__name__}: {first}" if first else type(error).__name__


def shorten(text: str, maximum: int = 60) -> str:
    """Shorten a text to at most so many characters by leaving out some before its end.

    The end of a name says more than its middle.
    """
    return (
        text
        if len(text) <= maximum
        else f"{text[: maximum // 3]}...{text[len(text) - maximum // 2 :]}"
    )


MAX_MESSAGE_LENGTH = 500
"""Characters of a message of somebody's system that are printed; the table has all of it."""


def printable(text: str, maximum: int | None = None) -> str:
    r"""Write characters that steer a terminal as escapes: `\x1b[2J`, `\u202e`.

    Texts of systems, tables and files could otherwise clear the screen, or reorder what is on it.
    Line breaks and tabs stay.

    **Arguments:**
    - `maximum`: characters that are kept, of its begin and its end; all when left out.
    """
    text = text if maximum is None else shorten(text, maximum)
    if text.isascii() and text.isprintable():
        return text
    return "".join(_escaped(each) if _steers(each) else each for each in text)


def storable(text: object, maximum: int = 2000) -> str:
    r"""Return a text from a user's code in a form that files and sockets accept, of bounded length.

    A lone surrogate, which UTF-8 cannot hold, becomes its escape: `\ud800`.

    **Arguments:**
    - `text`: the text; anything else is written by `str`.
    - `maximum`: characters that are kept, of its beginning and its end.
    """
    try:
        written = text if isinstance(text, str) else str(text)
    except BaseException as error:  # `__str__` is code of the user too, which may raise anything.
        if isinstance(error, KeyboardInterrupt):
            raise
        written = f"({type(text).__name__} whose text cannot be written)"
    return shorten(written, maximum).encode("utf-8", "backslashreplace").decode("utf-8")


def is_control(character: str) -> bool:
    """Return whether a character breaks a line, or controls a terminal."""
    return unicodedata.category(character) in ("Cc", "Zl", "Zp")


def _steers(character: str) -> bool:
    # Controls, formats (such as the direction of writing), surrogates, and separators of lines.
    return character not in "\n\t" and (
        unicodedata.category(character) in ("Cc", "Cf", "Cs", "Zl", "Zp")
    )


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


def one_line(text: str, maximum: int = MAX_MESSAGE_LENGTH) -> str:
    """Write a text in one line of at most so many characters, safe for a terminal."""
    return printable(" ".join(shorten(text, maximum).split()))


def folder_name(text: str) -> str:
    """Return a name for a folder, from a text that may hold anything: `a_b` of `../a/b`.

    Letters, digits and a few signs stay; other characters become `_`, and at most 100 are kept.
    """
    kept = "".join(c if c.isalnum() or c in " ._-+=,()" else "_" for c in shorten(text, 100))
    return kept.strip(" ._") or "unnamed"
