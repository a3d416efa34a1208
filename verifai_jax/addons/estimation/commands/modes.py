"""`verifai-jax modes FILE.py:NAME`: every mode of failure, and how probable it is."""

from pathlib import Path
from typing import Any

from verifai_jax.cli import arguments
from verifai_jax.cli.arguments import option
from verifai_jax.cli.going_on import kept_until_done
from verifai_jax.cli.json_output import command, show_result


@command()
@arguments.TARGET
@option("--budget", default=50_000, help="Maximum simulations.")
@option("--confidence", default=0.95)
@option(
    "--min-share",
    default=0.001,
    help="Modes with a smaller share of the failure probability are not listed.",
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
        found = run(problem, **arguments.values_of(options))
        show_result(found, plot)
        kept.stopped(found.stopped)
