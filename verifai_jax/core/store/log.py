"""A log: an append-only file of named entries.

    log = Log(folder / "inflight.rows")
    log.put({"7": {"rho": np.array([0.1])}})        # with the operating system when it returns
    log.get("7")                                    # {"rho": array([0.1])}

Entries put together form one frame: a header, the names of entries and arrays with their types and
shapes in JSON, and the bytes of the arrays, all under one checksum. So a process that dies loses
only the frame that it was writing, and a copy of a growing log is a valid log. Reading needs
neither a lock nor write permission. A damaged frame is skipped, since the next one is found by its
mark. Nothing in a log is executed.
"""

import contextlib
import io
import json
import os
import re
import struct
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from io import FileIO
from pathlib import Path
from typing import IO, Any, TypeAlias

import numpy as np

from verifai_jax.core.store.atomic_files import append_to, unwritable
from verifai_jax.core.store.files import DamagedError, checksum, write_complete
from verifai_jax.core.store.foreign_files import ForeignFileError, open_file

Arrays: TypeAlias = Mapping[str, np.ndarray]
"""An entry: arrays of numbers or texts, by name."""
MARK = b"VJX1"
"""First bytes of each frame."""
HEADER = struct.Struct("<4sIQI")
"""Mark, length of the names, length of the bytes, checksum of both."""
_PLAIN = re.compile(r"[<>|=]?[biufU]\d{1,9}")
"""NumPy's types of the arrays that can be stored: of numbers and texts."""
_JSON = "json"
"""Array of an entry that is plain data."""
_Extent: TypeAlias = tuple[int, int, list[Any]]
"""Where the bytes of an entry begin, how many they are; name, type and shape of its arrays."""


class Log:
    """The entries of a file; see the module's docstring.

    **Arguments:**
    - `path`: the file, made when the first entry is written; None stores entries in this process.
    """

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self._memory = io.BytesIO()
        self._file: FileIO | io.BytesIO | None = None
        self._close_file: Callable[[], object] | None = None
        self._extents: dict[str, _Extent] | None = None
        self._damaged = False

    def put(self, entries: Mapping[str, Arrays]) -> None:
        """Append entries, all or none of them; they replace earlier ones with the same names.

        **Raises:** `TypeError` for arrays of objects; `OSError` if they cannot be written.
        """
        frame = _encode(entries)
        try:
            if self.path is None:
                self._file = self._memory
            elif self._file is None:
                # No buffer, which a forked process would write once more.
                self._file = FileIO(self.path, "a")
                # Not `__del__`: in a cycle of references the file may be collected before the log.
                self._close_file = weakref.finalize(self, self._file.close)
            begin = append_to(self._file, frame)
        except OSError as error:
            raise unwritable(self.path or "", error) from error
        if self._extents is not None:
            self._extents.update(_extents(frame, begin))

    def get(self, name: str) -> dict[str, np.ndarray] | None:
        """Return an entry; None if it is missing or damaged."""
        if (extent := self._index().get(name)) is None:
            return None
        with self._opened() as file:
            return _decode(file, extent)

    def entries(self) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
        """Yield all entries with their names, in the order in which the names first appeared."""
        if extents := [*self._index().items()]:
            with self._opened() as file:
                for name, extent in extents:
                    if (entry := _decode(file, extent)) is not None:
                        yield name, entry

    def put_json(self, name: str, value: object) -> None:
        """Append plain data as an entry.

        **Raises:** `OSError` if it cannot be written.
        """
        self.put({name: {_JSON: np.frombuffer(json.dumps(value).encode(), np.uint8)}})

    def get_json(self, name: str) -> Any:
        """Return the plain data of an entry; None if it is missing or damaged."""
        entry = self.get(name)
        with contextlib.suppress(ValueError, KeyError, RecursionError):
            return None if entry is None else json.loads(entry[_JSON].tobytes())

    def names(self) -> list[str]:
        """Return the names of all entries, in the order in which they first appeared."""
        return [*self._index()]

    @property
    def damaged(self) -> bool:
        """True if there are bytes in the file that belong to no frame."""
        self._index()
        return self._damaged

    def clear(self) -> None:
        """Remove the file."""
        self.close()
        self._extents = None
        if self.path is not None:
            self.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Close the file; the next entry opens it again."""
        close, self._close_file, self._file = self._close_file, None, None
        if close is not None:
            close()

    def _opened(self) -> AbstractContextManager[IO[bytes]]:
        return contextlib.nullcontext(self._memory) if self.path is None else open_file(self.path)

    def _index(self) -> dict[str, _Extent]:
        """Find the frames of the file: the place of the last entry of each name."""
        if self._extents is None:
            extents: dict[str, _Extent] = {}
            self._damaged = False
            try:
                with self._opened() as file:
                    for found in _find_frames(file):
                        self._damaged |= found is None
                        extents.update(found or {})
            except FileNotFoundError:
                pass
            except ForeignFileError as error:
                why = str(error).removeprefix(f"{self.path} ")
                raise DamagedError(f"{self.path} is damaged: it {why}") from error
            self._extents = extents
        return self._extents


def write_log(path: Path, entries: Mapping[str, Arrays]) -> None:
    """Replace the log at `path` by one with these entries, atomically."""
    write_complete(path, _encode(entries) if entries else b"")


def _find_frames(file: IO[bytes]) -> Iterator[dict[str, _Extent] | None]:
    """Yield the entries of each frame of a file; None if it is damaged."""
    end, at = file.seek(0, os.SEEK_END), file.seek(0)
    while header := file.read(HEADER.size):
        with contextlib.suppress(struct.error, ValueError):
            _, head, body, _ = HEADER.unpack(header)
            # Damaged lengths are larger than any memory.
            yield _extents(header + file.read(min(head + body, end - at)), at)
            at += HEADER.size + head + body
            continue
        yield None
        file.seek(at + 1)
        rest = file.read()
        found = rest.find(MARK)
        at = file.seek(at + 1 + (len(rest) if found < 0 else found))


def _extents(frame: bytes, begin: int) -> dict[str, _Extent]:
    """Return where the entries of a frame are in a file, in which it begins at `begin`."""
    mark, head, body, own = HEADER.unpack_from(frame)
    if (
        mark != MARK
        or len(frame) != HEADER.size + head + body
        or own != _checksum(frame[: HEADER.size], frame[HEADER.size :])
    ):
        raise ValueError("no frame")
    extents: dict[str, _Extent] = {}
    at = begin + HEADER.size + head
    # A checksum is no proof of who wrote it: another program's entries are none.
    with contextlib.suppress(ValueError, TypeError, RecursionError):
        for name, size, arrays in json.loads(frame[HEADER.size : HEADER.size + head]):
            if not 0 <= size <= begin + len(frame) - at:
                break
            extents[str(name)] = at, int(size), list(arrays)
            at += int(size)
    return extents


def _checksum(header: bytes, content: bytes) -> int:
    return checksum(content, checksum(header[: HEADER.size - 4]))


def _encode(entries: Mapping[str, Arrays]) -> bytes:
    forms, parts = [], []
    for name, arrays in entries.items():
        for key, value in arrays.items():
            if not _PLAIN.fullmatch(value.dtype.str):
                raise TypeError(f"numbers and texts can be stored; {key} is {value.dtype}")
        size = sum(value.nbytes for value in arrays.values())
        forms.append((name, size, [(key, v.dtype.str, v.shape) for key, v in arrays.items()]))
        parts += [value.tobytes() for value in arrays.values()]
    head, size = json.dumps(forms).encode(), sum(map(len, parts))
    content, header = b"".join((head, *parts)), HEADER.pack(MARK, len(head), size, 0)
    return HEADER.pack(MARK, len(head), size, _checksum(header, content)) + content


def _decode(file: IO[bytes], extent: _Extent) -> dict[str, np.ndarray] | None:
    """Read an entry; None for one of another program."""
    begin, size, arrays = extent
    entry: dict[str, np.ndarray] = {}
    with contextlib.suppress(ValueError, TypeError, OverflowError):
        file.seek(begin)
        data, at = file.read(size), 0
        for key, kind, shape in arrays:
            if not _PLAIN.fullmatch(kind):  # NumPy evaluates others.
                return None
            dtype = np.dtype(kind)
            width = dtype.itemsize * int(np.prod(shape, dtype=np.int64))
            entry[str(key)] = np.frombuffer(data[at : at + width], dtype).reshape(shape).copy()
            at += width
        return entry
    return None
