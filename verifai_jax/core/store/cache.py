"""The cache of finished work, from which killed work continues with the same numbers.

    with Cache(path, "sweep") as cache:
        cache.claim(fingerprint)                        # refuses the cache of another sweep
        cache.remember("train/...", lambda: {"x": np.arange(3)})

A cache is a log (`log.py`) that maps the name of a pure computation to the arrays that it returned.
Damaged entries are computed again, with a warning. The cache also records its work; if this record
cannot be read, the cache is refused.
"""

import contextlib
import json
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from verifai_jax.core.messages.text import one_line
from verifai_jax.core.store.atomic_files import reason
from verifai_jax.core.store.files import DamagedError
from verifai_jax.core.store.locks import write_lock
from verifai_jax.core.store.log import Arrays, Log
from verifai_jax.core.user_code.sources import Sources, list_changes

log = logging.getLogger("verifai_jax.cache")
_NOTE = "note:"
"""What the names of notes begin with."""
_ABOUT = "about"
"""Note of the work that the cache belongs to."""


class CacheError(ValueError):
    """An error for a cache that is damaged, foreign, not writable, or belongs to other work."""


class Cache:
    """Finished work on disk.

    **Arguments:**
    - `folder`: the folder of the cache file, for example `sweep.cache` for a sweep; None stores
      everything in this process only.
    - `kind`: the kind of work: `"sweep"` or `"augmentation"`.
    **Raises:** `CacheError` for a file that is not a cache, or is damaged.
    """

    def __init__(self, folder: str | Path | None = None, kind: str = "sweep") -> None:
        self.kind = kind
        self.path = None if folder is None else cache_file(Path(folder), kind)
        self._log = Log(self.path)
        self.computed = 0
        """Entries that this process computed."""
        self._own: set[str] = set()
        self._reused: set[str] = set()
        try:
            damaged = self._log.damaged
        except (OSError, DamagedError) as error:
            raise CacheError(f"{self.path} cannot be read: {error}") from error
        if damaged and not self._log.names():
            raise CacheError(f"{self.path} is not a cache: it is another kind of file, or damaged")
        if damaged:
            log.warning("%s is damaged: its unreadable parts are computed again", self.path)

    def claim(
        self, fingerprint: Mapping[str, Any], sources: Sources | None = None,
        even_if_changed: bool = False,
    ) -> tuple[Mapping[str, Any], ...]:  # fmt: skip
        """Record which work this cache belongs to, or refuse the cache of other work.

        **Arguments:**
        - `fingerprint`: nested dictionaries of plain data.
        - `sources`: the files of the work; work finished with other files is refused too.
        - `even_if_changed`: whether work with other files is accepted, and recorded.
        **Returns:** the recorded files when the work began, and each time it continued with other
        files; empty without `sources`.
        **Raises:** `CacheError` that lists the differences.
        """
        given = json.loads(json.dumps(fingerprint))
        about = self.note(_ABOUT)
        if about is None:
            if self.names():
                raise CacheError(
                    f"{self.path} is damaged: it lacks the record that identifies its computation"
                )
            about = self.note(_ABOUT, {"work": given, "sources": []})
        differences = list(_differences(given, about["work"]))
        if differences:
            raise CacheError(
                f"{self.path} holds a different {self.kind}: {'; '.join(differences[:4])}"
                f"{'; ...' if len(differences) > 4 else ''}. Give another folder, or repeat "
                f"the {self.kind} that this one belongs to"
            )
        if sources is None:
            return ()
        known = about["sources"]
        changes = Sources.from_json(known[-1]).changes(sources) if known else ()
        if changes and not even_if_changed:
            raise CacheError(
                f"{self.path} holds work of the same {self.kind} with other files: "
                f"{list_changes(changes)}. Give another folder, or restore the files; "
                "even_if_changed=True (--even-if-changed) continues regardless, and records it"
            )
        if changes or not known:
            about = {**about, "sources": [*known, sources.to_json()]}
            known = self.note(_ABOUT, about)["sources"]
        return tuple(known)

    def note(self, name: str, value: object = None) -> Any:
        """Return the plain data stored under a name, after storing `value` if it is given."""
        if value is not None:
            with self.writing():
                self._log.put_json(f"{_NOTE}{name}", value)
        return self._log.get_json(f"{_NOTE}{name}")

    def get(self, name: str) -> dict[str, np.ndarray] | None:
        """Return the arrays of a finished computation; None if it is missing or damaged."""
        arrays = self._log.get(name)
        if arrays is not None and name not in self._own:
            self._reused.add(name)
        return arrays

    def put(self, entries: Mapping[str, Arrays]) -> None:
        """Store finished computations, all or none of them."""
        with self.writing():
            self._log.put(entries)
        self.computed += len(entries)
        self._own.update(entries)

    def remember(
        self, name: str, compute: Callable[[], Mapping[str, np.ndarray]]
    ) -> dict[str, np.ndarray]:
        """Return the arrays of a computation, computing and storing them if they are missing."""
        arrays = self.get(name)
        if arrays is None:
            self.put({name: {key: np.asarray(value) for key, value in compute().items()}})
            # Read back, so that both ways give the same arrays.
            arrays = self.get(name)
            assert arrays is not None
        return arrays

    def reuse(self) -> dict[str, tuple[int, int]]:
        """Count by kind the entries used by this process, and those that existed before it.

        The kind of an entry is its name up to the first slash.
        """
        kinds: dict[str, tuple[int, int]] = {}
        for name in sorted(self._reused | self._own):
            kind = name.partition("/")[0]
            reused, used = kinds.get(kind, (0, 0))
            kinds[kind] = (reused + (name not in self._own), used + 1)
        return kinds

    def entries(self, prefix: str) -> Iterator[dict[str, np.ndarray]]:
        """Yield the arrays of all finished computations whose names start with this prefix."""
        for name in self._log.names():
            if name.startswith(prefix) and (arrays := self._log.get(name)) is not None:
                yield arrays

    def clear(self) -> None:
        """Remove everything except the record of the work."""
        about = self._log.get_json(f"{_NOTE}{_ABOUT}")
        self._log.clear()
        if about is not None:
            self.note(_ABOUT, about)

    def names(self) -> list[str]:
        """Return the names of all finished computations, sorted."""
        return sorted(name for name in self._log.names() if not name.startswith(_NOTE))

    @contextlib.contextmanager
    def writing(self, path: str | Path | None = None) -> Iterator[None]:
        """Raise `CacheError` if the file system refuses the cache, or results at `path`."""
        try:
            yield
        except OSError as error:
            where = self.path if path is None else path
            raise CacheError(
                f"{where} cannot be written: {reason(error)}; what was finished is in "
                f"{'it' if path is None else self.path}: make room if the disk is full, and run it "
                "again"
            ) from error


def cache_file(folder: Path, kind: str = "sweep") -> Path:
    """Return the path of the cache file in a folder, for one kind of work."""
    return folder / f"{kind}.cache"


@contextlib.contextmanager
def locked_cache(folder: str | Path | None, kind: str = "sweep") -> Iterator[Cache]:
    """Open a cache, and lock its folder for this process.

    **Raises:** `FolderInUse`, which names the process that has the lock; `ValueError` if the folder
    cannot be written; the errors of `Cache`.
    """
    with write_lock(None if folder is None else Path(folder)):
        yield Cache(folder, kind)


def _differences(one: object, other: object, path: str = "") -> Iterable[str]:
    """Write the differences of two fingerprints: `trainer.steps is 64, in the cache 32`."""
    if isinstance(one, dict) and isinstance(other, dict):
        for name in dict.fromkeys((*one, *other)):
            inner = f"{path}.{name}" if path else name
            yield from _differences(one.get(name), other.get(name), inner)
    elif one != other:
        yield f"{path} is {_abbreviate(one)}, in the cache {_abbreviate(other)}"


def _abbreviate(value: object) -> str:
    return one_line(value if isinstance(value, str) else json.dumps(value), 120)
