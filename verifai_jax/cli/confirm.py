"""`verifai-jax confirm`: whether the counterexamples of a run are real."""

from pathlib import Path

import click

from verifai_jax.cli.arguments import recorded_run


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.argument("row", type=int, required=False)
@click.option("--problem", "target", help="FILE.py:NAME of the problem [the one recorded].")
@click.option("--simulator", help="Another backend of the system that has to agree.")
@click.option("--fail", is_flag=True, help="Exit with 1 if any is not confirmed.")
def confirm(
    folder: Path, row: int | None, target: str | None, simulator: str | None, fail: bool
) -> None:
    """Replay the counterexamples of the run in FOLDER, or its ROW, at a finer step."""
    from verifai_jax.counterexamples._confirm import Confirmation
    from verifai_jax.counterexamples._confirm import confirm as confirm_run

    run = recorded_run(folder, target)
    found = confirm_run(run, row, simulator=simulator)
    click.echo(str(found))
    sure = (
        found.confirmed if isinstance(found, Confirmation) else len(found.confirmed) == len(found)
    )
    if fail and not sure:
        raise SystemExit(1)
