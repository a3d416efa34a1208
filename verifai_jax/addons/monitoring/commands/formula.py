"""`verifai-jax lint requirements.toml brakes.toml logs/`: checks for mistakes in formulas."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

import verifai_jax as vj
from verifai_jax.addons.monitoring.commands.monitor_fleet import load_requirements
from verifai_jax.cli import arguments
from verifai_jax.cli.arguments import PATH, option
from verifai_jax.cli.gates import Gate, check_gate, fail_on
from verifai_jax.cli.json_output import command, give_result, say, show_result
from verifai_jax.core.store.foreign_files import open_file

if TYPE_CHECKING:
    from verifai_jax.addons.monitoring import Requirement
End = Literal["hold", "truncate"]
FILES = click.argument("recordings", metavar="[RECORDING]...", nargs=-1, type=PATH)
"""Recordings: files, or folders of them."""
NAMES = arguments.all_of(
    option("--const", "constants", multiple=True, metavar="NAME=NUMBER"),
    option("--define", "definitions", multiple=True, metavar="NAME=FORMULA"),
)
"""Names that a formula may use."""
ASKED = arguments.all_of(
    option("--problem", metavar="FILE.py:NAME", help="A problem, instead of recordings."),
    option(
        "--end",
        type=click.Choice(["hold", "truncate"]),
        default="hold",
        help="How a trace continues after the last sample.",
    ),
    NAMES,
)
"""Where signals are from besides recordings, and the names that a formula may use."""


@click.group()
def formula() -> None:
    """Check formulas for mistakes, and find formulas to start from."""


@command()
@click.argument("files", metavar="FILE...", nargs=-1, required=True)
@option("--on", "recordings", multiple=True, type=PATH, help="A recording, or a folder of them.")
@option("--unit", "units", multiple=True, metavar="SIGNAL=UNIT", help="Unit of a signal.")
@ASKED
@fail_on(finding="if anything is suspicious")
def lint(
    files: tuple[str, ...], recordings: tuple[Path, ...], units: tuple[str, ...],
    problem: str | None, end: End, constants: tuple[str, ...], definitions: tuple[str, ...],
    fail_on: Gate | None,
) -> None:  # fmt: skip
    """Find requirements of all FILEs (or formulas) that contradict, repeat or imply each other, and
    what is suspicious about each: parts that never hold, are never near, or have no effect, units
    that do not go together, windows beyond the recordings. What is neither a formula nor a file of
    requirements is a recording, as after --on.
    """
    names = read_names(constants, definitions)
    found: dict[str, Requirement] = {}
    for file in files:
        path = Path(file)
        if path.exists() and not _has_requirements(path):
            recordings = (*recordings, path)
            continue
        for each in load_requirements(file, *names):
            name = each.id if each.id not in found else f"{each.id} ({file})"
            while name in found:
                name += "'"
            found[name] = dataclasses.replace(each, id=name)
    named = dict(arguments.split_pairs("--unit", units))
    signals = _signals(recordings, problem)
    result = vj.mtl.lint(list(found.values()), signals, units=named, end=end)
    show_result(result, None, "recordings", "unread", "not_searched")
    give_result(findings=[finding._asdict() for finding in result])
    check_gate(fail_on, {"finding": bool(result)})


def _has_requirements(path: Path) -> bool:
    """Return whether a file has requirements; a table has, if one of its columns has formulas."""
    from verifai_jax.addons.monitoring.requirement_files import ENDINGS

    if path.suffix.lower() != ".csv":
        return path.suffix.lower() in ENDINGS
    with open_file(path) as file:
        return b"formula" in file.readline(1 << 16).lower()


@command()
@click.argument("formula")
@FILES
@ASKED
@arguments.SEED
@fail_on(survivor="if a mutant survives")
def mutants(
    formula: str, recordings: tuple[Path, ...], problem: str | None, end: End,
    constants: tuple[str, ...], definitions: tuple[str, ...], seed: int, fail_on: Gate | None,
) -> None:  # fmt: skip
    """Change FORMULA in one point at a time, and see which changes no recording notices."""
    parsed = _parsed(formula, constants, definitions)
    found = vj.mtl.mutants(parsed, _signals(recordings, problem), end=end, seed=seed)
    show_result(found, None, "recordings", "table")
    check_gate(fail_on, {"survivor": bool(found.surviving)})


@command()
@click.argument("one")
@click.argument("other")
@FILES
@ASKED
@option("--budget", default=2000, help="Maximum simulations of a problem.")
@arguments.SEED
@arguments.PLOT
@fail_on(apart="if a trace tells the formulas apart")
def distinguish(
    one: str, other: str, recordings: tuple[Path, ...], problem: str | None,
    constants: tuple[str, ...], definitions: tuple[str, ...], plot: Path | None,
    fail_on: Gate | None, **options: Any,
) -> None:  # fmt: skip
    """Find a trace on which one of the formulas ONE and OTHER holds, and the other does not."""
    first, second = (_parsed(text, constants, definitions) for text in (one, other))
    found = vj.mtl.distinguish(first, second, _signals(recordings, problem), **options)
    show_result(found, plot if found else None, "source", "holds", "robustness", "tried")
    check_gate(fail_on, {"apart": bool(found)})


@command()
@click.argument("formula")
@FILES
@ASKED
@option("--dt", type=float, help="Sampling period of the traces in seconds.")
@option("--duration", type=float, help="Duration of the traces in seconds.")
@arguments.SEED
@arguments.PLOT
def examples(
    formula: str, recordings: tuple[Path, ...], problem: str | None, constants: tuple[str, ...],
    definitions: tuple[str, ...], plot: Path | None, **options: Any,
) -> None:  # fmt: skip
    """Find a trace that satisfies FORMULA, one that barely does, and one that breaks it.

    Their signals move in the range of the recordings, if any are given.
    """
    parsed = _parsed(formula, constants, definitions)
    found = vj.mtl.examples(parsed, _signals(recordings, problem), **options)
    show_result(found, plot, "robustness")


@command()
@click.argument("words", nargs=-1)
@option("--domain", help="Domain, such as driving, flight, medical or power.")
def templates(words: tuple[str, ...], domain: str | None) -> None:
    """Print the requirements of the library that have all WORDS, with their sources and units."""
    found = vj.mtl.templates(" ".join(words), domain)
    say("\n\n".join(map(str, found)) or "no template has all of these words")
    give_result(templates=found)


for _command in (lint, mutants, distinguish, examples, templates):
    formula.add_command(_command)


def _parsed(text: str, constants: tuple[str, ...], definitions: tuple[str, ...]) -> "vj.Formula":
    return vj.mtl.parse(text, *read_names(constants, definitions))


def _signals(recordings: tuple[Path, ...], problem: str | None) -> Any:
    """Return the source of signals: recordings, a problem, or neither."""
    if problem is not None:
        if recordings:
            raise click.UsageError("give either recordings or --problem, and not both")
        return arguments.load_problem(problem)
    return recordings or None


def read_names(
    constants: tuple[str, ...], definitions: tuple[str, ...]
) -> tuple[dict[str, float], dict[str, str]]:
    """Read the constants and the definitions of `NAMES`; a usage error names a wrong entry."""
    numbers = {}
    for name, value in arguments.split_pairs("--const", constants):
        try:
            numbers[name] = float(value)
        except ValueError:
            raise click.UsageError(f"--const {name} must be a number; got {value!r}") from None
    return numbers, dict(arguments.split_pairs("--define", definitions))
