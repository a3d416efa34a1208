"""`verifai-jax estimate FILE.py:NAME`: how probable a failure is."""

from pathlib import Path
from typing import Literal

import click

from verifai_jax.cli.arguments import (
    BACKEND,
    BATCH,
    MAX_SECONDS,
    ONLY,
    PLOT,
    PRECISION,
    SEED,
    TARGET,
    load_problem,
)


@click.command()
@TARGET
@click.option("--method", help="monte_carlo, importance or splitting  [default: chosen]")
@click.option("--budget", type=int, default=50_000, show_default=True, help="Simulations at most.")
@click.option("--p0", type=float, help="Probability that it should be below.")
@click.option("--confidence", type=float, default=0.95, show_default=True)
@SEED
@ONLY
@BATCH
@MAX_SECONDS
@PRECISION
@BACKEND
@PLOT
def estimate(
    target: str,
    method: str | None,
    budget: int,
    p0: float | None,
    confidence: float,
    seed: int,
    only: str | None,
    batch: int | None,
    max_seconds: float | None,
    precision: Literal["float32", "float64"] | None,
    backend: str | None,
    plot: Path | None,
) -> None:
    """Estimate the probability that TARGET (FILE.py:NAME) fails, with an interval and a bound."""
    from verifai_jax.estimation import estimate as run

    found = run(
        load_problem(target, only),
        method,
        budget,
        batch=batch,
        seed=seed,
        confidence=confidence,
        p0=p0,
        precision=precision or "float32",
        backend=backend,
        max_seconds=max_seconds,
    )
    click.echo(str(found))
    if plot is not None:
        found.plot(plot)
        click.echo(f"  picture      {plot}")
