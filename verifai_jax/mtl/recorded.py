"""Recordings that a formula is asked about: traces, files, tables, or simulations of a problem.

as_recordings(["drive-1.csv", trace, frame])
as_recordings(problem)                          # 64 simulations from its prior
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeAlias, Union, runtime_checkable

from verifai_jax.core.lazy import lazy_import
from verifai_jax.core.trace import Trace
from verifai_jax.mtl.formula import Formula
from verifai_jax.mtl.recording import read

if TYPE_CHECKING:
    import pandas as pd


@runtime_checkable
class Simulated(Protocol):
    """A problem, which is of a room above this one: its traces are those of simulations."""

    name: str
    formulas: Mapping[str, Formula]
    nominal: Mapping[str, object] | None


Recording: TypeAlias = Union[Trace, str, Path, "pd.DataFrame"]
"""One recording: a trace, the path of a file, or a table."""
Recordings: TypeAlias = Recording | Sequence[Recording] | Simulated
"""One recording or several, or a problem that is simulated."""


def as_recordings(source: Recordings) -> tuple[Trace, ...]:
    """Return recordings as traces: one or several, or simulations of a problem.

    **Raises:** as `read`; `ValueError` for none.
    """
    if isinstance(source, Simulated):
        return lazy_import("verifai_jax.requirements", "simulated")(source)
    if isinstance(source, Sequence) and not isinstance(source, str):
        traces = tuple(_trace(one) for one in source)
    else:
        traces = (_trace(source),)
    if not traces:
        raise ValueError("no recording was given: at least one trace, file or table is needed")
    return traces


def _trace(source: Recording) -> Trace:
    return source if isinstance(source, Trace) else read(source)
