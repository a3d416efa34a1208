"""`verifai-jax list specs`: the problems and studies there are."""

from pathlib import Path

import click


@click.command(name="list")
@click.argument("place", default="specs")
def list_targets(place: str) -> None:
    """List the problems and studies of a file or folder (PLACE, by default specs/)."""
    from verifai_jax.core.errors import MissingExtra
    from verifai_jax.core.targets import TargetError, definitions
    from verifai_jax.problem import Problem
    from verifai_jax.search import names
    from verifai_jax.sweeps.study import Study

    path = Path(place)
    files = sorted(path.glob("[!_]*.py")) if path.is_dir() else [path]
    if not files:
        raise TargetError(f"{place}/ has no Python file with problems")
    for file in files:
        try:
            targets = definitions(str(file), Problem, Study)
        except MissingExtra as error:
            click.echo(f"{file}: {error}")
            continue
        for name, target in targets.items():
            click.echo(f"{file}:{name}  {target.description}")
            varied = ", ".join(target.space.domains)
            if isinstance(target, Study):
                click.echo(f"    a study of training runs, for sweep, over {varied}")
                continue
            for formula in target.formulas.values():
                click.echo(f"    {formula}")
            click.echo(f"    over {varied}")
    for folder in sorted(path.iterdir()) if path.is_dir() else []:
        if any(folder.glob("[!_]*.py")):
            click.echo(f"more in {folder}/: verifai-jax list {folder}")
    click.echo(f"searches: {', '.join(names())}")
