"""Commands whose finished simulations are kept until the command is done.

    with kept_until_done() as kept:
        found = estimate(problem)
        kept.stopped(found.stopped)

The same command continues from them, whatever ended it: its arguments determine the folder.
"""

import contextlib
import hashlib
import json
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from verifai_jax.cli.json_output import as_plain, say

if TYPE_CHECKING:
    from verifai_jax.evaluation.unfinished import Unfinished
WORDS = "verifai_jax.words"
"""Entry of a context that has the words of the command line."""
FOLDER = Path("runs") / "unfinished"
"""Folder of unfinished work, with a subfolder for each command."""
EARLY = ("interrupted", "max_seconds")
"""What ends work before it is done."""
_BESIDES = frozenset(
    ("max_seconds", "cluster", "fail_on", "plot", "report", "table", "pictures", "into")
)
"""Options on which no simulation depends."""


class Kept:
    """The finished simulations of a command, which are removed when it is done."""

    def __init__(self, work: "Unfinished | None") -> None:
        self._work = work

    def stopped(self, why: str | None) -> None:
        """Record that the result exists, and why the work ended; None if it is done."""
        if self._work is None:
            return
        self._work.done = why not in EARLY
        if not self._work.done:
            say(f"  resume       {command_line()}")


@contextlib.contextmanager
def kept_until_done() -> Iterator[Kept]:
    """Keep the simulations of the present command until it reports that it is done.

    If nothing can be written, or the same command is running, nothing is kept, and a note says so.
    """
    from verifai_jax.core.display.progress import goes_on_with, write_line
    from verifai_jax.evaluation.unfinished import keeping

    context = click.get_current_context()
    work = {"command": context.info_name} | {
        name: as_plain(value) for name, value in context.params.items() if name not in _BESIDES
    }
    digest = hashlib.sha256(json.dumps(work, sort_keys=True).encode()).hexdigest()[:12]
    folder = FOLDER / f"{context.info_name}-{digest}"
    try:
        with contextlib.ExitStack() as held:
            kept = None
            try:
                kept = held.enter_context(keeping(folder, work))
                held.enter_context(goes_on_with(command_line(), lambda: True))
            except ValueError as error:
                write_line(f"note: goes on without keeping what is finished: {error}")
            try:
                yield Kept(kept)
            except KeyboardInterrupt:
                if kept is not None and not kept.empty:
                    say(f"  resume       {command_line()}", err=True)
                raise
    finally:
        for parent in (FOLDER, FOLDER.parent):
            with contextlib.suppress(OSError):
                parent.rmdir()


def command_line() -> str:
    """Return the present command in shell syntax."""
    context = click.get_current_context()
    return shlex.join(["verifai-jax", *context.meta.get(WORDS, [context.info_name or ""])])
