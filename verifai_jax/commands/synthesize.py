"""`verifai-jax synthesize specs/tuning.py:first_order --parameters k`."""

from pathlib import Path

import click


@click.command()
@click.argument("target")
@click.option(
    "--parameters", metavar="NAMES", help="Features to choose, comma-separated  [default: all]"
)
@click.option("--budget", type=int, default=10_000, show_default=True, help="Simulations at most.")
@click.option("--margin", type=float, default=0.0, show_default=True, help="Robustness wanted.")
@click.option("--search", default="cross_entropy", show_default=True, help="Attacks the choice.")
@click.option("--held-out", type=int, default=2000, show_default=True, help="Fresh environments.")
@click.option("--gradient/--no-gradient", default=None, help="[default: where there are gradients]")
@click.option("--seed", type=int, default=0, show_default=True)
@click.option("--max-seconds", type=float, help="Seconds at most, compilation included.")
@click.option("--backend", help="mjx or native, for a MuJoCo model  [default: the faster one]")
@click.option("--out", type=click.Path(path_type=Path), help="CSV file for the candidates.")
def synthesize(
    target: str,
    parameters: str | None,
    budget: int,
    margin: float,
    search: str,
    held_out: int,
    gradient: bool | None,
    seed: int,
    max_seconds: float | None,
    backend: str | None,
    out: Path | None,
) -> None:
    """Find parameters for which TARGET (specs/FILE.py:NAME) holds, whatever its other features."""
    from verifai_jax.synthesis import synthesize as run_synthesize
    from verifai_jax.targets import load_target

    found = run_synthesize(
        load_target(target),
        parameters,
        budget,
        margin=margin,
        search=search,
        held_out=held_out,
        gradient=gradient,
        seed=seed,
        max_seconds=max_seconds,
        backend=backend,
    )
    click.echo(str(found))
    if out is not None:
        found.candidates.to_csv(out, index=False)
        click.echo(f"  candidates   {out}")
