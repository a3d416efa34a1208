"""`verifai-jax falsify specs/cartpole.py:balance --search uniform --budget 20000`."""

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from verifai_jax.cli.arguments import (
    BACKEND,
    BATCH,
    MAX_SECONDS,
    ONLY,
    PICTURES,
    PRECISION,
    PROGRESS,
    SET,
    fail_on,
    load_problem,
    next_folder,
    plain_values,
    read_run,
    recorded_target,
    refuse_with_resume,
)
from verifai_jax.cli.exit_codes import BROKEN, INTERRUPTED, CommandError, fail_gate

if TYPE_CHECKING:
    from verifai_jax.falsification.run import Run
    from verifai_jax.statistics.stopping import Decided, Within


@click.command()
@click.argument("target", required=False)
@click.option("--search", help="Name of the search  [default: portfolio]")
@SET
@click.option("--budget", type=int, help="Simulations at most  [default: 10000]")
@BATCH
@click.option("--seed", type=int, help="Seed of all chance  [default: 0]")
@ONLY
@MAX_SECONDS
@click.option("--stop-after", type=int, help="Stop at that many counterexamples.")
@click.option("--within", type=float, help="Stop when the failure rate is known as closely.")
@click.option("--decide", type=float, help="Stop when the rate is clearly above or below this.")
@click.option("--warm-start", type=click.Path(path_type=Path), help="Run to learn from first.")
@click.option("--resume", type=click.Path(path_type=Path), help="Run folder to go on with.")
@PRECISION
@BACKEND
@click.option(
    "--confirm/--no-confirm",
    default=True,
    help="Claim only what closer replays confirm  [default: confirm]",
)
@click.option("--diverse", is_flag=True, help="Look for failures of different kinds.")
@click.option(
    "--folder",
    type=click.Path(path_type=Path),
    help="Run folder to write  [default: runs/NAME-1, -2, ...]",
)
@PICTURES
@PROGRESS
@fail_on("counterexample", "if a counterexample was found")
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
    precision: Literal["float32", "float64"] | None,
    backend: str | None,
    confirm: bool,
    diverse: bool,
    folder: Path | None,
    pictures: bool,
    progress: bool | None,
    fail_on: str | None,
) -> None:
    """Search for inputs under which TARGET (specs/FILE.py:NAME) breaks its property."""
    from verifai_jax import falsification
    from verifai_jax.search import named

    stop_when = _stopping_rule(within, decide)
    if resume is not None:
        fixed = {"--search": search, "--batch": batch, "--seed": seed, "--folder": folder}
        fixed |= {"--set": options, "--warm-start": warm_start}
        fixed |= {"--precision": precision, "--backend": backend}
        refuse_with_resume(fixed, "run")
        run = falsification.resume(
            resume,
            load_problem(target or _resumed_target(resume), only),
            budget=budget,
            max_seconds=max_seconds,
            stop_after=stop_after,
            stop_when=stop_when,
            progress=progress,
        )
    elif target is None:
        raise click.UsageError("Missing argument 'TARGET', such as specs/cartpole.py:balance.")
    else:
        chosen = named(search or "portfolio", **plain_values("--set", options))
        problem = load_problem(target, only)
        earlier = None if warm_start is None else read_run(warm_start)
        with next_folder("runs", problem.name) if folder is None else nullcontext(folder) as place:
            run = falsification.falsify(
                problem,
                chosen,
                10_000 if budget is None else budget,
                batch=batch,
                seed=0 if seed is None else seed,
                max_seconds=max_seconds,
                stop_after=stop_after,
                stop_when=stop_when,
                warm_start=earlier,
                folder=place,
                precision=precision or "float32",
                backend=backend,
                confirm=confirm,
                diverse=diverse,
                progress=progress,
                target=target,
            )
    print_run(run, pictures)
    if fail_on is not None and run.table.counts.claimed:
        raise fail_gate()


def _resumed_target(folder: Path) -> str:
    return recorded_target(folder, remedy=f"specs/FILE.py:NAME --resume {folder}")


def _stopping_rule(within: float | None, decide: float | None) -> "Within | Decided | None":
    if within is None and decide is None:
        return None
    if within is not None and decide is not None:
        raise click.UsageError("--within and --decide are two ways to stop; give one")
    from verifai_jax.statistics.stopping import Decided, Within

    if within is not None:
        return Within(within)
    assert decide is not None
    return Decided(decide)


def print_run(run: "Run", pictures: bool) -> None:
    """Print the summary of a run and how to see more of it.

    **Raises:** `CommandError` where no simulation has a verdict.
    """
    click.echo(run.summary())
    assert run.folder is not None
    if run.stopped == "interrupted":
        click.echo(f"  resume       verifai-jax falsify --resume {run.folder}")
    click.echo(f"  table        {run.table_path}")
    if pictures and run.simulations:
        from verifai_jax.plotting import write_run_pictures

        for path in write_run_pictures(run, run.folder):
            click.echo(f"  picture      {path}")
    failed = run.table.failed
    if len(failed) < run.simulations:
        click.echo(f"  replay       verifai-jax replay {run.folder} {run.best.name}")
        return
    if not run.simulations and run.stopped == "interrupted":
        raise CommandError("interrupted before the first batch was finished", INTERRUPTED)
    if not run.simulations:
        raise CommandError("no simulation was finished, so nothing is known of it", BROKEN)
    from verifai_jax.core.text import one_line

    counts = ", ".join(f"{n:,} {status}" for status, n in failed["status"].value_counts().items())
    messages = [text for text in failed["message"] if text] if "message" in failed else []
    raise CommandError(
        f"no simulation had a verdict, so nothing is known of the property: {counts}"
        + (f". The first says: {one_line(str(messages[0]))}" if messages else ""),
        BROKEN,
    )
