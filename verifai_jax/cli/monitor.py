"""`verifai-jax monitor "always[0, 4] abs(x) <= 2.4" trace.csv`: a formula on a recording."""

from pathlib import Path
from typing import Literal

import click

from verifai_jax.cli.arguments import PLOT, split_pairs


@click.command()
@click.argument("formula")
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("--dt", type=float, help="Sampling period in seconds, instead of a column of times.")
@click.option("--time", default="time", show_default=True, help="Column of sample times.")
@click.option("--resample", "period", type=float, help="Period in seconds to resample to.")
@click.option("--method", type=click.Choice(["hold", "linear"]), help="Interpolation to resample.")
@click.option(
    "--end",
    type=click.Choice(["hold", "truncate", "strict"]),
    default="hold",
    show_default=True,
    help="Semantics after the last sample.",
)
@click.option("--compat", type=click.Choice(["pymtl"]), help="Right-open windows, as in py-mtl.")
@click.option("--const", "constants", multiple=True, metavar="NAME=NUMBER")
@click.option("--define", "definitions", multiple=True, metavar="NAME=FORMULA")
@click.option("--explain", is_flag=True, help="Say which predicate decides, and when.")
@PLOT
@click.option("--fail", is_flag=True, help="Exit with 1 if the formula fails.")
def monitor(
    formula: str,
    recording: Path,
    dt: float | None,
    time: str,
    period: float | None,
    method: Literal["hold", "linear"] | None,
    end: Literal["hold", "truncate", "strict"],
    compat: Literal["pymtl"] | None,
    constants: tuple[str, ...],
    definitions: tuple[str, ...],
    explain: bool,
    plot: Path | None,
    fail: bool,
) -> None:
    """Compute the robustness of FORMULA on a recorded trace, RECORDING.csv or .parquet."""
    import jax

    from verifai_jax import mtl

    numbers = {name: _number(name, value) for name, value in split_pairs("--const", constants)}
    parsed = mtl.parse(formula, numbers, dict(split_pairs("--define", definitions)))
    trace = mtl.read(recording, time=time, dt=dt, resample_to=period, method=method)
    with jax.enable_x64(True):
        holds = bool(mtl.satisfied(parsed, trace, end, compat))
        rho = float(mtl.robustness(parsed, trace, end=end, compat=compat))
        click.echo(f"{'holds' if holds else 'fails'} with robustness {rho:.10g}")
        if explain or plot is not None:
            if compat is not None:
                raise click.UsageError("--explain and --plot do not go with --compat")
            why = mtl.explain(parsed, trace, end=end)
            if explain:
                click.echo(str(why))
            if plot is not None:
                mtl.draw(why, plot)
                click.echo(f"picture {plot}")
    if fail and not holds:
        raise SystemExit(1)


def _number(name: str, value: str) -> float:
    try:
        return float(value)
    except ValueError:
        raise click.UsageError(f"--const {name} must be a number; got {value!r}") from None
