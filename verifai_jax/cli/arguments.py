"""Arguments and options shared by several commands, and the parsing of their texts."""

import contextlib
import json
import shlex
import warnings
from collections.abc import Callable, Container, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.core import ParameterSource

import verifai_jax as vj
from verifai_jax.cli.exit_codes import BROKEN, CommandError
from verifai_jax.cli.json_output import say

if TYPE_CHECKING:
    from verifai_jax.core.compute.executors import Executor
    from verifai_jax.statistics.stopping import StoppingRule
Command = TypeVar("Command", bound=Callable[..., object])
COMMON = ("as_json", "pictures", "progress", "keep_going")
"""Options for output and resumption, which do not affect the result of a command."""
PATH = click.Path(path_type=Path)
"""A file or a folder, which need not exist."""


def option(*names: str, **settings: Any) -> Callable[[Command], Command]:
    """Return an option of a command; its help shows the default if there is one."""
    return click.option(*names, show_default=settings.get("default") is not None, **settings)


RUN = click.argument("folder", metavar="RUN", type=PATH)
"""The run folder that a command reads."""
ROW = click.argument("row", type=int, required=False)
"""A row of its table."""
TARGET = click.argument("target")
"""The problem, as FILE.py:NAME."""
PROBLEM = option(
    "--problem", "target", metavar="FILE.py:NAME",
    help="Problem of the run  [default: the one it records]",
)  # fmt: skip
FOLDER = option("--folder", "into", type=PATH, help="Folder to write to  [default: the run's]")
RUN_FOLDER = option(
    "--folder", type=PATH, help="Run folder to write  [default: runs/NAME-1, -2, ...]"
)
PICTURES = option("--pictures/--no-pictures", default=True, help="Draw pictures.")
KEEP_GOING = option(
    "--keep-going", is_flag=True, help="Simulate on even if all of the first simulations raise."
)
PROGRESS = click.option(
    "--progress/--no-progress", default=None, help="Show a progress bar  [default: on a terminal]"
)
SEED = option("--seed", default=0, help="Seed of all random numbers.")
ONLY = option(
    "--only", metavar="NAMES",
    help="Features to vary, comma-separated; the others keep their nominal values.",
)  # fmt: skip
BATCH = option("--batch", type=int, help="Simulations per call  [default: chosen]")
MAX_SECONDS = option("--max-seconds", type=float, help="Maximum seconds, including compilation.")
STOP_AFTER = option("--stop-after", type=int, help="Stop at this many counterexamples.")
PRECISION = option("--precision", type=click.Choice(["float32", "float64"]), default="float32")
BACKEND = option("--backend", help="mjx or native, for a MuJoCo model  [default: the faster one]")
ENGINE = option(
    "--engine", type=click.Choice(["auto", "xla", "native"]), default="auto",
    help="native: code by this machine's C++ compiler, auto: for many simulations.",
)  # fmt: skip
CLUSTER = option(
    "--cluster", metavar="ADDRESS",
    help="Simulate on a cluster: dask://HOST:PORT, ray://HOST:PORT or slurm.",
)  # fmt: skip
PLOT = option("--plot", type=PATH, metavar="PNG", help="Draw the result into a PNG.")
PROVED = option(
    "--proved", type=PATH, metavar="JSON",
    help="Result of verify --into: simulate nothing that it proved.",
)  # fmt: skip
REPORT = option(
    "--report", type=PATH, metavar="HTML", help="Write the evidence report into an HTML file."
)
ODD = option(
    "--odd", type=PATH, metavar="YAML",
    help="Operational design domain, an OpenODD file: report how much of it is covered.",
)  # fmt: skip
EVEN_IF_CHANGED = option(
    "--even-if-changed", is_flag=True,
    help="Accept that the model was changed, and note the differences.",
)  # fmt: skip
SET = option("--set", "options", multiple=True, metavar="NAME=VALUE", help="Option of the search.")


def all_of(*decorators: Callable[[Any], Any]) -> Callable[[Command], Command]:
    """Return one decorator that gives a command several options, the first on top of its help."""

    def decorate(command: Command) -> Command:
        for decorator in reversed(decorators):
            command = decorator(command)
        return command

    return decorate


@contextlib.contextmanager
def on_cluster(address: str | None) -> "Iterator[Executor | None]":
    """Connect to the cluster at an address, if one is given."""
    if address is None:
        yield None
        return
    from verifai_jax.core.display.extensions import verb

    try:
        held = contextlib.ExitStack()
        executor = held.enter_context(verb("cluster")(address))
    except OSError as error:
        raise CommandError(str(error), BROKEN) from error
    with held:
        yield executor


def load_problem(target: str, only: str | None = None) -> "vj.Problem":
    """Load the problem FILE.py:NAME, with only some of its features varied."""
    from verifai_jax.core.user_code.targets import load_target

    problem = replace(load_target(target, vj.Problem), target=target)
    return problem if only is None else problem.only(*split_names(only))


def values_of(
    options: Mapping[str, Any], when: "StoppingRule | None" = None,
    executor: "Executor | None" = None,
) -> dict[str, Any]:  # fmt: skip
    """Return the options of a command as arguments of its verb, with the values that join some."""
    left = dict(options)
    if "aim" in left:
        aim = ("margin", "attack", "mass", "held_out")
        left["aim"] = vj.Aim(left["aim"], **{name: left.pop(name) for name in aim})
    after, seconds = left.pop("stop_after", None), left.pop("max_seconds", None)
    stop = vj.Stop(after, seconds, when, left.pop("keep_going", False))
    where = vj.RunOn(left.pop("engine", None), left.pop("backend", None), executor)
    return {**left, "stop": stop, "run_on": where}


def load_judged_run(folder: Path, target: str | None) -> "vj.Run":
    """Load the run in a folder like `load_run`; if it has no verdict, end the command."""
    run = load_run(folder, target)
    if len(run.table.failed) == run.simulations:
        raise CommandError(
            f"no simulation of the run in {folder} had a verdict, of {run.simulations:,}; "
            f"verifai-jax replay {shlex.quote(str(folder))} ROW repeats one",
            BROKEN,
        )
    return run


def load_run(folder: Path, target: str | None) -> "vj.Run":
    """Load the run in a folder, with the named problem, or else the one that it records."""
    return read_run(folder, load_problem(target or recorded_target(folder)))


def read_run(folder: Path, problem: "vj.Problem | None" = None) -> "vj.Run":
    """Read the run in a folder; without one, the error describes the folder."""
    read_record(folder)
    run = vj.load(folder, problem)
    if run.table.damage:
        # Once, in place of a warning from each part that reads the table.
        warnings.filterwarnings("ignore", "the error table is damaged", UserWarning)
        say(f"note: {run.table.damage}", err=True)
    return run


def recorded_target(folder: Path, remedy: str = "--problem specs/FILE.py:NAME") -> str:
    """Return the target that a run records, if it is a file of the user's own project."""
    from verifai_jax.core.user_code.targets import target_of_project

    target = read_record(folder).get("target")
    return target_of_project(target, folder, kind="problem", remedy=remedy)


def read_record(folder: Path) -> dict[str, Any]:
    """Read the record of the run in a folder; without one, the error describes the folder.

    **Raises:** the errors of `verifai_jax.falsification.run_folder.read_record`.
    """
    from verifai_jax.falsification import run_folder

    try:
        return run_folder.read_record(folder)
    except FileNotFoundError as missing:
        raise FileNotFoundError(_describe_folder(folder, run_folder.RECORD, str(missing))) from None


def _describe_folder(folder: Path, record: str, missing: str) -> str:
    """Describe a folder without a run; `missing` is true if only its record is missing."""
    if folder.is_file():
        return f"no run in {folder}: it is a file; give the folder that verifai-jax falsify wrote"
    if not folder.exists():
        parent = folder.parent
        runs = sorted(path.name for path in parent.glob("*") if (path / record).is_file())
        there = f"; in {parent} there are {', '.join(runs)}" if runs else ""
        return f"no run in {folder}: there is no such folder{there}"
    if is_sweep(folder):
        again = resuming("sweep", folder, None, {})
        return f"no run in {folder}: it is the folder of a sweep; {again} goes on with it"
    runs = sorted(path.name for path in folder.glob("*") if (path / record).is_file())
    if runs:
        return f"{missing}; but its folders {', '.join(runs)} are runs"
    return f"{missing}; give a folder that verifai-jax falsify wrote"


def is_sweep(folder: Path) -> bool:
    """Return whether a folder was written by `verifai-jax sweep`."""
    return any((folder / name).is_file() for name in ("sweep.json", "sweep.cache"))


def split_names(text: str) -> list[str]:
    """Split names at commas."""
    return [name.strip() for name in text.split(",")]


def split_pairs(option: str, texts: tuple[str, ...]) -> list[tuple[str, str]]:
    """Split each NAME=VALUE of a repeated option; a usage error names a wrong one."""
    pairs = []
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name.strip():
            raise click.UsageError(f"{option} needs NAME=VALUE; got {text!r}")
        pairs.append((name.strip(), value.strip()))
    return pairs


def plain_values(option: str, texts: tuple[str, ...]) -> dict[str, Any]:
    """Read each NAME=VALUE of a repeated option; values are parsed as JSON if possible."""
    values: dict[str, Any] = dict(split_pairs(option, texts))
    for name, value in values.items():
        with contextlib.suppress(json.JSONDecodeError):
            values[name] = json.loads(value)
    return values


def refuse_others(allowed: Container[str], why: str) -> None:
    """Raise a usage error for an option that was given but is not allowed here.

    **Arguments:**
    - `allowed`: names of allowed parameters, in addition to those of every command.
    - `why`: the end of the message, after the option.
    """
    context = click.get_current_context()
    for option in context.command.params:
        name = option.name or ""
        if name in allowed or name in COMMON or not isinstance(option, click.Option):
            continue
        if context.get_parameter_source(name) is not ParameterSource.DEFAULT:
            raise click.UsageError(f"{option.opts[0]} {why}")


def target_apart(folder: Path, target: str | None) -> str | None:
    """Return the target of a run, if the folder alone does not identify it for a command."""
    from verifai_jax.core.user_code.targets import TargetError, target_of_project

    if target is None:
        return None
    try:
        target_of_project(target, folder, kind="problem", remedy="")
    except TargetError:
        return target
    return None


def resuming(command: str, folder: Path, target: str | None, options: Mapping[str, object]) -> str:
    """Return the command that resumes a folder, in shell syntax.

    The recorded target is included if the record alone does not suffice. Of the `options`, which
    the record does not hold, those that are None are left out.
    """
    apart = target_apart(folder, target)
    words = ["verifai-jax", command, *([] if apart is None else [apart]), "--resume", str(folder)]
    for option, value in options.items():
        words += [] if value is None else [option, str(value)]
    return shlex.join(words)
