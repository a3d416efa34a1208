"""`verifai-jax monitor requirements.toml logs/`: many requirements on many recordings."""

import concurrent.futures
import contextlib
import multiprocessing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

import verifai_jax as vj
from verifai_jax.cli.arguments import PATH, option
from verifai_jax.cli.exit_codes import BROKEN, CommandError
from verifai_jax.cli.json_output import give_result, say

if TYPE_CHECKING:
    from verifai_jax.addons.monitoring import Judgement, Requirement
Command = TypeVar("Command", bound=Callable[..., object])


def fleet_options(command: Command) -> Command:
    """Add the options for judging many requirements on many recordings."""
    files = click.Path(path_type=Path, dir_okay=False)
    for each in (
        click.option("--jobs", type=click.IntRange(1), default=1, help="Number of processes."),
        option("--junit", type=files, help="File of the verdicts as JUnit XML."),
        option("--report", type=files, help="HTML file of the report."),
    ):
        command = each(command)
    return command


def reading_options(command: Command) -> Command:
    """Add the options for the stamps of recordings, and for frames of a bus."""
    for each in (
        option("--dbc", multiple=True, type=PATH, help="DBC file for the CAN frames of MDF files."),
        option(
            "--repeated", type=click.Choice(["both", "last"]), default="both",
            help="Which of the samples at one time count.",
        ),
        option("--sort-times", is_flag=True, help="Put rows whose times go back in order."),
        option(
            "--stamps", type=click.Choice(["log", "header"]), default="log",
            help="Times of a bag's messages: the log's, or those in their headers.",
        ),
    ):  # fmt: skip
        command = each(command)
    return command


def read_missing(context: object, option: object, texts: Sequence[str]) -> list[Any] | None:
    """Return the ways to treat gaps and the numbers that stand for one; None for none."""
    found: list[Any] = []
    for text in texts:
        try:
            found.append(text if text in WAYS else float(text))
        except ValueError:
            raise click.BadParameter(
                f"{text!r} is none of {', '.join(WAYS)}, and no number"
            ) from None
    return found or None


WAYS = ("hold", "drop", "interpolate")


def is_fleet(
    formula: str, recordings: Sequence[Path], report: Path | None, junit: Path | None
) -> bool:
    """Return whether a command line has several requirements or recordings."""
    several = len(recordings) > 1 or recordings[0].is_dir()
    return several or _is_file(formula) or report is not None or junit is not None


def monitor_fleet(
    formula: str, recordings: Sequence[Path], constants: Mapping[str, float],
    definitions: Mapping[str, str], report: Path | None, junit: Path | None, jobs: int,
    options: Mapping[str, Any],
) -> "Judgement":  # fmt: skip
    """Judge one formula or a file of requirements on recordings; print the findings.

    **Arguments:**
    - `jobs`: number of processes that judge; more than one are started for this.
    - `options`: the options of `judge` for reading recordings.
    **Raises:** `CommandError` if nothing has a verdict.
    """
    requirements = load_requirements(formula, constants, definitions)
    with contextlib.ExitStack() as stack:
        executor = None
        if jobs > 1:
            spawned = multiprocessing.get_context("spawn")
            pool = concurrent.futures.ProcessPoolExecutor(jobs, mp_context=spawned)
            executor = stack.enter_context(pool)
        found = vj.mtl.judge(
            requirements, recordings, run_on=vj.RunOn(executor=executor), **options
        )
    say(found)
    for name, path, write in (("report", report, found.report), ("junit", junit, found.junit)):
        if path is not None:
            say(f"{name} {write(path)}")
    counts = {"failing": len(found.failing), "depending": len(found.depending)}
    give_result(**counts, without_verdict=len(found.without_verdict))
    give_result(verdicts=[row._asdict() for row in found.rows])
    if len(found.without_verdict) == len(found.rows):
        raise CommandError("no requirement had a verdict on any recording", BROKEN)
    return found


def load_requirements(
    formula: str, constants: Mapping[str, float], definitions: Mapping[str, str]
) -> "Sequence[Requirement]":
    """Return the requirements of a file, or one formula as a requirement."""
    if _is_file(formula):
        return vj.mtl.read_requirements(formula, constants, definitions)
    return [vj.mtl.Requirement("formula", vj.mtl.parse(formula, constants, definitions))]


def _is_file(formula: str) -> bool:
    """Return whether an argument names a file of requirements, whether or not it can be read."""
    from verifai_jax.addons.monitoring.requirement_files import ENDINGS

    return Path(formula).suffix.lower() in ENDINGS
