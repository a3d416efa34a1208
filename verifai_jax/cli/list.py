"""`verifai-jax list specs`: the problems and studies there are."""

import shlex
from pathlib import Path
from typing import Any

import click

import verifai_jax as vj
from verifai_jax.cli.exit_codes import WRONG_USAGE
from verifai_jax.cli.json_output import command, give_result, say

TARGETS = "verifai_jax.targets"
"""Entry points of classes whose objects are targets of commands, as problems are."""


@command(name="list")
@click.argument("location", required=False)
def list_targets(location: str | None) -> None:
    """List the problems and studies of a file or folder (PLACE, by default specs/).

    Its Python files are run for that, those of inner folders are not.
    """
    from verifai_jax.core.display.extensions import extension, extensions
    from verifai_jax.core.messages.errors import MissingExtra
    from verifai_jax.core.user_code.targets import NothingDefined, TargetError, definitions
    from verifai_jax.search import names

    studies = [extension(TARGETS, name) for name in extensions(TARGETS)]
    path = Path(location or "specs")
    if location is None and not path.exists():
        raise TargetError(_no_specs())
    files = sorted(path.glob("[!_]*.py")) if path.is_dir() else [path]
    inner = [folder for folder in sorted(path.glob("*/")) if any(folder.glob("[!_]*.py"))]
    broken = shown = 0
    listed: list[dict[str, object]] = []
    for file in files:
        if path.is_dir() and not file.resolve().is_relative_to(path.resolve()):
            say(f"{file} leads out of {path}/, and is not run: list it by its name", err=True)
            continue
        try:
            targets = definitions(str(file), vj.Problem, *studies)
        except MissingExtra as error:
            say(f"{file}: {error}")
            continue
        except TargetError as error:
            if not path.is_dir():
                raise
            if not isinstance(error, NothingDefined):  # A folder may hold other modules too.
                say(error, err=True)
                broken += 1
            continue
        for name, target in targets.items():
            say(f"{file}:{name}  {target.description}")
            _print_target(target)
            listed.append(_describe_target(f"{file}:{name}", target))
            shown += 1
    if path.is_dir() and not (shown or broken or inner):
        raise TargetError(f"{path}/ has no Python file with problems")
    for folder in inner:
        say(f"more in {folder}/: verifai-jax list {shlex.quote(str(folder))}")
    say(f"searches: {', '.join(names())}")
    give_result(targets=listed, searches=names(), broken=broken)
    if broken:
        raise click.exceptions.Exit(WRONG_USAGE)


def _describe_target(name: str, target: "vj.Problem | Any") -> dict[str, object]:
    formulas = getattr(target, "formulas", None)
    return {
        "target": name,
        "kind": "study" if formulas is None else "problem",
        "description": target.description,
        "features": list(target.space.domains),
        "formulas": {key: str(formula) for key, formula in (formulas or {}).items()},
    }


def _print_target(target: "vj.Problem | Any") -> None:
    over = f"over {', '.join(target.space.domains)}"
    formulas = getattr(target, "formulas", None)
    study = [f"a study of training runs, for sweep, {over}"]
    for line in study if formulas is None else [*formulas.values(), over]:
        say(f"    {line}")


def _no_specs() -> str:
    """Write that this folder has no problems, and list its content."""
    files = sorted(file.name for file in Path().glob("[!_]*.py"))
    others = f". Python files here: {', '.join(files)}" if files else ""
    return (
        "there is no folder specs/ here; verifai-jax list FILE.py (or FOLDER) lists the problems "
        f"of a file or folder{others}"
    )
