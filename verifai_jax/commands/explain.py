"""`verifai-jax explain`: which predicate breaks, when, and which features matter."""

from pathlib import Path

import click


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

    from verifai_jax import counterexample
    from verifai_jax.cli import _recorded_target
    from verifai_jax.run import load
    from verifai_jax.targets import load_target

    run = load(folder, load_target(target or _recorded_target(folder)))
    why = counterexample.explain(run, row)
    click.echo(textwrap.fill(str(why), 88, break_on_hyphens=False))
    if pictures:
        path = (out or folder) / f"why-{why.row}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        why.plot(path)
        click.echo(f"picture {path}")
