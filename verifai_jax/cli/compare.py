"""`verifai-jax compare specs/old.py:balance specs/new.py:balance --margin 0.002`."""

import click

from verifai_jax.cli.arguments import MAX_SECONDS, SEED, TARGET, fail_on, load_problem
from verifai_jax.cli.exit_codes import fail_gate


@click.command()
@TARGET
@click.argument("candidates", nargs=-1, required=True)
@click.option(
    "--margin",
    type=float,
    default=0.0,
    show_default=True,
    help="Difference of failure probabilities that does not matter.",
)
@click.option(
    "--confidence", type=float, default=0.95, show_default=True, help="Of all verdicts together."
)
@click.option("--budget", type=int, default=100_000, show_default=True, help="Simulations at most.")
@SEED
@MAX_SECONDS
@fail_on("regression", "if a candidate fails more often, by more than the margin")
def compare(
    target: str,
    candidates: tuple[str, ...],
    margin: float,
    confidence: float,
    budget: int,
    seed: int,
    max_seconds: float | None,
    fail_on: str | None,
) -> None:
    """Compare failure rates of CANDIDATES (specs/FILE.py:NAME) with that of TARGET, in pairs."""
    from verifai_jax.comparison import compare as run_compare
    from verifai_jax.core.text import printable

    named = {name: load_problem(name) for name in candidates}
    result = run_compare(
        load_problem(target),
        named,
        margin=margin,
        confidence=confidence,
        budget=budget,
        seed=seed,
        max_seconds=max_seconds,
    )
    click.echo(printable(str(result)))
    if fail_on is not None and result.regression:
        raise fail_gate()
