"""Results in notebooks, and the names that tab completion offers.

class Estimate(InNotebook): ...     # `_repr_html_` is its text
class Replay(InNotebook): ...       # ... and what `_notebook_parts` returns, such as its picture
class Mutants(Tabular): ...         # ... and its `table`, which `to_csv` writes
"""

import base64
import functools
import html
import io
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, TypeVar

from verifai_jax.core.display.figure import Figure
from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.messages.text import printable

if TYPE_CHECKING:
    import pandas as pd
T = TypeVar("T")
MAX_ROWS = 10
"""Rows of a table that are shown."""


class ForUsers:
    """A value whose tab completion leaves out attributes that are for internal use.

    A class lists those attributes in `_internal`; those of its bases are left out too.
    """

    _internal: ClassVar[frozenset[str]] = frozenset()

    def __dir__(self) -> list[str]:
        hidden = frozenset().union(*(vars(c).get("_internal", ()) for c in type(self).__mro__))
        return sorted(set(super().__dir__()) - hidden)


class InNotebook(ForUsers):
    """A result that a notebook shows as text, with its tables and pictures.

    Control characters in names of systems and files are escaped.
    """

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        for name in {"__str__", "__repr__", "summary"} & vars(cls).keys():
            setattr(cls, name, _in_printable_characters(vars(cls)[name]))

    def _notebook_parts(self) -> Iterable[str]:
        """Return the HTML that follows the text."""
        return ()

    def _repr_html_(self) -> str:
        return "\n".join([text_html(str(self)), *self._notebook_parts()])


class Tabular(InNotebook):
    """A result with a `table`, which a notebook shows."""

    def to_csv(self, path: str | Path) -> Path:
        """Write the table as CSV; return the path.

        **Raises:** `OSError` that names the file, for whatever the file system refuses.
        """
        table: pd.DataFrame = self.table  # pyright: ignore[reportAttributeAccessIssue]
        replacing = lazy_import("verifai_jax.core.store.atomic_files", "replacing")
        with replacing(path) as partial:
            table.to_csv(partial, index=table.index.name is not None)
        return Path(path)

    def _notebook_parts(self) -> Iterable[str]:
        return [frame_html(self.table)]  # pyright: ignore[reportAttributeAccessIssue]


def _in_printable_characters(write: Callable[[T], str]) -> Callable[[T], str]:
    @functools.wraps(write)
    def written(result: T) -> str:
        return printable(write(result))

    return written


def text_html(text: str) -> str:
    """Convert a text of several lines to HTML, as a terminal would show it."""
    return f'<pre style="white-space: pre-wrap">{html.escape(printable(text))}</pre>'


def rows_html(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Convert rows of text to an HTML table."""
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in header)
    body = "".join(
        "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def frame_html(frame: "pd.DataFrame") -> str:
    """Convert the first rows of a pandas table to HTML, numbers with four digits."""
    return frame.head(MAX_ROWS).to_html(float_format=lambda x: f"{x:z.4g}", border=0)


def picture_html(figure: Figure) -> str:
    """Convert a figure to an image in HTML."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=72)
    return f'<img src="data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}"/>'
