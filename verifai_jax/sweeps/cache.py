"""Finished work, kept: a killed sweep goes on with what is here, and gives the same numbers.

    with Store(path) as store:
        store.belongs(description)                       # refuses the store of another sweep
        store.remember("train/...", lambda: {"x": np.arange(3)})

A store maps the name of a pure piece of work to the arrays that came of it, in one SQLite file.
Each entry is committed when it is finished; in write-ahead mode a process that is killed at any
moment leaves all that was committed. An entry is the bytes of its arrays with their forms in JSON
and a checksum: nothing in it is ever executed.
"""

import contextlib
import json
import sqlite3
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

Work = dict[str, np.ndarray]

_MARK = 0x564A5357  # "VJSW": the file is one of ours.
_FORMAT = 1
_FILE = "sweep.sqlite"
_KINDS = "biufU"


class StoreError(ValueError):
    """A store that cannot be used: damaged, foreign, or of another sweep."""


class Store:
    """The memory of a sweep.

    **Arguments:**

    - `path`: of the file (`.sqlite`, `.db`), or of a folder, in which it is `sweep.sqlite`; None
      keeps everything in this process only.

    **Raises:** `StoreError` for a file that is no store or is damaged.
    """

    def __init__(self, path: str | Path | None = None) -> None:
        self.path = None if path is None else store_file(Path(path))
        self.made = 0
        """Pieces of work that were computed, not found."""
        if self.path is not None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        try:
            # Transactions are begun and ended here, not by the module.
            self._base = sqlite3.connect(
                ":memory:" if self.path is None else self.path, timeout=60, isolation_level=None
            )
        except sqlite3.Error as error:
            raise StoreError(f"{self.path} cannot be opened: {error}") from error
        try:
            self._open()
        except sqlite3.Error as error:
            self._base.close()
            raise StoreError(f"{self.path} is no store of a sweep: {error}") from error
        except BaseException:
            self._base.close()
            raise

    def _open(self) -> None:
        tables = self._base.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
        mark = self._base.execute("PRAGMA application_id").fetchone()[0]
        if tables and mark != _MARK:
            raise StoreError(f"{self.path} is a database of something else, not of a sweep")
        form = self._base.execute("PRAGMA user_version").fetchone()[0]
        if tables and form > _FORMAT:
            raise StoreError(
                f"{self.path} was written by a newer verifai_jax (format {form}, this one reads "
                f"{_FORMAT})"
            )
        self._base.execute("PRAGMA journal_mode=WAL")
        # A killed process loses nothing; a power cut at most the last transactions.
        self._base.execute("PRAGMA synchronous=NORMAL")
        if tables:
            return
        self._base.execute("BEGIN IMMEDIATE")
        self._base.execute(f"PRAGMA application_id={_MARK}")
        self._base.execute(f"PRAGMA user_version={_FORMAT}")
        self._base.execute("CREATE TABLE IF NOT EXISTS about (name TEXT PRIMARY KEY, value TEXT)")
        self._base.execute(
            "CREATE TABLE IF NOT EXISTS work "
            "(name TEXT PRIMARY KEY, form TEXT, checksum INTEGER, bytes BLOB)"
        )
        self._base.execute("COMMIT")

    def belongs(self, description: Mapping[str, Any]) -> None:
        """Say what this store is of, or refuse a store that is of something else.

        - `description`: nested dictionaries of plain data.

        **Raises:** `StoreError`, saying what differs.
        """
        text = json.dumps(description, sort_keys=True)
        with self._transaction():
            # The first to write it decides, if two processes start at once.
            self._base.execute("INSERT OR IGNORE INTO about VALUES ('sweep', ?)", (text,))
        known = self.note("sweep")
        differences = list(_differences(json.loads(text), known))
        if differences:
            raise StoreError(
                f"{self.path} holds a different sweep: {'; '.join(differences[:4])}"
                f"{'; ...' if len(differences) > 4 else ''}. Give another store, or sweep what "
                "this one is of"
            )

    def note(self, name: str, value: Any = None) -> Any:
        """Plain data kept under a name beside the work; with a `value`, keep that instead."""
        with self._transaction():
            if value is not None:
                row = (name, json.dumps(value))
                self._base.execute("INSERT OR REPLACE INTO about VALUES (?, ?)", row)
            found = self._base.execute("SELECT value FROM about WHERE name=?", (name,)).fetchone()
        try:
            return None if found is None else json.loads(found[0])
        except (json.JSONDecodeError, TypeError) as error:
            raise StoreError(f"{self.path} is damaged in its note {name!r}") from error

    def get(self, name: str) -> Work | None:
        """The arrays of a finished piece of work; None where it is not finished.

        **Raises:** `StoreError` for an entry that is damaged.
        """
        with self._transaction(reading=True):
            found = self._base.execute(
                "SELECT form, checksum, bytes FROM work WHERE name=?", (name,)
            ).fetchone()
        return None if found is None else self._decoded(name, *found)

    def put(self, work: Mapping[str, Work]) -> None:
        """Keep finished pieces of work, all or none of them."""
        rows = [(name, *_encoded(arrays)) for name, arrays in work.items()]
        self.made += len(rows)
        with self._transaction():
            self._base.executemany("INSERT OR REPLACE INTO work VALUES (?, ?, ?, ?)", rows)

    def remember(self, name: str, compute: Callable[[], Work]) -> Work:
        """The arrays of a piece of work, computed and kept where they are not known yet."""
        found = self.get(name)
        if found is None:
            made = {key: np.asarray(value) for key, value in compute().items()}
            self.put({name: made})
            # As it is read back, so that it makes no difference which of the two happened.
            found = self._decoded(name, *_encoded(made))
        return found

    def names(self) -> list[str]:
        """What is finished."""
        return [row[0] for row in self._base.execute("SELECT name FROM work ORDER BY name")]

    def close(self) -> None:
        """Let go of the file."""
        self._base.close()

    def __enter__(self) -> "Store":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextlib.contextmanager
    def _transaction(self, reading: bool = False) -> Iterator[None]:
        """All of the statements inside, or none; what SQLite says against them is our error."""
        try:
            self._base.execute("BEGIN" if reading else "BEGIN IMMEDIATE")
            try:
                yield
            except BaseException:
                self._base.execute("ROLLBACK")
                raise
            self._base.execute("COMMIT")
        except sqlite3.Error as error:
            what = "is damaged" if isinstance(error, sqlite3.DatabaseError) else "failed"
            if isinstance(error, sqlite3.OperationalError):
                what = "cannot be used"  # Locked, read-only, or the disk is full.
            raise StoreError(f"{self.path} {what}: {error}") from error

    def _decoded(self, name: str, form: str, checksum: int, data: bytes) -> Work:
        try:
            if zlib.crc32(data, zlib.crc32(form.encode())) != checksum:
                raise ValueError("its bytes have changed")
            return _decoded(json.loads(form), data)
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise StoreError(f"{self.path} is damaged in {name!r}: {error}") from error


def store_file(path: Path) -> Path:
    """The file of the store at this place."""
    if path.suffix in (".sqlite", ".sqlite3", ".db"):
        if path.is_dir():
            raise StoreError(f"{path} is a folder; a store is a file")
        return path
    if path.is_file():
        raise StoreError(f"{path} is a file of another kind; give a folder, or a .sqlite file")
    return path / _FILE


def _encoded(arrays: Mapping[str, np.ndarray]) -> tuple[str, int, bytes]:
    forms, parts = [], []
    for key, value in arrays.items():
        array = np.ascontiguousarray(value)
        if array.dtype.kind not in _KINDS:
            raise TypeError(f"a store keeps numbers and texts; {key} is {array.dtype}")
        forms.append([key, array.dtype.str, list(np.shape(value))])
        parts.append(array.tobytes())
    form, data = json.dumps(forms), b"".join(parts)
    return form, zlib.crc32(data, zlib.crc32(form.encode())), data


def _decoded(forms: Any, data: bytes) -> Work:
    found, at = {}, 0
    for key, kind, shape in forms:
        dtype = np.dtype(kind)
        if dtype.kind not in _KINDS:
            raise ValueError(f"{key} is {dtype}")
        size = dtype.itemsize * int(np.prod(shape, dtype=np.int64))
        part = data[at : at + size]
        found[key] = np.frombuffer(part, dtype).reshape(shape).copy()
        at += size
    return found


def _differences(one: Any, other: Any, place: str = "") -> Iterable[str]:
    """Where two descriptions differ, in words: `trainer.steps is 64, there 32`."""
    if isinstance(one, dict) and isinstance(other, dict):
        for name in dict.fromkeys((*one, *other)):
            inner = f"{place}.{name}" if place else name
            yield from _differences(one.get(name), other.get(name), inner)
    elif one != other:
        yield f"{place} is {_shown(one)}, in the store {_shown(other)}"


def _shown(value: Any) -> str:
    text = json.dumps(value) if not isinstance(value, str) else value
    return text if len(text) <= 120 else f"{text[:117]}..."
