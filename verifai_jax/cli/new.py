"""`verifai-jax new my_project`: a small working project as a starting point."""

import contextlib
import json
from importlib import metadata, resources
from pathlib import Path

import click

from verifai_jax.cli.arguments import PATH
from verifai_jax.cli.json_output import command, give_result, say
from verifai_jax.core.store.atomic_files import replacing

FILES = ("README.md", "pendulum.py", "spec.py", "test_spec.py", ".gitignore")
"""Files of a new project; the text of each ends with .txt, and begins with no dot."""


@command()
@click.argument("folder", metavar="FOLDER", type=PATH)
def new(folder: Path) -> None:
    """Write a small project into FOLDER: a system, a specification, and tests of it."""
    there = sorted(name for name in FILES if (folder / name).exists())
    if there:
        raise click.UsageError(
            f"{folder} has {', '.join(there)} already, which would be written over; "
            "give a folder that does not exist yet"
        )
    if folder.exists() and not folder.is_dir():
        raise click.UsageError(f"{folder} is a file; give a folder that does not exist yet")
    templates = resources.files("verifai_jax.cli").joinpath("new_project")
    for name in FILES:
        text = templates.joinpath(f"{name.lstrip('.')}.txt").read_text(encoding="utf-8")
        text = text.replace("$name", folder.resolve().name).replace("$package", _package())
        with replacing(folder / name) as partial:
            partial.write_text(text, encoding="utf-8")
    give_result(folder=folder, files=list(FILES))
    say(f"  written      {folder}")
    say(f"  next         cd {folder} && verifai-jax falsify spec.py:upright")


def _package() -> str:
    """Return what pip installs this package from: what this installation was made of.

    Only a package that came from an index is found there by its name.
    """
    origin: dict[str, object] = {}
    with contextlib.suppress(metadata.PackageNotFoundError, ValueError, TypeError):
        text = metadata.distribution("verifai_jax").read_text("direct_url.json")
        origin = json.loads(text or "{}")
    url = origin.get("url")
    if not url:
        checkout = Path(__file__).resolve().parents[2]
        return f"'{checkout}'" if (checkout / "pyproject.toml").exists() else "verifai_jax"
    version = origin.get("vcs_info")
    if isinstance(version, dict):
        url = f"{version['vcs']}+{url}@{version['commit_id']}"
    return f"'verifai_jax @ {url}'"
