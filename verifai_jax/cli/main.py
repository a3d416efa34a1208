"""The command line: each command is one call into the Python API.

verifai-jax falsify specs/cartpole.py:balance --search uniform --budget 20000
verifai-jax replay runs/balance-1 417
verifai-jax monitor "always[0, 4] abs(x) <= 2.4" trace.csv
"""

from pathlib import Path
from typing import Any

import click

from verifai_jax._version import __version__
from verifai_jax.cli.arguments import only as varied_only
from verifai_jax.cli.arguments import pairs, plain_values, recorded_run, recorded_target
from verifai_jax.cli.confirm import confirm
from verifai_jax.cli.estimate import estimate
from verifai_jax.cli.explain import explain
from verifai_jax.cli.repair import repair
from verifai_jax.cli.shrink import shrink
from verifai_jax.cli.sweep import sweep
from verifai_jax.cli.synthesize import synthesize
from verifai_jax.core.errors import MissingExtra


class _Group(click.Group):
    """Says what a user did wrong in one line, and keeps tracebacks for our own mistakes."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except (ValueError, TypeError, IndexError, OSError, MissingExtra) as error:
            if ctx.params.get("traceback"):
                raise
            raise click.ClickException(str(error)) from error
        except RuntimeError as error:
            from verifai_jax.falsification._falsify import RunError

            if ctx.params.get("traceback") or not isinstance(error, RunError):
                raise
            raise click.ClickException(str(error)) from error

    def resolve_command(self, ctx: click.Context, args: list[str]) -> Any:
        from verifai_jax.core.errors import unknown_name

        if args and self.get_command(ctx, args[0]) is None and not args[0].startswith("-"):
            raise click.UsageError(str(unknown_name("command", args[0], self.list_commands(ctx))))
        return super().resolve_command(ctx, args)


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="verifai-jax")
@click.option("--traceback", is_flag=True, help="Show where an error was raised.")
def main(traceback: bool) -> None:
    """Find inputs that make a closed-loop system break a temporal-logic property."""


@main.command()
@click.argument("target", required=False)
@click.option("--search", help="Name of the search  [default: portfolio]")
@click.option("--set", "options", multiple=True, metavar="NAME=VALUE", help="Option of the search.")
@click.option("--budget", type=int, help="Simulations at most  [default: 10000]")
@click.option("--batch", type=int, help="Simulations a round  [default: by search]")
@click.option("--seed", type=int, help="[default: 0]")
@click.option("--only", metavar="NAMES", help="Features to vary, comma-separated; others nominal.")
@click.option("--max-seconds", type=float, help="Seconds at most, compilation included.")
@click.option("--stop-after", type=int, help="Stop at that many counterexamples.")
@click.option("--within", type=float, help="Stop when the failure rate is known as closely.")
@click.option("--decide", type=float, help="Stop when the rate is clearly above or below this.")
@click.option("--warm-start", type=click.Path(path_type=Path), help="Run to learn from first.")
@click.option("--resume", type=click.Path(path_type=Path), help="Run folder to go on with.")
@click.option("--precision", type=click.Choice(["float32", "float64"]), help="[default: float32]")
@click.option("--backend", help="mjx or native, for a MuJoCo model  [default: the faster one]")
@click.option(
    "--confirm/--no-confirm",
    "confirm_found",
    default=True,
    help="Claim only what closer replays confirm  [default: confirm]",
)
@click.option("--diverse", is_flag=True, help="Look for failures of different kinds.")
@click.option("--out", type=click.Path(path_type=Path), help="Run folder [runs/NAME-1, -2, ...].")
@click.option("--pictures/--no-pictures", default=True, help="Draw pictures into the run folder.")
def falsify(
    target: str | None,
    search: str | None,
    options: tuple[str, ...],
    budget: int | None,
    batch: int | None,
    seed: int | None,
    only: str | None,
    max_seconds: float | None,
    stop_after: int | None,
    within: float | None,
    decide: float | None,
    warm_start: Path | None,
    resume: Path | None,
    precision: str | None,
    backend: str | None,
    confirm_found: bool,
    diverse: bool,
    out: Path | None,
    pictures: bool,
) -> None:
    """Search for inputs under which TARGET (specs/FILE.py:NAME) breaks its property."""
    from verifai_jax.core.targets import load_target
    from verifai_jax.falsification._falsify import falsify as run_falsify
    from verifai_jax.falsification._falsify import resume as run_resume
    from verifai_jax.falsification.run import load
    from verifai_jax.search import named
    from verifai_jax.statistics.binomial import Decided, Within

    if within is not None and decide is not None:
        raise click.UsageError("--within and --decide are two ways to stop; give one")
    ends: dict[str, Any] = {"max_seconds": max_seconds, "stop_after": stop_after}
    if within is not None or decide is not None:
        ends["stop_when"] = Decided(decide) if within is None else Within(within)  # pyright: ignore[reportArgumentType]
    if resume is not None:
        fixed = {"--search": search, "--batch": batch, "--seed": seed, "--out": out}
        fixed |= {"--set": options or None, "--warm-start": warm_start}
        fixed |= {"--precision": precision, "--backend": backend}
        for option, value in fixed.items():
            if value is not None:
                raise click.UsageError(f"{option} is fixed in the run that --resume goes on with")
        problem = varied_only(load_target(target or recorded_target(resume)), only)
        run = run_resume(resume, problem, budget=budget, **ends)
    elif target is None:
        raise click.UsageError("Missing argument 'TARGET', such as specs/cartpole.py:balance.")
    else:
        chosen = named(search or "portfolio", **plain_values("--set", options))
        problem = varied_only(load_target(target), only)
        run = run_falsify(
            problem,
            chosen,
            10_000 if budget is None else budget,
            batch=batch,
            seed=0 if seed is None else seed,
            warm_start=None if warm_start is None else load(warm_start),
            folder=out or _next_folder(problem.name),
            precision=precision or "float32",
            backend=backend,
            confirm=confirm_found,
            diverse=diverse,
            target=target,
            **ends,
        )
    click.echo(run.summary())
    assert run.folder is not None
    click.echo(f"  table        {run.folder / 'table.parquet'}")
    if pictures and run.simulations:
        from verifai_jax.plotting import draw_run

        for path in draw_run(run, run.folder):
            click.echo(f"  picture      {path}")
    if run.simulations and len(run.table.failed) < run.simulations:
        click.echo(f"  replay       verifai-jax replay {run.folder} {run.best.name}")


for _command in (confirm, estimate, explain, repair, shrink, sweep, synthesize):
    main.add_command(_command)


@main.command(name="list")
@click.argument("place", default="specs")
def list_problems(place: str) -> None:
    """List the problems and studies of a file or folder (PLACE, by default specs/)."""
    from verifai_jax.core.targets import TargetError, defined_in
    from verifai_jax.problem.problem import Problem
    from verifai_jax.search import names

    path = Path(place)
    files = sorted(path.glob("[!_]*.py")) if path.is_dir() else [path]
    if not files:
        raise TargetError(f"{place}/ has no Python file with problems")
    for file in files:
        try:
            found = defined_in(str(file))
        except MissingExtra as error:
            click.echo(f"{file}: {error}")
            continue
        for name, target in found.items():
            click.echo(f"{file}:{name}  {target.description}")
            varied = ", ".join(target.space.domains)
            if not isinstance(target, Problem):
                click.echo(f"    a study of trainings, for sweep, over {varied}")
                continue
            for formula in target.formulas.values():
                click.echo(f"    {formula}")
            click.echo(f"    over {varied}")
    for folder in sorted(path.iterdir()) if path.is_dir() else []:
        if any(folder.glob("[!_]*.py")):
            click.echo(f"more in {folder}/: verifai-jax list {folder}")
    click.echo(f"searches: {', '.join(names())}")


@main.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.argument("row", type=int, required=False)
@click.option("--problem", "target", help="FILE.py:NAME of the problem [the one recorded].")
@click.option(
    "--precision",
    type=click.Choice(["float32", "float64"]),
    help="[default: float64, and that of the run for a system that draws random numbers]",
)
@click.option("--out", type=click.Path(path_type=Path), help="Folder of pictures [the run's].")
@click.option("--pictures/--no-pictures", default=True)
def replay(
    folder: Path,
    row: int | None,
    target: str | None,
    precision: str | None,
    out: Path | None,
    pictures: bool,
) -> None:
    """Simulate a ROW (by default the worst) of the run in FOLDER again, and draw it."""
    from verifai_jax.plotting import draw_replay

    run = recorded_run(folder, target)
    number = int(run.best.name) if row is None else row  # pyright: ignore[reportArgumentType]
    if precision is None:
        assert run.problem is not None
        precision = run.precision if run.problem.draws() else "float64"
    seen = run.replay(number, precision)
    stored = run.table.all.iloc[number]
    click.echo(f"{run.name}, row {number}, {precision}")
    for name in run.table.features:
        click.echo(
            f"  {name:<12} {stored[name]:.6g}"
            if _is_number(stored[name])
            else f"  {name:<12} {stored[name]}"
        )
    for name, rho in seen.rho.items():
        click.echo(f"  {run.formulas[name]}")
        click.echo(f"    robustness {rho:.6g} in {precision}, {stored['rho']:.6g} in the table")
    click.echo(f"  status {seen.status.name.lower()}; {'violated' if seen.violated else 'kept'}")
    if pictures:
        for path in draw_replay(seen, out or folder):
            click.echo(f"  picture      {path}")


@main.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--problem", "target", help="FILE.py:NAME of the problem [the one recorded].")
@click.option("--out", type=click.Path(path_type=Path), help="Folder of the report [the run's].")
def analyze(folder: Path, target: str | None, out: Path | None) -> None:
    """What the table of the run in FOLDER says: rules, importance, kinds of failures, coverage."""
    run = recorded_run(folder, target)
    found = run.analyze()
    click.echo(str(found))
    click.echo(f"  written      {found.save((out or folder) / 'analysis')}")


@main.command()
@click.argument("formula")
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("--dt", type=float, help="Sampling period in seconds, instead of a column of times.")
@click.option("--time", default="time", show_default=True, help="Column of sample times.")
@click.option("--resample", "period", type=float, help="Period in seconds to resample to.")
@click.option("--method", type=click.Choice(["hold", "linear"]), help="How to resample.")
@click.option(
    "--end",
    type=click.Choice(["hold", "truncate", "strict"]),
    default="hold",
    show_default=True,
    help="What comes after the last sample.",
)
@click.option("--compat", type=click.Choice(["pymtl"]), help="Right-open windows, as in py-mtl.")
@click.option("--const", "constants", multiple=True, metavar="NAME=NUMBER")
@click.option("--define", "definitions", multiple=True, metavar="NAME=FORMULA")
@click.option("--explain", "explained", is_flag=True, help="Say which predicate decides, and when.")
@click.option("--plot", type=click.Path(path_type=Path), help="Draw the explanation into a PNG.")
@click.option("--fail", is_flag=True, help="Exit with 1 if the formula fails.")
def monitor(
    formula: str,
    recording: Path,
    dt: float | None,
    time: str,
    period: float | None,
    method: Any,
    end: Any,
    compat: str | None,
    constants: tuple[str, ...],
    definitions: tuple[str, ...],
    explained: bool,
    plot: Path | None,
    fail: bool,
) -> None:
    """Robustness of FORMULA on a recorded trace, RECORDING.csv or .parquet, in float64."""
    import jax

    from verifai_jax import mtl

    numbers = {name: _number(name, value) for name, value in pairs("--const", constants)}
    parsed = mtl.parse(formula, numbers, dict(pairs("--define", definitions)))
    trace = mtl.read(recording, time=time, dt=dt, resample_to=period, method=method)
    with jax.enable_x64(True):
        holds = bool(mtl.satisfied(parsed, trace, end, compat))
        rho = float(mtl.robustness(parsed, trace, end=end, compat=compat))
        click.echo(f"{'holds' if holds else 'fails'} with robustness {rho:.10g}")
        if explained or plot is not None:
            if compat is not None:
                raise click.UsageError("--explain and --plot do not go with --compat")
            why = mtl.explain(parsed, trace, end=end)
            if explained:
                click.echo(str(why))
            if plot is not None:
                mtl.draw(why, plot)
                click.echo(f"picture {plot}")
    if fail and not holds:
        raise SystemExit(1)


@main.command()
def doctor() -> None:
    """Report versions and known bad pairs of them, devices, cores, cache and rendering."""
    from verifai_jax.cli.doctor import report

    click.echo(report())


def _number(name: str, value: str) -> float:
    try:
        return float(value)
    except ValueError:
        raise click.UsageError(f"--const {name} must be a number; got {value!r}") from None


def _next_folder(name: str) -> Path:
    number = 1
    while (folder := Path("runs") / f"{name}-{number}").exists():
        number += 1
    return folder


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) or hasattr(value, "dtype")
