"""`verifai-jax analyze runs/balance-1`: the report on a run's table."""

from pathlib import Path

import click

from verifai_jax.cli.arguments import FOLDER, PROBLEM, RUN, load_judged_run
from verifai_jax.cli.json_output import command, give_result


@command()
@RUN
@PROBLEM
@FOLDER
def analyze(folder: Path, target: str | None, into: Path | None) -> None:
    """Report rules, importance, kinds of failures and coverage of the run in RUN."""
    analysis = load_judged_run(folder, target).analyze()
    click.echo(str(analysis))
    path = analysis.save((into or folder) / "analysis")
    click.echo(f"  written      {path}")
    give_result(text=str(analysis), report=path)
