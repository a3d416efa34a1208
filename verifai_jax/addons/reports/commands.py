"""Commands that repeat the results of a report."""

import json
import shlex
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from verifai_jax.falsification.run import Run
from verifai_jax.falsification.run_folder import shown_folder
from verifai_jax.search import named


def run_command(run: Run) -> str | None:
    """Return the command that repeats a run; None if there is none.

    A run of a problem without a file, or a search without a name, is repeated in Python.
    """
    search = run.search_data or {}
    likely = search.get("name") == "likeliest"
    search = search["options"]["search"] if likely else search
    if run.target is None or run.derived or search.get("name") in (None, "diverse"):
        return None
    words = ["verifai-jax", "falsify", run.target, "--search", str(search["name"])]
    words += _options_of_search(str(search["name"]), search.get("options") or {})
    # As many as were made: what ended the run before is no option of a repetition.
    budget = run.budget if run.stopped == "budget" and run.budget else run.simulations
    words += ["--budget", str(budget), "--batch", str(run.batch), "--seed", str(run.seed)]
    words += ["--objective", "likelihood"] if likely else []
    if run.precision != "float32":
        words += ["--precision", run.precision]
    if run.backend is not None:
        words += ["--backend", run.backend]
    if not run.confirm:
        words.append("--no-confirm")
    return shlex.join(words)


def _options_of_search(name: str, options: dict[str, Any]) -> list[str]:
    """Return those options that are not the defaults."""
    default = named(name)
    usual = {each.name: getattr(default, each.name) for each in fields(default)}  # pyright: ignore[reportArgumentType]
    words = []
    for option, value in options.items():
        known = usual.get(option)
        if json.dumps(value) != json.dumps(list(known) if isinstance(known, tuple) else known):
            words += ["--set", f"{option}={json.dumps(value)}"]
    return words


def run_python(run: Run) -> str:
    """Return the lines of Python that repeat a run."""
    how = f"search={run.search!r}" if not run.search_data else f"search=vj.search.{run.search}"
    lines = [
        "import verifai_jax as vj",
        f"# problem: {run.name}" + ("" if run.target is None else f", of {run.target}"),
        f"run = vj.falsify(problem, {how},",
        f"                 budget={run.budget}, batch={run.batch}, seed={run.seed},",
        f"                 precision={run.precision!r}, confirm={run.confirm})",
    ]
    if run.derived:
        verb = run.derived["verb"]
        lines[2:] = [f"run = vj.{verb}(problem, budget={run.budget}, seed={run.seed})"]
    return "\n".join(lines)


def report_command(
    folder: Path, units: Mapping[str, str], reasons: Mapping[str, str], traces: int | None = None,
    studies: bool | None = None, modes: int | None = None,
) -> str:  # fmt: skip
    """Return the command that builds a report from a folder again, including its options."""
    words = ["verifai-jax", "report", shown_folder(folder)]
    for option, texts in (("--unit", units), ("--reason", reasons)):
        for name, text in texts.items():
            words += [option, f"{name}={text}"]
    if traces is not None:
        words += ["--traces", str(traces)]
    if studies is not None:
        words.append("--studies" if studies else "--no-studies")
    if modes is not None:
        words += ["--modes", str(modes)]
    return shlex.join(words)
