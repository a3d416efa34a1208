"""`verifai-jax estimate FILE.py:NAME`: how probable a failure is."""

import click

from verifai_jax.cli.arguments import only as varied_only


@click.command()
@click.argument("target")
@click.option("--method", help="monte_carlo, importance or splitting [chosen by what it sees].")
@click.option("--budget", type=int, default=50_000, show_default=True, help="Simulations at most.")
@click.option("--p0", type=float, help="Probability that it should be below.")
@click.option("--confidence", type=float, default=0.95, show_default=True)
@click.option("--seed", type=int, default=0, show_default=True)
@click.option("--only", help="Features that vary, such as x0,wind; the others are nominal.")
@click.option("--batch", type=int, help="Simulations at once.")
@click.option("--max-seconds", type=float)
@click.option("--precision", type=click.Choice(["float32", "float64"]), default="float32")
@click.option("--backend", help="Of a system that has several: mjx, native.")
@click.option("--plot", type=click.Path(), help="Draw interval, levels and weights into a PNG.")
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
    precision: str,
    backend: str | None,
    plot: str | None,
) -> None:
    """Estimate the probability that TARGET (FILE.py:NAME) fails, with an interval and a bound."""
    from verifai_jax.core.targets import load_target
    from verifai_jax.estimation import estimate as run

    found = run(
        varied_only(load_target(target), only),
        method,
        budget,
        batch=batch,
        seed=seed,
        confidence=confidence,
        p0=p0,
        precision=precision,
        backend=backend,
        max_seconds=max_seconds,
    )
    click.echo(str(found))
    if plot is not None:
        found.plot(plot)
        click.echo(f"  picture      {plot}")
