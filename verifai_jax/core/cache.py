"""The cache of finished work: what was killed continues from it, with the same numbers.

    with Cache(path, "sweep") as cache:
        cache.claim(fingerprint)                        # refuses the cache of another sweep
        cache.remember("train/...", lambda: {"x": np.arange(3)})

A cache maps the name of a pure computation to the arrays that it returned, in one SQLite file. Each
entry is committed when it is finished; in write-ahead mode a process that is killed at any moment
leaves all committed entries. An entry is the bytes of its arrays with their types and shapes in
JSON, and a checksum of these and of its name: nothing in it is ever executed. An entry that is
damaged is one that is missing: it is computed anew, and the log says so.
"""

import contextlib
import json
import logging
import sqlite3
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from verifai_jax.core.locks import write_lock
from verifai_jax.core.sources import Sources, list_changes

log = logging.getLogger("verifai_jax.cache")

Arrays: TypeAlias = dict[str, np.ndarray]
"""The result of one computation: arrays of numbers or texts, by name."""

_MARKS = {"sweep": 0x564A5357, "augmentation": 0x564A4155}
"""SQLite's application id of each kind of cache: "VJSW", "VJAU"."""
_FORMAT = 3
"""Format of the file; files of another format are refused."""
_BEGIN = b"SQLite format 3\0"
"""First bytes of a database; an empty file has none yet."""
_KINDS = "biufU"
"""NumPy's kinds of the arrays that can be stored."""


class CacheError(ValueError):
    """An error for a cache that is damaged, foreign, of another format, or of other work."""


class Cache:
    """Finished work on disk.

    **Arguments:**

    - `path`: the file (`.sqlite`, `.db`), or a folder, in which it is `sweep.sqlite` for a sweep;
      None keeps everything in this process only.
    - `kind`: of the work: `"sweep"` or `"augmentation"`.

    **Raises:** `CacheError` for a file that is not a cache of this kind, damaged, or of another
    format.
    """

    def __init__(self, path: str | Path | None = None, kind: str = "sweep") -> None:
        self.kind = kind
        self.path = None if path is None else cache_file(Path(path), kind)
        self.computed = 0
        """Entries that this process computed."""
        self._own: set[str] = set()
        self._reused: set[str] = set()
        if self.path is not None:
            _refuse_other_files(self.path, kind)
            self.path.parent.mkdir(parents=True, exist_ok=True)
        try:
            # Transactions begin and end in `_transaction`, not by the module.
            self._base = sqlite3.connect(
                ":memory:" if self.path is None else self.path, timeout=60, isolation_level=None
            )
        except sqlite3.Error as error:
            raise CacheError(f"{self.path} cannot be opened: {error}") from error
        try:
            self._open()
        except sqlite3.Error as error:
            self._base.close()
            what, hint = _trouble(error, f"is no cache of {_one(kind)}")
            raise CacheError(f"{self.path} {what}: {error}{hint}") from error
        except BaseException:
            self._base.close()
            raise

    def _open(self) -> None:
        tables = self._base.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
        mark = self._base.execute("PRAGMA application_id").fetchone()[0]
        if tables and mark != _MARKS[self.kind]:
            raise CacheError(
                f"{self.path} is a database of something else, not of {_one(self.kind)}"
            )
        form = self._base.execute("PRAGMA user_version").fetchone()[0]
        if tables and form != _FORMAT:
            raise CacheError(
                f"{self.path} has format {form}, and this verifai_jax reads format {_FORMAT}; "
                f"resume the {self.kind} with the version that began it, or give another folder"
            )
        self._base.execute("PRAGMA journal_mode=WAL")
        # A killed process loses nothing; a power cut at most the last transactions.
        self._base.execute("PRAGMA synchronous=NORMAL")
        if tables:
            return
        self._base.execute("BEGIN IMMEDIATE")
        self._base.execute(f"PRAGMA application_id={_MARKS[self.kind]}")
        self._base.execute(f"PRAGMA user_version={_FORMAT}")
        self._base.execute(
            "CREATE TABLE IF NOT EXISTS about (name TEXT PRIMARY KEY, value TEXT, checksum INTEGER)"
        )
        self._base.execute(
            "CREATE TABLE IF NOT EXISTS work "
            "(name TEXT PRIMARY KEY, form TEXT, checksum INTEGER, bytes BLOB)"
        )
        self._base.execute("COMMIT")

    def claim(
        self,
        fingerprint: Mapping[str, Any],
        sources: Sources | None = None,
        even_if_changed: bool = False,
    ) -> tuple[Mapping[str, Any], ...]:
        """Record the work that this cache belongs to, or refuse the cache of other work.

        **Arguments:**

        - `fingerprint`: nested dictionaries of plain data.
        - `sources`: what the work is made of; finished work of other files is refused too.
        - `even_if_changed`: whether work of other files will do; it is recorded then.

        **Returns:** what the work was made of when it began, and each time it went on with other
        files; nothing where that is not recorded.

        **Raises:** `CacheError` with the differences.
        """
        begun = self.note(self.kind) is not None
        text = json.dumps(fingerprint, sort_keys=True)
        with self._transaction():
            # If two processes start at once, the first to write decides.
            self._base.execute(
                "INSERT OR IGNORE INTO about VALUES (?, ?, ?)",
                (self.kind, text, _checksum(self.kind, text)),
            )
        known = self.note(self.kind)
        differences = list(_differences(json.loads(text), known))
        if differences:
            raise CacheError(
                f"{self.path} holds a different {self.kind}: {'; '.join(differences[:4])}"
                f"{'; ...' if len(differences) > 4 else ''}. Give another folder, or repeat "
                f"the {self.kind} that this one belongs to"
            )
        return () if sources is None else self._claim_sources(sources, begun, even_if_changed)

    def _claim_sources(
        self, sources: Sources, begun: bool, even_if_changed: bool
    ) -> tuple[Mapping[str, Any], ...]:
        known = self.note("sources") or []
        if begun and not known:
            return ()
        changes = Sources.from_json(known[-1]).changes(sources) if known else ()
        if changes and not even_if_changed:
            raise CacheError(
                f"{self.path} holds work of the same {self.kind} with other files: "
                f"{list_changes(changes)}. Give another folder, or restore the files; "
                "even_if_changed=True (--even-if-changed) goes on all the same, and notes it"
            )
        if known and not changes:
            return tuple(known)
        return tuple(self.note("sources", [*known, sources.to_json()]))

    def note(self, name: str, value: object = None) -> Any:
        """Return the plain data stored under a name, after storing `value` where one is given."""
        with self._transaction():
            if value is not None:
                text = json.dumps(value)
                self._base.execute(
                    "INSERT OR REPLACE INTO about VALUES (?, ?, ?)",
                    (name, text, _checksum(name, text)),
                )
            row = self._base.execute(
                "SELECT value, checksum FROM about WHERE name=?", (name,)
            ).fetchone()
        if row is None:
            return None
        try:
            if _checksum(name, row[0]) != row[1]:
                raise ValueError("its text has changed, or is that of another note")
            return json.loads(row[0])
        except (ValueError, TypeError) as error:
            raise CacheError(f"{self.path} is damaged in its note {name!r}: {error}") from error

    def get(self, name: str) -> Arrays | None:
        """Return the arrays of a finished computation; None if it is not, or is damaged."""
        with self._transaction(reading=True):
            row = self._base.execute(
                "SELECT form, checksum, bytes FROM work WHERE name=?", (name,)
            ).fetchone()
        if row is None:
            return None
        try:
            arrays = self._decode(name, *row)
        except CacheError as error:
            log.warning("%s; it is computed anew", error)
            return None
        if name not in self._own:
            self._reused.add(name)
        return arrays

    def put(self, work: Mapping[str, Arrays]) -> None:
        """Store finished computations, all or none of them."""
        rows = [(name, *_encode(name, arrays)) for name, arrays in work.items()]
        self.computed += len(rows)
        self._own.update(work)
        with self._transaction():
            self._base.executemany("INSERT OR REPLACE INTO work VALUES (?, ?, ?, ?)", rows)

    def remember(self, name: str, compute: Callable[[], Arrays]) -> Arrays:
        """Return the arrays of a computation, computed and stored where they are missing."""
        arrays = self.get(name)
        if arrays is None:
            computed = {key: np.asarray(value) for key, value in compute().items()}
            self.put({name: computed})
            # Decoded as when it is read back, so that both ways give the same arrays.
            arrays = self._decode(name, *_encode(name, computed))
        return arrays

    def reuse(self) -> dict[str, tuple[int, int]]:
        """Count the entries that were here before this process, of all that it used, by kind.

        The kind of an entry is its name up to the first slash.
        """
        kinds: dict[str, tuple[int, int]] = {}
        for name in sorted(self._reused | self._own):
            kind = name.partition("/")[0]
            reused, used = kinds.get(kind, (0, 0))
            kinds[kind] = (reused + (name not in self._own), used + 1)
        return kinds

    def names(self) -> list[str]:
        """Return the names of all finished computations."""
        return [row[0] for row in self._base.execute("SELECT name FROM work ORDER BY name")]

    def close(self) -> None:
        """Close the file."""
        self._base.close()

    def __enter__(self) -> "Cache":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextlib.contextmanager
    def _transaction(self, reading: bool = False) -> Iterator[None]:
        """Execute all of the statements inside, or none; SQLite's errors become `CacheError`."""
        try:
            self._base.execute("BEGIN" if reading else "BEGIN IMMEDIATE")
            try:
                yield
            except BaseException:
                if self._base.in_transaction:  # A full disk has ended it already.
                    self._base.execute("ROLLBACK")
                raise
            self._base.execute("COMMIT")
        except sqlite3.Error as error:
            what = "is damaged" if isinstance(error, sqlite3.DatabaseError) else "failed"
            what, hint = _trouble(error, what, "; restore it from a copy, or give another folder")
            raise CacheError(f"{self.path} {what}: {error}{hint}") from error

    def _decode(self, name: str, form: str, checksum: int, data: bytes) -> Arrays:
        try:
            if _checksum(name, form, data) != checksum:
                raise ValueError("its bytes have changed, or are those of another entry")
            return _decode(json.loads(form), data)
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise CacheError(f"{self.path} is damaged in {name!r}: {error}") from error


def _trouble(error: sqlite3.Error, otherwise: str, hint: str = "") -> tuple[str, str]:
    """Return what is wrong with a file, and what to do, where it is locked, read-only or full."""
    if not isinstance(error, sqlite3.OperationalError):
        return otherwise, hint
    if "full" in str(error):
        return "cannot be written", "; what was finished is in it: make room and begin again"
    return "cannot be used", ""


def _one(kind: str) -> str:
    return f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}"


def _refuse_other_files(path: Path, kind: str) -> None:
    """Refuse a file that SQLite would take for an empty database, and write over."""
    if path.is_file():
        with open(path, "rb") as file:
            begin = file.read(len(_BEGIN))
        if begin not in (b"", _BEGIN):
            raise CacheError(f"{path} is no cache of {_one(kind)}: it is a file of another kind")


def cache_file(path: Path, kind: str = "sweep") -> Path:
    """Return the path of the cache file at a place, for one kind of work.

    **Raises:** `CacheError` for a folder that is named as a file, and the other way round.
    """
    if path.suffix in (".sqlite", ".sqlite3", ".db"):
        if path.is_dir():
            raise CacheError(f"{path} is a folder; a cache is a file")
        return path
    if path.is_file():
        raise CacheError(f"{path} is a file of another kind; give a folder, or a .sqlite file")
    return path / f"{kind}.sqlite"


@contextlib.contextmanager
def locked_cache(folder: str | Path | None, kind: str = "sweep") -> Iterator[None]:
    """Be the only one who writes to a cache; None is none on disk.

    **Raises:** `FolderInUse`, which names the process that writes to it; `CacheError` where it
    cannot be written.
    """
    with contextlib.ExitStack() as held:
        if folder is not None:
            path = Path(folder)
            file = cache_file(path, kind)
            try:
                file.parent.mkdir(parents=True, exist_ok=True)
                held.enter_context(write_lock(file if file == path else path))
            except OSError as error:
                raise CacheError(f"{folder} cannot be written: {error}") from error
        yield


def _encode(name: str, arrays: Mapping[str, np.ndarray]) -> tuple[str, int, bytes]:
    forms, parts = [], []
    for key, value in arrays.items():
        array = np.ascontiguousarray(value)
        if array.dtype.kind not in _KINDS:
            raise TypeError(f"a cache stores numbers and texts; {key} is {array.dtype}")
        forms.append([key, array.dtype.str, list(np.shape(value))])
        parts.append(array.tobytes())
    form, data = json.dumps(forms), b"".join(parts)
    return form, _checksum(name, form, data), data


def _checksum(name: str, form: str, data: bytes = b"") -> int:
    # With the name: the entries of two names that are exchanged are whole, and both wrong.
    return zlib.crc32(data, zlib.crc32(json.dumps([name, form]).encode()))


def _decode(forms: list[list[Any]], data: bytes) -> Arrays:
    arrays, at = {}, 0
    for key, kind, shape in forms:
        dtype = np.dtype(kind)
        if dtype.kind not in _KINDS:
            raise ValueError(f"{key} is {dtype}")
        size = dtype.itemsize * int(np.prod(shape, dtype=np.int64))
        part = data[at : at + size]
        arrays[key] = np.frombuffer(part, dtype).reshape(shape).copy()
        at += size
    return arrays


def _differences(one: object, other: object, path: str = "") -> Iterable[str]:
    """Write the differences of two fingerprints: `trainer.steps is 64, in the cache 32`."""
    if isinstance(one, dict) and isinstance(other, dict):
        for name in dict.fromkeys((*one, *other)):
            inner = f"{path}.{name}" if path else name
            yield from _differences(one.get(name), other.get(name), inner)
    elif one != other:
        yield f"{path} is {_abbreviate(one)}, in the cache {_abbreviate(other)}"


def _abbreviate(value: object) -> str:
    text = json.dumps(value) if not isinstance(value, str) else value
    return text if len(text) <= 120 else f"{text[:117]}..."
