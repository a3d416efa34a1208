"""Recordings on which formulas are evaluated: traces, files, tables, or simulations of a problem.

named_recordings("logs/")                       # the files in and below a folder, unread
named_traces(["drive-1.csv", trace, frame])
named_traces(problem)                           # 64 simulations from its prior
"""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeAlias, Union, runtime_checkable

from verifai_jax.addons.monitoring.containers import Episode, episodes_of, lerobot_files
from verifai_jax.addons.monitoring.readers import ending_of, endings
from verifai_jax.addons.monitoring.recording import read
from verifai_jax.addons.monitoring.topics import bag_files
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.values.trace import Trace
from verifai_jax.mtl.formula import Formula

if TYPE_CHECKING:
    import pandas as pd


@runtime_checkable
class Simulated(Protocol):
    """A problem (defined in a higher layer), whose traces are those of simulations."""

    name: str
    formulas: Mapping[str, Formula]
    nominal: Mapping[str, object] | None


Recording: TypeAlias = Union[Trace, str, Path, Episode, "pd.DataFrame"]
"""One recording: a trace, the path of a file or of a folder of them, an episode, or a table."""
Recordings: TypeAlias = Recording | Iterable[Recording] | Mapping[str, Recording] | Simulated
"""One recording or several, also by name, or a problem that is simulated."""


def named_recordings(source: Recordings) -> Iterator[tuple[str, Recording]]:
    """Yield recordings with their names, unread; files of a folder are sorted by path.

    A folder of one bag in several files is one recording.

    **Raises:** `FileNotFoundError` for a file or a folder that does not exist; `ValueError` for a
    folder without a recording.
    """
    if isinstance(source, Simulated):
        traces = lazy_import("verifai_jax.addons.monitoring.mined_bounds", "simulated")(source)
        yield from ((f"simulation {index}", trace) for index, trace in enumerate(traces, 1))
        return
    if isinstance(source, Mapping):
        yield from ((str(name), one) for name, one in source.items())
        return
    alone = isinstance(source, str | Path | Trace | Episode) or hasattr(source, "columns")
    several: Iterable[Recording] = [source] if alone else source  # pyright: ignore
    for index, one in enumerate(several, 1):
        if not isinstance(one, str | Path):
            yield f"recording {index}", one
            continue
        path = Path(one)
        if not path.exists():
            raise FileNotFoundError(f"there is no recording {path}")
        if lerobot := lerobot_files(path):
            for each in episodes_of(lerobot):
                yield f"{path} episode {each.number}", each
            continue
        if not path.is_dir() or ending_of(path):
            yield str(path), path
            continue
        files = [each for each in sorted(path.rglob("*")) if ending_of(each)]
        if not files:
            raise ValueError(f"there is no recording ({', '.join(endings())}) in {path}")
        bags = {folder: set(bag_files(folder)) for folder in {each.parent for each in files}}
        whole = dict.fromkeys(f.parent if f in bags[f.parent] else f for f in files)
        yield from ((str(file), file) for file in whole)


def named_traces(source: Recordings) -> dict[str, Trace]:
    """Return recordings as traces by their names.

    **Raises:** the errors of `named_recordings` and `read`; `ValueError` for no recordings.
    """
    traces = {
        name: one if isinstance(one, Trace) else read(one) for name, one in named_recordings(source)
    }
    if not traces:
        raise ValueError("no recording was given: at least one trace, file or table is needed")
    return traces
