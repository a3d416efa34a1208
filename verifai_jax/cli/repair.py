"""`verifai-jax repair specs/tuning.py:gains --parameters k_x,k_theta`."""

from pathlib import Path
from typing import Any

import click

from verifai_jax.cli.arguments import CHOOSING, plain_values


@click.command()
@click.argument("target")
@click.option(
    "--parameters", required=True, metavar="NAMES", help="Features to change, comma-separated."
)
@click.option(
    "--nominal",
    "values",
    multiple=True,
    metavar="NAME=VALUE",
    help="Where a parameter starts  [default: the problem's nominal value]",
)
@click.option("--run", "folder", type=click.Path(path_type=Path), help="Run with counterexamples.")
@click.option("--budget", type=int, default=20_000, show_default=True, help="Simulations at most.")
@CHOOSING
@click.option("--out", type=click.Path(path_type=Path), help="PNG file for a picture.")
def repair(
    target: str,
    parameters: str,
    values: tuple[str, ...],
    folder: Path | None,
    budget: int,
    out: Path | None,
    **choosing: Any,
) -> None:
    """Change parameters of TARGET (specs/FILE.py:NAME) as little as removes its failures."""
    from verifai_jax.core.targets import load_target
    from verifai_jax.falsification.run import load
    from verifai_jax.synthesis import repair as run_repair

    problem = load_target(target)
    found = run_repair(
        problem if folder is None else load(folder, problem),
        parameters,
        budget,
        nominal=plain_values("--nominal", values) or None,
        **choosing,
    )
    click.echo(str(found))
    if out is not None:
        found.plot(out)
        click.echo(f"  picture      {out}")
