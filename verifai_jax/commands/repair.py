"""`verifai-jax repair specs/tuning.py:gains --parameters k_x,k_theta`."""

import json
from pathlib import Path
from typing import Any

import click


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
@click.option("--margin", type=float, default=0.0, show_default=True, help="Robustness wanted.")
@click.option("--search", default="cross_entropy", show_default=True, help="Attacks the choice.")
@click.option("--held-out", type=int, default=2000, show_default=True, help="Fresh environments.")
@click.option("--gradient/--no-gradient", default=None, help="[default: where there are gradients]")
@click.option("--seed", type=int, default=0, show_default=True)
@click.option("--max-seconds", type=float, help="Seconds at most, compilation included.")
@click.option("--backend", help="mjx or native, for a MuJoCo model  [default: the faster one]")
@click.option("--out", type=click.Path(path_type=Path), help="PNG file for a picture.")
def repair(
    target: str,
    parameters: str,
    values: tuple[str, ...],
    folder: Path | None,
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
    """Change parameters of TARGET (specs/FILE.py:NAME) as little as removes its failures."""
    from verifai_jax.run import load
    from verifai_jax.synthesis import repair as run_repair
    from verifai_jax.targets import load_target

    problem = load_target(target)
    found = run_repair(
        problem if folder is None else load(folder, problem),
        parameters,
        budget,
        nominal=dict(map(_value, values)) or None,
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
        found.plot(out)
        click.echo(f"  picture      {out}")


def _value(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise click.UsageError(f"--nominal needs NAME=VALUE; got {text!r}")
    try:
        return name.strip(), json.loads(value)
    except json.JSONDecodeError:
        return name.strip(), value.strip()
