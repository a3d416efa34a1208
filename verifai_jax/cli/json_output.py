"""`--json`: the result of a command as one JSON object, for programs.

    @command()
    def estimate(...):
        ...
        give_result(probability=found.probability, low=found.low, high=found.high)

With `--json` the standard output is only this object; text for people, and what libraries and
processes write to descriptor 1, goes to the standard error stream. Numbers that are not finite are
null.
"""

import atexit
import contextlib
import ctypes
import functools
import json
import math
import os
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any, TextIO

import click

from verifai_jax._version import __version__

_RESULT = "verifai_jax.result"


class ReportingCommand(click.Command):
    """A command with the option `--json`."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        about = "Write the result as JSON, and what people read to the error stream."
        self.params.append(click.Option(["--json", "as_json"], is_flag=True, help=about))

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command, and print its result as JSON if requested."""
        if not ctx.params.pop("as_json"):
            return super().invoke(ctx)
        with output_to_errors() as out:
            try:
                return super().invoke(ctx)
            finally:
                # A gate that failed, or no verdict at all, has a result too.
                if _RESULT in ctx.meta:
                    about = {"command": ctx.info_name, "version": __version__}
                    text = json.dumps(about | ctx.meta[_RESULT], indent=2, allow_nan=False)
                    click.echo(text, file=out)


@contextlib.contextmanager
def output_to_errors() -> Iterator[TextIO]:
    """Yield the standard output, and let what others write to it go to the error stream.

    Others are Python, and what writes to descriptor 1 past it: C, and processes that it starts.
    """
    try:
        sys.stdout.flush()
        kept = os.dup(1)
    except OSError:  # It is closed.
        yield sys.stdout
        return
    try:
        own = sys.stdout.fileno() == 1
    except (OSError, ValueError):
        own = False
    coding = {"encoding": sys.stdout.encoding, "errors": sys.stdout.errors}
    out = os.fdopen(os.dup(1), "w", **coding) if own else sys.stdout
    try:
        with contextlib.suppress(OSError):
            os.dup2(2, 1)
        with contextlib.redirect_stdout(sys.stderr):
            yield out
    finally:
        # What C has buffered would come out at its end, after the result.
        with contextlib.suppress(AttributeError, OSError, TypeError):
            ctypes.CDLL(None).fflush(None)
        os.dup2(kept, 1)
        os.close(kept)
        if own:
            # A library may print something more while the process ends.
            atexit.register(os.dup2, 2, 1)
            with contextlib.suppress(OSError):
                out.close()


def say(text: object, *, err: bool = False) -> None:
    """Print a text for people; characters that control a terminal are escaped."""
    from verifai_jax.core.messages.text import printable

    click.echo(printable(str(text)), err=err)


command = functools.partial(click.command, cls=ReportingCommand)
"""Decorator of a sub-command."""


def give_result(**values: object) -> None:
    """Set entries of the present command's result, of types that `as_plain` supports."""
    context = click.get_current_context(silent=True)
    if context is not None:
        context.meta.setdefault(_RESULT, {}).update({n: as_plain(v) for n, v in values.items()})


def show_result(found: Any, plot: Path | None, *names: str) -> None:
    """Print a result, set it as plain data, and draw it into a file if one is named.

    **Arguments:**
    - `plot`: the file of its picture, whose folder is made; None for no picture.
    - `names`: attributes to include; by default all fields in its `repr`.
    """
    say(found)
    give_result(**({name: getattr(found, name) for name in names} or as_plain(found)))
    if plot is not None:
        draw(found, plot)


def draw(found: Any, path: Path) -> None:
    """Draw a result into a file, whose folder is made, and print the path."""
    found.plot(path)
    click.echo(f"  picture      {path}")


def as_plain(value: object) -> Any:
    """Convert a value to JSON types: tables to lists of rows, dataclasses to objects.

    Fields of a dataclass that are not part of its `repr` and values without a plain form are left
    out.
    """
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return {str(name): as_plain(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [as_plain(entry) for entry in value]
    if is_dataclass(value) and not isinstance(value, type):
        shown = {field.name: getattr(value, field.name) for field in fields(value) if field.repr}
        return {name: as_plain(entry) for name, entry in shown.items() if _has_form(entry)}
    other: Any = value
    if hasattr(other, "to_dict"):
        # A table has its rows, and a row its entries.
        is_table = hasattr(other, "columns")
        return as_plain(other.reset_index().to_dict("records") if is_table else other.to_dict())
    return as_plain(other.tolist()) if hasattr(other, "tolist") else str(other)


def _has_form(value: object) -> bool:
    simple = isinstance(value, bool | int | str | float | Path | Mapping | list | tuple | None)
    return simple or is_dataclass(value) or hasattr(value, "tolist") or hasattr(value, "to_dict")


def describe_run(run: Any) -> dict[str, Any]:
    """Return the findings of a run as plain data; None for numbers of a table that was changed."""
    counts, rate = run.table.counts, run.failure_rate
    best, known = None, not run.table.changed
    if known and counts.without_verdict < run.simulations:
        row = run.best
        best = {"row": int(row.name), "robustness": float(row["rho"])}
        best |= {"features": {name: row[name] for name in run.table.features}}
        best |= {"violated": bool(row["violated"]), "verdict": row.get("verdict", "")}
    counted = {
        "violating": counts.violating,
        "counterexamples": counts.claimed,
        "refused": counts.refused,
        "not_replayed": counts.not_replayed,
        "verdicts": run.verdict_counts,
        "repetitions": asdict(counts.repetitions),
        "without_verdict": counts.without_verdict,
    }
    times = [f"{part}_seconds" for part in ("compile", "run", "search", "simulate", "confirm")]
    return {
        "problem": run.name,
        **{name: getattr(run, name) for name in ("target", "formulas", "simulations")},
        **(counted if known else dict.fromkeys(counted)),
        "failure_rate": rate,
        "worst": best,
        **{name: getattr(run, name) for name in ("search", "seed", "stopped", *times, "folder")},
        "table": run.table_path,
        "notes": run.notes,
        "damage": run.damage,
        **run._more_findings(),
    }
