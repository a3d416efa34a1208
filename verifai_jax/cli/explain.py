"""`verifai-jax explain`: which predicate breaks, when, and which features matter."""

from pathlib import Path

import click

from verifai_jax.cli.arguments import recorded_run


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.argument("row", type=int, required=False)
@click.option("--problem", "target", help="FILE.py:NAME of the problem [the one recorded].")
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the picture [the run's].")
@click.option("--pictures/--no-pictures", default=True)
def explain(
    folder: Path, row: int | None, target: str | None, out: Path | None, pictures: bool
) -> None:
    """Say why a ROW (by default the worst) of the run in FOLDER fails, and draw it."""
    import textwrap

    from verifai_jax import counterexamples

    run = recorded_run(folder, target)
    why = counterexamples.explain(run, row)
    click.echo(textwrap.fill(str(why), 88, break_on_hyphens=False))
    if pictures:
        path = (out or folder) / f"why-{why.row}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        why.plot(path)
        click.echo(f"picture {path}")
