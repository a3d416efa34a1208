"""`verifai-jax qualify`: the tool's own oracles, run here."""

from pathlib import Path

import click

from verifai_jax.cli.arguments import PATH, option
from verifai_jax.cli.exit_codes import BROKEN
from verifai_jax.cli.json_output import command, give_result, say


@command()
@option(
    "--folder",
    type=PATH,
    default=Path("qualification"),
    help="Folder for qualification.html and qualification.json.",
)
@option("--only", multiple=True, help="Name of an oracle; may be repeated.")
def qualify(folder: Path, only: tuple[str, ...]) -> None:
    """Run the tool's own oracles on this machine, and write the record to be signed.

    Formulas against definitions, rates against closed forms, gradients against differences, kills,
    replays bit for bit. It ends with code 3 if one falls.
    """
    from verifai_jax import qualify as run

    found = run(only)
    path = found.save(folder)
    say(found)
    say(f"  written      {path}")
    give_result(passed=found.passed, complete=found.complete, outcomes=found.outcomes, report=path)
    if not found.passed:
        raise click.exceptions.Exit(BROKEN)
