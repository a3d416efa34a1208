"""`verifai-jax monitor "always[0, 4] abs(x) <= 2.4" trace.csv`: a formula on a recording.

`verifai-jax monitor requirements.toml logs/`: many requirements on many recordings.
"""

import math
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from verifai_jax.cli.arguments import NAMES, PLOT, read_names
from verifai_jax.cli.exit_codes import BROKEN, CommandError
from verifai_jax.cli.gates import Gate, check_gate, fail_on
from verifai_jax.cli.json_output import command, give_result
from verifai_jax.cli.monitor_fleet import fleet_options, is_fleet, monitor_fleet
from verifai_jax.cli.monitor_stream import monitor_stream
from verifai_jax.core.atomic_files import replacing
from verifai_jax.core.errors import UnknownNameError, missing_name, nearest_names
from verifai_jax.core.text import printable

if TYPE_CHECKING:
    from verifai_jax.core.trace import Trace
    from verifai_jax.mtl import Formula
    from verifai_jax.mtl.resampling import Missing


@command()
@click.argument("formula")
@click.argument("recording", nargs=-1, type=click.Path(path_type=Path))
@click.option("--dt", type=float, help="Sampling period in seconds, instead of a column of times.")
@click.option("--time", default="time", show_default=True, help="Column of sample times.")
@click.option("--resample", "period", type=float, help="Period in seconds to resample to.")
@click.option("--method", type=click.Choice(["hold", "linear"]), help="Interpolation to resample.")
@click.option(
    "--missing",
    type=click.Choice(["hold", "drop", "interpolate"]),
    help="Treatment of gaps  [default: no verdict where they matter]",
)
@click.option(
    "--end",
    type=click.Choice(["hold", "truncate", "strict"]),
    default="hold",
    show_default=True,
    help="Semantics after the last sample.",
)
@click.option("--compat", type=click.Choice(["pymtl"]), help="Right-open windows, as in py-mtl.")
@NAMES
@click.option(
    "--export-c",
    "header",
    type=click.Path(path_type=Path),
    metavar="FILE.h",
    help="Write FORMULA as a monitor in C (or FILE.fmu) instead, for samples --dt seconds apart.",
)
@click.option("--explain", is_flag=True, help="Say which predicate decides, and when.")
@PLOT
@fleet_options
@fail_on(violation="if a formula fails", incomplete="if one fails or has no verdict on a recording")
def monitor(
    formula: str,
    recording: tuple[Path, ...],
    dt: float | None,
    time: str,
    period: float | None,
    method: Literal["hold", "linear"] | None,
    missing: "Missing | None",
    end: Literal["hold", "truncate", "strict"],
    compat: Literal["pymtl"] | None,
    constants: tuple[str, ...],
    definitions: tuple[str, ...],
    header: Path | None,
    explain: bool,
    plot: Path | None,
    report: Path | None,
    junit: Path | None,
    jobs: int,
    fail_on: Gate | None,
) -> None:
    """Compute the robustness of FORMULA on a recorded trace, RECORDING.csv or .parquet.

    FORMULA may also be a file of requirements (.toml, .yaml, .csv or .reqif), and RECORDING a
    folder, or several: every requirement is judged on every recording.

    With - as RECORDING, lines of CSV are read from the standard input as they come, until the
    verdict is certain whatever follows: tail -f log.csv | verifai-jax monitor FORMULA -

    With --export-c FILE.h nothing is judged: FORMULA becomes a monitor in C, and with FILE.fmu one
    as an FMU.
    """
    import jax

    from verifai_jax import mtl
    from verifai_jax.mtl.columns import LeftOut

    if (explain or plot is not None) and compat is not None:
        raise click.UsageError("--explain and --plot do not go with --compat")
    numbers, named = read_names(constants, definitions)
    if header is not None:
        if recording or dt is None:
            raise click.UsageError("--export-c goes with --dt SECONDS, and with no RECORDING")
        name = re.sub(r"\W", "_", header.stem)
        parsed = mtl.parse(formula, numbers, named)
        if header.suffix == ".fmu":
            mtl.export_fmu(parsed, dt, header)
        else:
            with replacing(header) as partial:
                partial.write_text(mtl.export_c(parsed, dt, name), encoding="utf-8")
        click.echo(f"monitor {header}")
        give_result(formula=formula, header=str(header))
        return
    if not recording:
        raise click.UsageError("give a RECORDING to judge, or --export-c FILE.h")
    if is_fleet(formula, recording, report, junit):
        if plot is not None or compat is not None:
            raise click.UsageError("--plot and --compat go with one formula on one recording")
        options = {"time": time, "dt": dt, "resample_to": period, "method": method, "end": end}
        options["missing"] = missing
        found = monitor_fleet(formula, recording, numbers, named, report, junit, jobs, options)
        failing, unjudged = bool(found.failing), bool(found.without_verdict)
        check_gate(fail_on, {"violation": failing, "incomplete": failing or unjudged})
        return
    (file,) = recording
    parsed = mtl.parse(formula, numbers, named)
    if str(file) == "-":
        whole = (plot, compat, period)
        if explain or end != "hold" or any(option is not None for option in whole):
            raise click.UsageError(
                "a stream goes with --dt, --time, --missing hold, --const, --define and --fail-on; "
                "other options need the whole recording"
            )
        if missing in ("drop", "interpolate"):
            why = {
                "drop": "leaves instants out, and samples of a stream are evenly spaced",
                "interpolate": "needs the value after a gap, which a stream has not had yet",
            }[missing]
            raise click.UsageError(f"--missing {missing} {why}: use --missing hold")
        holds = monitor_stream(parsed, sys.stdin, time, dt, hold=missing == "hold")
        give_result(formula=str(parsed), holds=holds)
        check_gate(fail_on, {"violation": not holds, "incomplete": not holds})
        return
    trace = _read(file, time, dt, period, method, missing)
    _check_signals(parsed, trace, file)
    with jax.enable_x64(True):
        try:
            rho = float(mtl.robustness(parsed, trace, end=end, compat=compat))
        except mtl.HorizonError as error:
            advice = "Use --end hold or --end truncate, or a longer recording"
            raise ValueError(f"{error.fact}. {advice}") from None
        except mtl.SamplingError as error:
            advice = f"Resample it: --resample {error.dt:zg} --method hold (or linear)"
            raise ValueError(f"{error.fact}. {advice}") from None
        try:
            holds = bool(mtl.satisfied(parsed, trace, end, compat))
        except ValueError as error:
            if math.isnan(rho):
                raise CommandError(str(error), BROKEN) from None
            raise
        click.echo(f"{'holds' if holds else 'fails'} with robustness {rho:z.10g}")
        for note in trace.notes:
            if isinstance(note, LeftOut) and note.column in parsed.signals():
                click.echo(f"note: {printable(note)}")
        if explain or plot is not None:
            why = mtl.explain(parsed, trace, end=end)
            if explain:
                click.echo(str(why))
            if plot is not None:
                mtl.draw(why, plot)
                click.echo(f"picture {plot}")
    give_result(formula=str(parsed), holds=holds, robustness=rho)
    check_gate(fail_on, {"violation": not holds, "incomplete": not holds})


def _read(
    recording: Path,
    time: str,
    dt: float | None,
    period: float | None,
    method: Literal["hold", "linear"] | None,
    missing: "Missing | None",
) -> "Trace":
    """Read the recording; what is missing is reported as an option of this command."""
    from verifai_jax import mtl

    if (period is None) != (method is None):
        raise click.UsageError("--resample PERIOD goes with --method hold or --method linear")
    try:
        return mtl.read(
            recording, time=time, dt=dt, resample_to=period, method=method, missing=missing
        )
    except mtl.TimeColumnError as error:
        near = nearest_names(time, error.columns)
        raise ValueError(
            f"{error.fact}{near or '.'} Give the sampling period, --dt SECONDS, or the name of "
            f"the column, --time NAME. It has: {', '.join(error.columns)}"
        ) from None


def _check_signals(formula: "Formula", trace: "Trace", recording: Path) -> None:
    """Refuse a signal that the recording lacks, or that is a column of something else."""
    from verifai_jax import mtl

    for name in formula.signals():
        if name in trace.signals:
            continue
        try:
            mtl.read(recording, dt=1.0, columns=[name])
        except UnknownNameError:
            raise missing_name(str(recording), "signal", name, trace.signals) from None
