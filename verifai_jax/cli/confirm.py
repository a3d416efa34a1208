"""`verifai-jax confirm runs/balance-1`: counterexamples replayed at a finer step."""

from pathlib import Path

import click

from verifai_jax.cli.arguments import PROBLEM, ROW, RUN, fail_on, load_judged_run
from verifai_jax.cli.exit_codes import fail_gate


@click.command()
@RUN
@ROW
@PROBLEM
@click.option("--simulator", help="Another backend of the system that has to agree.")
@fail_on("unconfirmed", "if any is not confirmed")
def confirm(
    folder: Path,
    row: int | None,
    target: str | None,
    simulator: str | None,
    fail_on: str | None,
) -> None:
    """Replay the counterexamples of the run in RUN, or its ROW, at a finer step."""
    from verifai_jax import counterexamples
    from verifai_jax.core.text import printable

    run = load_judged_run(folder, target)
    result = counterexamples.confirm(run, row, simulator=simulator)
    click.echo(printable(str(result)))
    if isinstance(result, counterexamples.Confirmation):
        all_confirmed = result.confirmed
    else:
        all_confirmed = len(result.confirmed) == len(result)
    if fail_on is not None and not all_confirmed:
        raise fail_gate()
