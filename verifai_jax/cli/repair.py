"""`verifai-jax repair specs/tuning.py:gains --parameters k_x,k_theta`."""

from pathlib import Path
from typing import Any

import click

from verifai_jax.cli.arguments import (
    PARAMETER_CHOICE,
    PLOT,
    TARGET,
    load_problem,
    plain_values,
    read_run,
)


@click.command()
@TARGET
@click.option(
    "--parameters", required=True, metavar="NAMES", help="Features to change, comma-separated."
)
@click.option(
    "--nominal",
    "nominal",
    multiple=True,
    metavar="NAME=VALUE",
    help="Value a parameter starts from  [default: the problem's nominal value]",
)
@click.option("--run", "folder", type=click.Path(path_type=Path), help="Run with counterexamples.")
@click.option("--budget", type=int, default=20_000, show_default=True, help="Simulations at most.")
@click.option(
    "--estimate",
    type=int,
    help="Simulations for each of the failure probabilities before and after  [default: none]",
)
@PARAMETER_CHOICE
@PLOT
def repair(
    target: str,
    parameters: str,
    nominal: tuple[str, ...],
    folder: Path | None,
    budget: int,
    estimate: int | None,
    plot: Path | None,
    **keywords: Any,
) -> None:
    """Change parameters of TARGET (specs/FILE.py:NAME) as little as removes its failures."""
    from verifai_jax.core.text import printable
    from verifai_jax.synthesis import repair as run_repair

    problem = load_problem(target)
    result = run_repair(
        problem if folder is None else read_run(folder, problem),
        parameters,
        budget,
        nominal=plain_values("--nominal", nominal) or None,
        **keywords,
    )
    click.echo(printable(str(result)))
    if estimate is not None:
        click.echo(printable(str(result.estimate(estimate, seed=result.seed))))
    if plot is not None:
        result.plot(plot)
        click.echo(f"  picture      {plot}")
