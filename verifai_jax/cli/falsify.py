"""`verifai-jax falsify specs/cartpole.py:balance --search uniform --budget 20000`."""

import shlex
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

import click

from verifai_jax.cli.arguments import (
    BACKEND,
    BATCH,
    CLUSTER,
    KEEP_GOING,
    MAX_SECONDS,
    ONLY,
    PICTURES,
    PRECISION,
    PROGRESS,
    RUN_FOLDER,
    SET,
    given_or_next,
    load_problem,
    on_cluster,
    plain_values,
    read_run,
    recorded_target,
    refuse_with_resume,
    resuming,
    target_apart,
)
from verifai_jax.cli.exit_codes import BROKEN, INTERRUPTED, CommandError
from verifai_jax.cli.gates import RATE, Gate, check_gate, exceeds, fail_on
from verifai_jax.cli.json_output import command, describe_run, give_result

if TYPE_CHECKING:
    from verifai_jax.falsification.run import Run
    from verifai_jax.problem import Problem
    from verifai_jax.search import Search
    from verifai_jax.statistics.stopping import Decided, Within


@command()
@click.argument("target", required=False)
@click.option("--search", help="Name of the search  [default: auto]")
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
@click.option(
    "--resume",
    type=click.Path(path_type=Path),
    help="Run folder to go on with; with a larger --budget the run of that budget and this batch.",
)
@click.option(
    "--even-if-changed", is_flag=True, help="Resume although the model has changed, and note it."
)
@PRECISION
@BACKEND
@CLUSTER
@click.option(
    "--shard",
    metavar="I/N",
    help="Simulate part I of N alone, as a job of an array; merge makes the run of them.",
)
@click.option(
    "--confirm/--no-confirm",
    default=True,
    help="Claim only what closer replays confirm  [default: confirm]",
)
@click.option("--diverse", is_flag=True, help="Look for failures of different kinds.")
@click.option(
    "--diverse-by",
    type=click.Choice(["inputs", "behaviour"]),
    help="Of kinds that differ in this  [default: inputs]",
)
@RUN_FOLDER
@KEEP_GOING
@PICTURES
@PROGRESS
@fail_on(
    counterexample="if a counterexample was found",
    rate="unless the failure rate is shown to be at most P; needs --search uniform",
)
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
    even_if_changed: bool,
    precision: Literal["float32", "float64"] | None,
    backend: str | None,
    cluster: str | None,
    shard: str | None,
    confirm: bool,
    diverse: bool,
    diverse_by: Literal["inputs", "behaviour"] | None,
    folder: Path | None,
    keep_going: bool,
    pictures: bool,
    progress: bool | None,
    fail_on: Gate | None,
) -> None:
    """Search for inputs under which TARGET (specs/FILE.py:NAME) breaks its property."""
    from verifai_jax import falsification
    from verifai_jax.core import figure
    from verifai_jax.core.compilation import while_compiling
    from verifai_jax.search import named

    if pictures:
        while_compiling(figure.load)

    stop_when = _stopping_rule(within, decide)
    if shard is not None:
        alone = {"--resume": resume, "--cluster": cluster, "--warm-start": warm_start}
        alone |= {"--max-seconds": max_seconds, "--stop-after": stop_after, "--within": within}
        alone |= {"--decide": decide, "--diverse": diverse or None, "--diverse-by": diverse_by}
        alone |= {"--fail-on": fail_on}
        for option, value in alone.items():
            if value is not None:
                raise click.UsageError(f"{option} needs all rows of a run; --shard has a part")
        if target is None:
            raise click.UsageError("Missing argument 'TARGET', such as specs/cartpole.py:balance.")
        chosen = named(search or "uniform", **plain_values("--set", options))
        _simulate_shard(
            load_problem(target, only), shard, chosen, budget or 10_000, folder,
            batch=batch, seed=seed or 0, precision=precision or "float32", backend=backend,
            confirm=confirm, progress=progress, target=target,
        )  # fmt: skip
        return
    if resume is not None:
        fixed = {"--search": search, "--batch": batch, "--seed": seed, "--folder": folder}
        fixed |= {"--set": options, "--warm-start": warm_start}
        fixed |= {"--precision": precision, "--backend": backend}
        refuse_with_resume(fixed, "run")
        problem = load_problem(target or _resumed_target(resume), only)
        with on_cluster(cluster) as executor:
            run = falsification.resume(
                resume,
                problem,
                budget=budget,
                max_seconds=max_seconds,
                stop_after=stop_after,
                stop_when=stop_when,
                progress=progress,
                executor=executor,
                even_if_changed=even_if_changed,
                keep_going=keep_going,
            )
    elif target is None:
        raise click.UsageError("Missing argument 'TARGET', such as specs/cartpole.py:balance.")
    else:
        chosen = named(search or "portfolio", **plain_values("--set", options))
        if fail_on is not None and fail_on.name == RATE and not chosen.samples_prior:
            raise click.UsageError(
                f"--fail-on {fail_on} needs independent samples of the space; give --search uniform"
            )
        problem = load_problem(target, only)
        earlier = None if warm_start is None else read_run(warm_start)
        with (
            given_or_next(folder, "runs", problem.name) as place,
            on_cluster(cluster) as executor,
        ):
            run = falsification.falsify(
                problem,
                chosen if search or options else "auto",
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
                diverse=diverse_by or diverse,
                progress=progress,
                target=target,
                executor=executor,
                keep_going=keep_going,
            )
    ends = {"--max-seconds": max_seconds, "--stop-after": stop_after, "--within": within}
    print_run(run, pictures, {**ends, "--decide": decide, "--cluster": cluster})
    check_run(run, fail_on)


def _simulate_shard(
    problem: "Problem",
    shard: str,
    search: "Search",
    budget: int,
    folder: Path | None,
    **options: Any,
) -> None:
    """Simulate one part of a run, and say what makes the run of the parts."""
    from verifai_jax.core.text import folder_name
    from verifai_jax.falsification.shards import Shard, simulate_shard

    part = Shard.parse(shard)
    parts = Path("runs") / f"{folder_name(problem.name)}-parts"
    place = parts / f"{part.number}-of-{part.of}" if folder is None else folder
    simulations = simulate_shard(problem, part, search, budget, folder=place, **options)
    click.echo(f"part {part} of {problem.name}: {simulations:,} of {budget:,} simulations")
    give_result(
        problem=problem.name, part=str(part), simulations=simulations, budget=budget, folder=place
    )
    click.echo(f"  part         {place}")
    click.echo(f"  merge        verifai-jax merge {shlex.quote(str(place.parent))}/*")


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


def check_run(run: "Run", asked: Gate | None) -> None:
    """End the command with code 1 where a run does not keep the gate that was asked for."""
    high = None if run.failure_rate is None else run.failure_rate.high
    failed = {"counterexample": run.table.counts.claimed > 0, RATE: exceeds(asked, high)}
    check_gate(asked, failed)


def print_run(
    run: "Run", pictures: bool, options: Mapping[str, object] = MappingProxyType({})
) -> None:
    """Print the summary of a run and how to see more of it.

    **Arguments:**

    - `options`: of the command, which the record does not hold and whoever resumes it gives again.

    **Raises:** `CommandError` where no simulation has a verdict.
    """
    click.echo(run.summary())
    give_result(**describe_run(run))
    assert run.folder is not None
    if run.stopped == "interrupted":
        click.echo(f"  resume       {resuming('falsify', run.folder, run.target, options)}")
    click.echo(f"  table        {run.table_path}")
    if pictures and run.simulations:
        from verifai_jax.plotting import write_run_pictures

        for path in write_run_pictures(run, run.folder):
            click.echo(f"  picture      {path}")
    failed = run.table.failed
    if len(failed) < run.simulations:
        words = ["verifai-jax", "replay", str(run.folder), str(run.best.name)]
        apart = target_apart(run.folder, run.target)
        words += [] if apart is None else ["--problem", apart]
        click.echo(f"  replay       {shlex.join(words)}")
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
