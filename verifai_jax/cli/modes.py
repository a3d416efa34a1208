"""`verifai-jax modes FILE.py:NAME`: every mode of failure, and how probable it is."""

from pathlib import Path
from typing import Any

import click

from verifai_jax.cli import arguments
from verifai_jax.cli.going_on import kept_until_done
from verifai_jax.cli.json_output import command, show_result


@command()
@arguments.TARGET
@click.option("--budget", type=int, default=50_000, show_default=True, help="Simulations at most.")
@click.option("--confidence", type=float, default=0.95, show_default=True)
@click.option(
    "--min-share",
    type=float,
    default=0.001,
    show_default=True,
    help="Part of the failure probability below which a mode is not listed.",
)
@arguments.SEED
@arguments.ONLY
@arguments.BATCH
@arguments.MAX_SECONDS
@arguments.PRECISION
@arguments.BACKEND
@arguments.PLOT
def modes(target: str, only: str | None, plot: Path | None, **options: Any) -> None:
    """List the modes of failure of TARGET (FILE.py:NAME), each with its probability."""
    from verifai_jax import modes as run

    problem = arguments.load_problem(target, only)
    with kept_until_done() as kept:
        found = run(problem, **options)
        show_result(found, plot)
        kept.stopped(found.stopped)
