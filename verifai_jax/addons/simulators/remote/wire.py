"""Messages between a run and its simulators; `docs/remote.md` describes them for clients.

A frame is a length (4 bytes, big-endian) and that many bytes of UTF-8 JSON. If the JSON has a
number `"bytes"`, that many raw bytes follow, which may hold the arrays of the JSON:

    {"$array": "<f8", "shape": [200, 2], "at": 0}

All received data are untrusted: nothing is evaluated or unpickled, sizes are checked before
anything is stored, and invalid data raise a `WireError` that describes them.
"""

import json
import math
import struct
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any, NamedTuple

import numpy as np

from verifai_jax.core.messages.checks import is_number
from verifai_jax.core.messages.errors import check_names, unknown_name
from verifai_jax.core.values.trace import Trace
from verifai_jax.core.values.waveform import is_waveform

PROTOCOL = 1
DTYPES = ("<f8", "<f4", "<i8", "<i4", "<i2", "|i1", "|u1", "|b1")
_LENGTH = struct.Struct(">I")


class WireError(ValueError):
    """An error for a message that violates the protocol."""


class Message(NamedTuple):
    """One frame: its JSON, its raw bytes, and its numbers that JSON does not have (`NaN`)."""

    header: dict[str, Any]
    raw: bytes
    alien: tuple[str, ...]


def frame(message: Mapping[str, Any] | bytes) -> bytes:
    """Return a message without raw bytes, or its JSON, ready to send."""
    text = message if isinstance(message, bytes) else to_text(message).encode()
    return _LENGTH.pack(len(text)) + text


def to_text(value: object) -> str:
    """Write JSON in one line; numbers that JSON does not have become null."""
    try:
        return json.dumps(value, separators=(",", ":"), allow_nan=False)
    except ValueError:
        return json.dumps(_without_nan(value), separators=(",", ":"), allow_nan=False)


class Frames:
    """A stream of bytes, split into messages as they arrive.

    - `max_bytes`: maximum number of bytes in a frame, including raw ones.
    """

    def __init__(self, maximum: int) -> None:
        self.max_bytes = maximum
        self._bytes = bytearray()
        self._needed = _LENGTH.size  # Bytes without which nothing more can be read.
        self._alien: list[str] = []
        self._decoder = json.JSONDecoder(parse_constant=self._note)

    def feed(self, data: bytes) -> Iterator[Message]:
        """Yield the complete messages among the bytes received so far.

        **Raises:** `WireError` for an invalid message; later bytes cannot be read either.
        """
        self._bytes += data
        at = 0
        try:
            while len(self._bytes) - at >= self._needed:
                (length,) = _LENGTH.unpack_from(self._bytes, at)
                self._check_size(length)
                end = at + _LENGTH.size + length
                if len(self._bytes) < end:
                    self._needed = end - at
                    break
                message = self._parse(bytes(self._bytes[at + _LENGTH.size : end]))
                extra = message.header.get("bytes", 0)
                if not _is_integer(extra) or extra < 0:
                    raise WireError(f"'bytes' must be a number of bytes; got {brief(extra)}")
                self._check_size(length + extra)
                if len(self._bytes) < end + extra:
                    # It is parsed again then: what it holds may be many times its text.
                    self._needed = end + extra - at
                    break
                self._needed, at = _LENGTH.size, end + extra
                yield message._replace(raw=bytes(self._bytes[end:at])) if extra else message
        finally:
            del self._bytes[:at]

    def __len__(self) -> int:
        """Return how many bytes of an unfinished message are kept."""
        return len(self._bytes)

    def _check_size(self, size: int) -> None:
        if size > self.max_bytes:
            raise WireError(
                f"a frame of {brief(size)} bytes was announced, at most {self.max_bytes} are "
                "accepted; a frame begins with its length as 4 bytes, big-endian"
            )

    def _parse(self, text: bytes) -> Message:
        self._alien = []
        try:
            header = self._decoder.decode(text.decode())
        except (ValueError, RecursionError) as error:
            raise WireError(f"a frame must be UTF-8 JSON: {error}; got {brief(text)}") from error
        if not isinstance(header, dict) or not isinstance(header.get("type"), str):
            raise WireError(f"a message must be an object with a type; got {brief(header)}")
        return Message(header, b"", tuple(self._alien))

    def _note(self, name: str) -> float:
        # Read as a number, so that the message can still be told which of its points it spoils.
        self._alien.append(name)
        return math.nan


RESULT = ("type", "id", "bytes", "signals", "dt", "times", "valid", "error")


def trace_of(message: Message) -> Trace:
    """Return the trace in a `result`.

    **Raises:** `WireError`, or `ValueError` from `Trace`, for anything else.
    """
    header, raw = message.header, message.raw
    check_names("field of a result", header, RESULT)
    if message.alien:
        raise WireError(
            f"JSON has no {message.alien[0]}: send null for what is not a number, or raw arrays"
        )
    signals = header.get("signals")
    if not isinstance(signals, dict) or not signals:
        raise WireError(
            f"a result must have signals, an object of arrays by name; got {brief(signals)}"
        )
    dt, times, valid = header.get("dt"), header.get("times"), header.get("valid")
    if dt is not None and not (is_number(dt) and 0 < dt < math.inf):
        raise WireError(f"dt must be a positive number of seconds; got {brief(dt)}")
    if times is not None:
        times = _array("times", times, raw)
        if times.ndim != 1 or not np.all(np.isfinite(times)) or not np.all(np.diff(times) > 0):
            raise WireError("times must be numbers that increase strictly, in seconds")
    trace = Trace(
        {name: _array(f"signal {name!r}", value, raw) for name, value in signals.items()},
        dt=None if dt is None else float(dt), times=times, valid=valid,
    )  # fmt: skip
    if valid is not None and not (_is_integer(valid) and 1 <= valid <= trace.length):
        raise WireError(
            f"valid must be how many samples count, from 1 to {trace.length}; got {brief(valid)}"
        )
    return trace


def _array(name: str, value: object, raw: bytes) -> np.ndarray:
    if isinstance(value, dict):
        return _raw_array(name, value, raw)
    if not isinstance(value, list):
        raise WireError(f"{name} must be an array; got {brief(value)}")
    try:
        array = np.array(value)
        if array.dtype.kind == "O":  # null among the numbers
            array = np.array(value, np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise WireError(f"{name} must be an array of numbers in rows of one length") from error
    if array.dtype.kind not in "biuf":
        raise WireError(f"{name} must be an array of numbers; got {brief(value)}")
    return array


def _raw_array(name: str, value: dict[str, Any], raw: bytes) -> np.ndarray:
    kind, shape, at = value.get("$array"), value.get("shape"), value.get("at")
    if not isinstance(kind, str) or kind not in DTYPES:
        raise WireError(
            f"{name} must be a list or have a $array of {', '.join(DTYPES)}; got {brief(kind)}"
        )
    if not (isinstance(shape, list) and all(_is_integer(n) and n >= 0 for n in shape)):
        raise WireError(f"the shape of {name} must be a list of sizes; got {brief(shape)}")
    dtype, count = np.dtype(kind), math.prod(shape)
    if not isinstance(at, int) or at < 0 or at + count * dtype.itemsize > len(raw):
        raise WireError(
            f"{name} needs {brief(count * dtype.itemsize)} bytes from {brief(at)}; {len(raw)} "
            "were received"
        )
    return np.frombuffer(raw, dtype, count, at).reshape(shape)


def plain(value: Any) -> Any:
    """Return features for JSON: arrays as lists, a waveform as an object of its control points,
    another function, such as a reaction to signals, as one of its fields.

    **Raises:** `TypeError` for a value that JSON cannot hold.
    """
    if isinstance(value, Mapping):
        return {str(name): plain(inner) for name, inner in value.items()}
    if is_waveform(value):
        knots = np.asarray(value.knots).tolist()
        data = {"knots": knots, "hold": value.hold, "duration": value.duration}
        options = {"times": value.times, "width": value.width}
        return data | {name: plain(part) for name, part in options.items() if part is not None}
    if callable(value) and is_dataclass(value):
        return plain({part.name: getattr(value, part.name) for part in fields(value)})
    if isinstance(value, tuple | list):
        return [plain(inner) for inner in value]
    if value is None or isinstance(value, str | bool | int | float):
        return value
    array = np.asarray(value)
    if array.dtype.kind not in "biuf":
        kind = type(value).__name__
        raise TypeError(f"a feature of type {kind} cannot be sent to a simulator")
    return array.tolist()


def _without_nan(value: object) -> Any:
    if isinstance(value, dict):
        return {name: _without_nan(inner) for name, inner in value.items()}
    if isinstance(value, list):
        return [_without_nan(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _is_integer(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def unknown_type(kind: object, known: Iterable[str]) -> WireError:
    """Return the error for a message whose type is not `known`."""
    return WireError(str(unknown_name("type of message", printable(kind), known)))


def brief(value: object) -> str:
    """Write a value in a form short enough for a message."""
    try:
        text = ascii(value)
    except ValueError:  # An integer of more digits than Python prints.
        text = "a huge number"
    return text if len(text) <= 60 else text[:57] + "..."


def printable(value: object, maximum: int = 80) -> str:
    """Write an untrusted text in one line that cannot affect a log or a terminal."""
    text = value if isinstance(value, str) else brief(value)
    text = "".join(c if c.isprintable() else " " for c in text[: maximum + 1])
    return text if len(text) <= maximum else text[: maximum - 3] + "..."
