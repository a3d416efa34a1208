"""A switch for people who read an error's sentence, and not its traceback: a class, a newcomer.

vj.plain_errors()                # from now on, in this notebook or program
vj.plain_errors(False)           # tracebacks again
"""

import functools
import linecache
import sys
import traceback
from pathlib import Path
from types import TracebackType
from typing import Any

PACKAGE = Path(__file__).resolve().parents[2]


def plain_errors(on: bool = True) -> None:
    """Show errors that this library raises by their sentence and the line that led to them.

    Errors of other origins, and those that a program catches, are as they were. It works in
    notebooks, in IPython and in programs.

    **Arguments:**
    - `on`: whether to show sentences alone; False brings the tracebacks back.
    """
    sys.excepthook = _show if on else sys.__excepthook__
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    if shell is not None:
        shell.set_custom_exc((Exception,) if on else (), _show_in_notebook if on else None)


def sentence(error: BaseException) -> str | None:
    """Return the sentence of an error of this library, with the line of the user's code.

    None for an error that was raised elsewhere.
    """
    frames = traceback.extract_tb(error.__traceback__)
    own = type(error).__module__.startswith("verifai_jax.")
    if not own and not (frames and _is_ours(frames[-1].filename)):
        return None
    text = f"{type(error).__name__}: {error}"
    notes = getattr(error, "__notes__", [])
    mine = next((f for f in reversed(frames) if not _is_library(f.filename)), None)
    where = []
    if mine is not None:
        line = mine.line or linecache.getline(mine.filename, mine.lineno or 0)
        where = [f"  line {mine.lineno}: {line.strip()}"]
    return "\n".join([text, *notes, *where])


@functools.cache
def _is_ours(file: str) -> bool:
    return PACKAGE in Path(file).resolve().parents


def _is_library(file: str) -> bool:
    return (
        _is_ours(file) or "site-packages" in file or file.startswith(("<frozen", sys.base_prefix))
    )


def _show(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    said = sentence(error)
    if said is None:
        sys.__excepthook__(kind, error, trace)
    else:
        print(said, file=sys.stderr)


def _show_in_notebook(
    shell: Any, kind: type[BaseException], error: BaseException, trace: TracebackType | None,
    tb_offset: int | None = None,
) -> None:  # fmt: skip
    said = sentence(error)
    if said is None:
        shell.showtraceback((kind, error, trace), tb_offset=tb_offset)
    else:
        print(said, file=sys.stderr)
