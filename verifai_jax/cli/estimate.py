"""`verifai-jax estimate FILE.py:NAME`: how probable a failure is."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

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
    fail_on,
    load_problem,
)
from verifai_jax.cli.exit_codes import BROKEN, CommandError, fail_gate

if TYPE_CHECKING:
    from verifai_jax.estimation import Estimate


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
@fail_on("p0", "unless the probability is shown to be below --p0")
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
    fail_on: str | None,
) -> None:
    """Estimate the probability that TARGET (FILE.py:NAME) fails, with an interval and a bound."""
    from verifai_jax.core.text import printable
    from verifai_jax.estimation import estimate as run

    if fail_on is not None and p0 is None:
        raise click.UsageError("--fail-on p0 goes with --p0")
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
    click.echo(printable(str(found)))
    if plot is not None:
        found.plot(plot)
        click.echo(f"  picture      {plot}")
    if found.prior_no_verdict == found.prior_simulations and not found.failures:
        raise CommandError(
            f"no simulation had a verdict, of {found.prior_simulations:,}: nothing is known of the "
            "probability; verifai-jax falsify says why",
            BROKEN,
        )
    if fail_on is not None and p0 is not None and not _is_below(found, p0):
        raise fail_gate()


def _is_below(found: "Estimate", p0: float) -> bool:
    """Return whether the bound or the interval shows a probability below `p0`."""
    return found.upper_bound <= p0 or (found.probability is not None and found.high < p0)
