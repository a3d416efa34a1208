"""`verifai-jax shrink`: the least departure from nominal that still fails."""

from pathlib import Path

import click

from verifai_jax.cli.arguments import recorded_run


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.argument("row", type=int, required=False)
@click.option("--problem", "target", help="FILE.py:NAME of the problem [the one recorded].")
@click.option(
    "--by",
    type=click.Choice(["few", "small"]),
    default="few",
    show_default=True,
    help="Fewest features first, or least distance first.",
)
@click.option("--budget", type=int, default=2000, show_default=True, help="Simulations at most.")
@click.option("--seed", type=int, default=0, show_default=True)
@click.option(
    "--others/--no-others",
    default=True,
    show_default=True,
    help="Whether to go on from other counterexamples of the run too.",
)
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the picture [the run's].")
@click.option("--pictures/--no-pictures", default=True)
def shrink(
    folder: Path,
    row: int | None,
    target: str | None,
    by: str,
    budget: int,
    seed: int,
    others: bool,
    out: Path | None,
    pictures: bool,
) -> None:
    """Make a ROW (by default the worst) of the run in FOLDER small: few features, near nominal."""
    from verifai_jax import counterexamples

    run = recorded_run(folder, target)
    small = counterexamples.shrink(run, row, by=by, budget=budget, seed=seed, others=others)
    click.echo(str(small))
    if pictures:
        path = (out or folder) / f"shrunk-{small.row}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        small.plot(path)
        click.echo(f"  picture      {path}")
