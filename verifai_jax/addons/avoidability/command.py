"""`verifai-jax last-chance runs/balance-1 417`: until when the failure could have been avoided."""

from pathlib import Path
from typing import Any

from verifai_jax.cli import arguments
from verifai_jax.cli.arguments import option
from verifai_jax.cli.exit_codes import check_again
from verifai_jax.cli.json_output import command, draw, give_result, say

GIVEN = ("row", "by", "failed", "avoidable_until", "no_escape_from", "proved_from", "simulations")
"""Fields of the result that are written as JSON."""


@command()
@arguments.RUN
@arguments.ROW
@arguments.PROBLEM
@arguments.EVEN_IF_CHANGED
@option("--by", default="controller", help="controller or environment.")
@option("--actions", nargs=2, type=float, metavar="LOW HIGH", help="Lowest and highest action.")
@option("--forks", default=2048, help="Simulations at once.")
@option("--rounds", default=12, help="Batches for each refinement of the bracket.")
@arguments.SEED
@arguments.FOLDER
@arguments.PICTURES
def last_chance(
    folder: Path, row: int | None, target: str | None, even_if_changed: bool, into: Path | None,
    pictures: bool, **options: Any,
) -> None:  # fmt: skip
    """Find until when the failure of a ROW (by default the worst) of RUN could be avoided."""
    from verifai_jax import last_chance as run

    found = run(arguments.load_judged_run(folder, target), row, **options)
    say(found)
    fields = {name: getattr(found, name) for name in GIVEN}
    give_result(**fields, escape=str(found.escape or ""), text=str(found))
    if pictures:
        draw(found, (into or folder) / f"last-chance-{found.row}.png")
    check_again(found.replay.finding, even_if_changed)
