"""`verifai-jax shrink runs/balance-1`: the least departure from nominal that still fails."""

from pathlib import Path
from typing import Literal

import click

from verifai_jax.cli.arguments import (
    EVEN_IF_CHANGED,
    FOLDER,
    PICTURES,
    PROBLEM,
    ROW,
    RUN,
    SEED,
    load_judged_run,
)
from verifai_jax.cli.exit_codes import check_again
from verifai_jax.cli.json_output import command, give_result


@command()
@RUN
@ROW
@PROBLEM
@click.option(
    "--by",
    type=click.Choice(["count", "distance"]),
    default="count",
    show_default=True,
    help="Fewest features first, or least distance first.",
)
@click.option("--budget", type=int, default=2000, show_default=True, help="Simulations at most.")
@SEED
@click.option(
    "--others/--no-others",
    default=True,
    show_default=True,
    help="Start from other counterexamples of the run too.",
)
@EVEN_IF_CHANGED
@FOLDER
@PICTURES
def shrink(
    folder: Path,
    row: int | None,
    target: str | None,
    by: Literal["count", "distance"],
    budget: int,
    seed: int,
    others: bool,
    even_if_changed: bool,
    into: Path | None,
    pictures: bool,
) -> None:
    """Make a ROW (by default the worst) of the run in RUN small: few features, near nominal."""
    from verifai_jax import counterexamples
    from verifai_jax.core.text import printable

    run = load_judged_run(folder, target)
    small = counterexamples.shrink(run, row, by=by, budget=budget, seed=seed, others=others)
    click.echo(printable(str(small)))
    give_result(
        row=small.row,
        features=small.features,
        robustness=small.rho,
        changed=small.changed,
        count=small.count,
        distance=small.distance,
        simulations=small.simulations,
        model_changed=small.model_changed,
        finding=small.finding,
    )
    if pictures:
        path = (into or folder) / f"shrunk-{small.row}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        small.plot(path)
        click.echo(f"  picture      {path}")
    check_again(small.finding, even_if_changed)
