"""`verifai-jax synthesize specs/tuning.py:first_order --parameters k`."""

from pathlib import Path
from typing import Any

import click

from verifai_jax.cli.arguments import CHOOSING


@click.command()
@click.argument("target")
@click.option(
    "--parameters", metavar="NAMES", help="Features to choose, comma-separated  [default: all]"
)
@click.option("--budget", type=int, default=10_000, show_default=True, help="Simulations at most.")
@CHOOSING
@click.option("--out", type=click.Path(path_type=Path), help="CSV file for the candidates.")
def synthesize(
    target: str,
    parameters: str | None,
    budget: int,
    out: Path | None,
    **choosing: Any,
) -> None:
    """Find parameters for which TARGET (specs/FILE.py:NAME) holds, whatever its other features."""
    from verifai_jax.core.targets import load_target
    from verifai_jax.synthesis import synthesize as run_synthesize

    found = run_synthesize(
        load_target(target),
        parameters,
        budget,
        **choosing,
    )
    click.echo(str(found))
    if out is not None:
        found.candidates.to_csv(out, index=False)
        click.echo(f"  candidates   {out}")
