"""A log: a file of named entries, to which is only appended.

    log = Log(folder / "inflight.rows")
    log.put({"7": {"rho": np.array([0.1])}})        # with the operating system when it returns
    log.get("7")                                    # {"rho": array([0.1])}

What is put together is one frame: a header, the names of entries and arrays with their types and
shapes in JSON, and the bytes of the arrays. Both parts have a checksum. So a process that dies at
any moment leaves all frames but the one that it was writing; a copy of a log that is growing is a
log; it needs no lock to be read, nor a right to write; and damage costs the frames that it is in,
since the next one is found by its mark. Nothing in a log is executed.
"""

import contextlib
import io
import json
import os
import re
import struct
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple, TypeAlias

import numpy as np

from verifai_jax.store.files import DamagedError, checksum, write_whole

Arrays: TypeAlias = Mapping[str, np.ndarray]
"""An entry: arrays of numbers or texts, by name."""

MARK = b"VJX1"
"""First bytes of each frame."""
_HEADER = struct.Struct("<4sIQI")
"""Mark, length of the names, length of the bytes, checksum of the bytes."""
_CHECKSUM = struct.Struct("<I")
"""Checksum of header and names, between the two."""
_PLAIN = re.compile(r"[<>|=]?[biufU]\d{1,9}")
"""NumPy's types of the arrays that can be stored: of numbers and texts."""
_JSON = "json"
"""Array of an entry that is plain data."""


class _Frame(NamedTuple):
    head: bytes
    begin: int
    size: int
    checksum: int


class Log:
    """The entries of a file; see the module's docstring.

    **Arguments:**

    - `path`: the file, which is made when the first entry is put; None keeps them in this process.
    """

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self._memory = io.BytesIO()
        self._frames: dict[str, _Frame] | None = None
        self._damaged = False

    def put(self, entries: Mapping[str, Arrays]) -> None:
        """Append entries, all or none of them; they take the place of earlier ones of their names.

        **Raises:** `TypeError` for arrays of objects; `OSError` where they cannot be written.
        """
        content = _encode(entries)
        try:
            with self._opened("ab") as file:
                begin, rest = file.seek(0, os.SEEK_END), memoryview(content)
                try:
                    while rest:
                        rest = rest[file.write(rest) :]
                except OSError:
                    with contextlib.suppress(OSError):  # What little room there is, others need.
                        file.truncate(begin)
                    raise
        except OSError as error:
            raise type(error)(error.errno, error.strerror, str(self.path)) from error
        if self._frames is not None:
            self._frames |= dict.fromkeys(entries, _frame_at(content, begin))

    def get(self, name: str) -> dict[str, np.ndarray] | None:
        """Return an entry; None where there is none.

        **Raises:** `DamagedError` for one that is damaged.
        """
        if name not in self._index():
            return None
        with self._opened("rb") as file:
            return self._entry(file, name)

    def entries(self) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
        """Yield the entries that are whole, each with its name."""
        if names := self.names():
            with self._opened("rb") as file:
                for name in names:
                    with contextlib.suppress(DamagedError):
                        yield name, self._entry(file, name)

    def put_json(self, name: str, value: object) -> None:
        """Append plain data as an entry.

        **Raises:** `OSError` where it cannot be written.
        """
        self.put({name: {_JSON: np.frombuffer(json.dumps(value).encode(), np.uint8)}})

    def get_json(self, name: str) -> Any:
        """Return the plain data of an entry; None where there is none.

        **Raises:** `DamagedError` for one that is damaged.
        """
        try:
            entry = self.get(name)
            return None if entry is None else json.loads(entry[_JSON].tobytes())
        except (ValueError, KeyError, RecursionError) as error:
            raise DamagedError(f"{self.path} is damaged in {name!r}: it is no JSON") from error

    def names(self) -> list[str]:
        """Return the names of all entries, in the order in which they came first."""
        return [*self._index()]

    @property
    def damaged(self) -> bool:
        """True if there are bytes in the file that belong to no frame."""
        self._index()
        return self._damaged

    def clear(self) -> None:
        """Remove the file."""
        self._frames = None
        if self.path is not None:
            self.path.unlink(missing_ok=True)

    def _opened(self, mode: Literal["ab", "rb"]) -> AbstractContextManager[IO[bytes]]:
        if self.path is None:
            self._memory.seek(0)
            return contextlib.nullcontext(self._memory)
        # What is appended stays in no buffer, which a forked process would write once more.
        return open(self.path, mode, 0 if mode == "ab" else -1)

    def _index(self) -> dict[str, _Frame]:
        """Find the frames of the file, the last one of each name."""
        if self._frames is None:
            frames: dict[str, _Frame] = {}
            self._damaged = False
            try:
                with self._opened("rb") as file:
                    for frame in _find_frames(file):
                        self._damaged |= frame is None
                        if frame is not None:
                            frames |= dict.fromkeys((name for name, _ in _forms(frame)), frame)
            except FileNotFoundError:
                pass
            except IsADirectoryError as error:
                raise DamagedError(f"{self.path} is damaged: it is not a file") from error
            self._frames = frames
        return self._frames

    def _entry(self, file: IO[bytes], name: str) -> dict[str, np.ndarray]:
        frame = self._index()[name]
        body = _body_of(file, frame)
        if body is None:
            raise DamagedError(f"{self.path} is damaged in {name!r}: its bytes have changed")
        try:
            return _decode(frame, body)[name]
        except (ValueError, TypeError, KeyError, OverflowError) as error:
            raise DamagedError(f"{self.path} is damaged in {name!r}: {error}") from error


def write_log(path: Path, entries: Mapping[str, Arrays]) -> None:
    """Put a log of these entries in place of the one at `path`, never half of it.

    **Raises:** as `Log.put`.
    """
    write_whole(path, _encode(entries) if entries else b"")


def _find_frames(file: IO[bytes]) -> Iterator[_Frame | None]:
    """Yield the frames of a file; None where there is damage, but for that of bytes in a frame."""
    end, at = file.seek(0, os.SEEK_END), file.seek(0)
    while begin := file.read(_HEADER.size + _CHECKSUM.size):
        try:
            # Damaged lengths are larger than any memory.
            length = min(_HEADER.unpack_from(begin)[1], end - at)
            frame = _frame_at(begin + file.read(length), at)
        except (struct.error, ValueError):
            yield None
            at = _find_mark(file, at + 1)
            continue
        yield frame
        at = file.seek(min(frame.begin + frame.size, end))
        # One that was being written when its process died would hide those that came later.
        torn = file.read(len(MARK)) != MARK and _body_of(file, frame) is None
        at = _find_mark(file, frame.begin) if torn else file.seek(at)


def _frame_at(content: bytes, at: int) -> _Frame:
    """Return the frame that begins with `content`, which has its names at least.

    - `at`: place of the content in the file.

    **Raises:** `ValueError` for what is no frame, or has changed.
    """
    mark, length, size, body = _HEADER.unpack_from(content)
    begin = _HEADER.size + _CHECKSUM.size + length
    head = content[_HEADER.size + _CHECKSUM.size : begin]
    (own,) = _CHECKSUM.unpack_from(content, _HEADER.size)
    if mark != MARK or len(head) < length or own != _checksum_of(content[: _HEADER.size], head):
        raise ValueError("no frame")
    return _Frame(head, at + begin, size, body)


def _checksum_of(header: bytes, head: bytes) -> int:
    return checksum(head, checksum(header))


def _body_of(file: IO[bytes], frame: _Frame) -> bytes | None:
    """Return the bytes of a frame; None where they have changed, or are not all there."""
    if frame.begin + frame.size > file.seek(0, os.SEEK_END):
        return None
    file.seek(frame.begin)
    body = file.read(frame.size)
    return body if checksum(body) == frame.checksum else None


def _find_mark(file: IO[bytes], at: int) -> int:
    """Go to the next place from `at` on where a frame may begin, or to the end; return it."""
    file.seek(at)
    rest = file.read()
    found = rest.find(MARK)
    return file.seek(at + (len(rest) if found < 0 else found))


def _encode(entries: Mapping[str, Arrays]) -> bytes:
    forms, parts = [], []
    for name, arrays in entries.items():
        for key, value in arrays.items():
            if not _PLAIN.fullmatch(value.dtype.str):
                raise TypeError(f"numbers and texts can be stored; {key} is {value.dtype}")
        forms.append((name, [(key, v.dtype.str, v.shape) for key, v in arrays.items()]))
        parts += [value.tobytes() for value in arrays.values()]
    head, body = json.dumps(forms).encode(), b"".join(parts)
    header = _HEADER.pack(MARK, len(head), len(body), checksum(body))
    return b"".join((header, _CHECKSUM.pack(_checksum_of(header, head)), head, body))


def _forms(frame: _Frame) -> list[tuple[str, Any]]:
    """Return the names of the entries of a frame, each with the forms of its arrays."""
    try:
        return [(str(name), arrays) for name, arrays in json.loads(frame.head)]
    except (ValueError, TypeError, RecursionError):
        return []  # Of another program: a checksum is no proof of who wrote it.


def _decode(frame: _Frame, body: bytes) -> dict[str, dict[str, np.ndarray]]:
    entries: dict[str, dict[str, np.ndarray]] = {}
    at = 0
    for name, arrays in _forms(frame):
        own = entries[name] = {}
        for key, kind, shape in arrays:
            if not _PLAIN.fullmatch(kind):  # NumPy evaluates others.
                raise ValueError(f"{key} is {kind}")
            dtype = np.dtype(kind)
            size = dtype.itemsize * int(np.prod(shape, dtype=np.int64))
            own[key] = np.frombuffer(body[at : at + size], dtype).reshape(shape).copy()
            at += size
    return entries
