"""`verifai-jax confirm runs/balance-1`: counterexamples replayed at a finer step."""

from pathlib import Path

import click

from verifai_jax.cli.arguments import PROBLEM, ROW, RUN, load_run


@click.command()
@RUN
@ROW
@PROBLEM
@click.option("--simulator", help="Another backend of the system that has to agree.")
@click.option("--fail", is_flag=True, help="Exit with 1 if any is not confirmed.")
def confirm(
    folder: Path, row: int | None, target: str | None, simulator: str | None, fail: bool
) -> None:
    """Replay the counterexamples of the run in RUN, or its ROW, at a finer step."""
    from verifai_jax import counterexamples

    run = load_run(folder, target)
    result = counterexamples.confirm(run, row, simulator=simulator)
    click.echo(str(result))
    if isinstance(result, counterexamples.Confirmation):
        all_confirmed = result.confirmed
    else:
        all_confirmed = len(result.confirmed) == len(result)
    if fail and not all_confirmed:
        raise SystemExit(1)
