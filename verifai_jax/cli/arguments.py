"""What commands are asked for, understood in one place: runs, features, pairs."""

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import click


def recorded_run(folder: Path, target: str | None) -> Any:
    """The run in FOLDER, with its problem: the one recorded, or TARGET."""
    from verifai_jax.core.targets import load_target
    from verifai_jax.falsification.run import load

    return load(folder, load_target(target or recorded_target(folder)))


def recorded_target(folder: Path) -> str:
    """The target in the run's record, if it is a file of the user's own project.

    Loading a target runs its file; a run folder that came from elsewhere must not choose one.
    """
    from verifai_jax.falsification.run import RECORD

    if not (folder / RECORD).exists():
        raise FileNotFoundError(f"no run in {folder}: {RECORD} is missing")
    target = json.loads((folder / RECORD).read_text()).get("target")
    here = Path.cwd().resolve()
    if isinstance(target, str) and ".py" in target:
        file = (here / target.rpartition(":")[0]).resolve()
        if file.is_relative_to(here) and not file.is_relative_to(folder.resolve()):
            return target
    raise ValueError(
        f"{folder} does not say which problem of this project it is of; "
        "give it: --problem specs/FILE.py:NAME"
    )


def only(problem: Any, names: str | None) -> Any:
    """The problem with these features varied alone, comma-separated; all where none is named."""
    return problem if names is None else problem.only(*map(str.strip, names.split(",")))


def pairs(option: str, texts: tuple[str, ...]) -> list[tuple[str, str]]:
    """Names and values of a repeated option."""
    found = []
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name.strip():
            raise click.UsageError(f"{option} needs NAME=VALUE; got {text!r}")
        found.append((name.strip(), value.strip()))
    return found


def plain_values(option: str, texts: tuple[str, ...]) -> dict[str, Any]:
    """The same as plain data: a value is JSON, or the text that it is."""
    values: dict[str, Any] = {}
    for name, value in pairs(option, texts):
        try:
            values[name] = json.loads(value)
        except json.JSONDecodeError:
            values[name] = value
    return values


def together(options: Iterable[Callable[..., Any]]) -> Callable[..., Any]:
    """Options that several commands have, as one decorator."""

    def decorated(command: Any) -> Any:
        for option in reversed(tuple(options)):
            command = option(command)
        return command

    return decorated


CHOOSING = together(
    (
        click.option(
            "--margin", type=float, default=0.0, show_default=True, help="Robustness wanted."
        ),
        click.option(
            "--attack", default="cross_entropy", show_default=True, help="Search that attacks."
        ),
        click.option(
            "--held-out", type=int, default=2000, show_default=True, help="Fresh environments."
        ),
        click.option(
            "--gradient/--no-gradient", default=None, help="[default: where there are gradients]"
        ),
        click.option("--seed", type=int, default=0, show_default=True),
        click.option("--max-seconds", type=float, help="Seconds at most, compilation included."),
        click.option(
            "--backend", help="mjx or native, for a MuJoCo model  [default: the faster one]"
        ),
    )
)
"""How parameters are chosen, by `synthesize` and `repair`: keywords of both."""
