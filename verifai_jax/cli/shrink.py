"""`verifai-jax shrink runs/balance-1`: the smallest departure from nominal that still fails."""

from pathlib import Path
from typing import Any

import click

import verifai_jax as vj
from verifai_jax.cli import arguments
from verifai_jax.cli.arguments import option
from verifai_jax.cli.exit_codes import check_again
from verifai_jax.cli.going_on import kept_until_done
from verifai_jax.cli.json_output import command, give_result, show_result


@command()
@arguments.RUN
@arguments.ROW
@arguments.PROBLEM
@option(
    "--by", type=click.Choice(["count", "distance", "likelihood"]), default="count",
    help="Minimise the number of features first, or the distance; or find the likeliest failure.",
)  # fmt: skip
@option("--budget", default=2000, help="Maximum simulations.")
@arguments.SEED
@option(
    "--others/--no-others", default=True, help="Start from other counterexamples of the run too."
)
@arguments.EVEN_IF_CHANGED
@arguments.FOLDER
@arguments.PICTURES
def shrink(
    folder: Path, row: int | None, target: str | None, even_if_changed: bool, into: Path | None,
    pictures: bool, **options: Any,
) -> None:  # fmt: skip
    """Make a ROW (by default the worst) of the run in RUN small: few features, near nominal."""
    run = arguments.load_judged_run(folder, target)
    with kept_until_done() as kept:
        small = vj.shrink(run, row, **options)
        give_result(robustness=small.rho)
        show_result(
            small, (into or folder) / f"shrunk-{small.row}.png" if pictures else None, "row",
            "features", "changed", "count", "distance", "simulations", "model_changed", "finding",
        )  # fmt: skip
        kept.stopped(small.stopped)
    check_again(small.finding, even_if_changed)
