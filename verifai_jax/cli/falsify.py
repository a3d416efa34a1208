"""`verifai-jax falsify specs/cartpole.py:balance --search uniform --budget 20000`."""

import shlex
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import click

import verifai_jax as vj
from verifai_jax.cli import arguments
from verifai_jax.cli.arguments import PATH, option
from verifai_jax.cli.exit_codes import BROKEN, INTERRUPTED, CommandError
from verifai_jax.cli.gates import RATE, Gate, check_gate, exceeds, fail_on
from verifai_jax.cli.json_output import command, describe_run, give_result, say
from verifai_jax.cli.next_folder import given_or_next

_RESUMES = (
    *("resume", "target", "only", "budget", "max_seconds", "stop_after", "within", "decide"),
    *("even_if_changed", "cluster", "fail_on"),
)
"""Options that go with `--resume`; the run has fixed the others."""


@command()
@click.argument("target", required=False)
@option("--search", help="Name of the search  [default: auto]")
@arguments.SET
@option("--budget", type=int, help="Maximum simulations  [default: 10000]")
@arguments.BATCH
@arguments.SEED
@arguments.ONLY
@arguments.MAX_SECONDS
@arguments.STOP_AFTER
@option("--within", type=float, help="Stop when the failure rate is known to within this number.")
@option("--decide", type=float, help="Stop when the rate is clearly above or below this.")
@option("--warm-start", type=PATH, help="Earlier run from which the search learns first.")
@option(
    "--resume", type=PATH, help="Run folder to continue; with a larger --budget, up to that budget."
)
@arguments.EVEN_IF_CHANGED
@arguments.PRECISION
@arguments.BACKEND
@arguments.ENGINE
@arguments.CLUSTER
@arguments.PROVED
@click.option(
    "--confirm/--no-confirm", default=True,
    help="Claim only what closer replays confirm  [default: confirm]",
)  # fmt: skip
@option("--diverse", is_flag=True, help="Look for failures of different kinds.")
@option(
    "--diverse-by", type=click.Choice(["inputs", "behaviour"]),
    help="Kinds differ in this  [default: inputs]",
)  # fmt: skip
@option(
    "--objective", type=click.Choice(["robustness", "likelihood"]), default="robustness",
    help="Look for the largest violation, or for the likeliest failure.",
)  # fmt: skip
@arguments.RUN_FOLDER
@arguments.KEEP_GOING
@arguments.PICTURES
@arguments.PROGRESS
@fail_on(
    counterexample="if a counterexample was found",
    rate="unless the failure rate is shown to be at most P; needs --search uniform",
)
def falsify(
    target: str | None, search: str | None, options: tuple[str, ...], budget: int | None,
    only: str | None, within: float | None, decide: float | None, warm_start: Path | None,
    resume: Path | None, even_if_changed: bool, cluster: str | None, diverse: bool,
    diverse_by: Literal["inputs", "behaviour"] | None, folder: Path | None, pictures: bool,
    proved: Path | None, fail_on: Gate | None, **given: Any,
) -> None:  # fmt: skip
    """Search for inputs under which TARGET (specs/FILE.py:NAME) breaks its property."""
    from verifai_jax import falsification
    from verifai_jax.core.compute.compilation import while_compiling
    from verifai_jax.core.display import figure
    from verifai_jax.search import named

    if pictures:
        while_compiling(figure.load)
    stop_when = _stopping_rule(within, decide)
    if resume is not None:
        arguments.refuse_others(_RESUMES, "is fixed in the run that --resume goes on with")
        remedy = f"specs/FILE.py:NAME --resume {resume}"
        target = target or arguments.recorded_target(resume, remedy)
    if target is None:
        raise click.UsageError("Missing argument 'TARGET', such as specs/cartpole.py:balance.")
    ends = {"--max-seconds": given["max_seconds"], "--stop-after": given["stop_after"]}
    ends |= {"--within": within, "--decide": decide, "--cluster": cluster}
    goes_on = partial(arguments.resuming, "falsify", target=target, options=ends)
    if resume is not None:
        problem = arguments.load_problem(target, only)
        kept = ("max_seconds", "stop_after", "progress", "keep_going")
        with given_or_next(resume, "runs", "", goes_on), arguments.on_cluster(cluster) as executor:
            asked = {name: given[name] for name in kept} | {"budget": budget}
            asked = arguments.values_of(asked, stop_when, executor)
            run = falsification.resume(resume, problem, even_if_changed=even_if_changed, **asked)
    else:
        likely = given.pop("objective") == "likelihood"
        usual = "cross_entropy" if likely and not options else "portfolio"
        chosen = named(search or usual, **arguments.plain_values("--set", options))
        if diverse or diverse_by:
            chosen = named("diverse", search=chosen, by=diverse_by or "inputs")
        if likely:
            chosen = named("likeliest", search=chosen)
        auto = not (search or options or diverse or diverse_by or likely)
        if fail_on is not None and fail_on.name == RATE and not chosen.samples_prior:
            raise click.UsageError(
                f"--fail-on {fail_on} needs independent samples of the space; give --search uniform"
            )
        problem = arguments.load_problem(target, only)
        earlier = None if warm_start is None else arguments.read_run(warm_start)
        with (
            given_or_next(folder, "runs", problem.name, goes_on) as path,
            arguments.on_cluster(cluster) as executor,
        ):
            start = falsification.Start("auto" if auto else chosen, run=earlier, proved=proved)
            asked = arguments.values_of(given, stop_when, executor)
            number = 10_000 if budget is None else budget
            run = falsification.falsify(problem, start, number, folder=path, **asked)
    print_run(run, pictures, ends)
    check_run(run, fail_on)


def _stopping_rule(within: float | None, decide: float | None) -> "vj.Within | vj.Decided | None":
    if within is not None and decide is not None:
        raise click.UsageError("--within and --decide are alternatives; give one")
    if within is not None:
        return vj.Within(within)
    return None if decide is None else vj.Decided(decide)


def check_run(run: "vj.Run", asked: Gate | None) -> None:
    """End the command with code 1 if a run fails the requested gate."""
    high = None if run.failure_rate is None else run.failure_rate.high
    failed = {"counterexample": run.table.counts.may_fail, RATE: exceeds(asked, high)}
    check_gate(asked, failed)


def print_run(
    run: "vj.Run", pictures: bool, options: Mapping[str, object] = MappingProxyType({})
) -> None:
    """Print the summary of a run, and the commands to see more of it.

    **Arguments:**
    - `options`: the options that the record does not hold and that must be given again on resuming.
    **Raises:** `CommandError` if no simulation has a verdict.
    """
    say(run.summary())
    give_result(**describe_run(run))
    assert run.folder is not None
    if run.stopped == "interrupted":
        again = arguments.resuming("falsify", run.folder, run.target, options)
        say(f"  resume       {again}")
    say(f"  table        {run.table_path}")
    if pictures and run.simulations:
        from verifai_jax.pictures import write_run_pictures

        for path in write_run_pictures(run, run.folder):
            say(f"  picture      {path}")
    failed = run.table.failed
    if len(failed) < run.simulations:
        words = ["verifai-jax", "replay", str(run.folder), str(run.best.name)]
        apart = arguments.target_apart(run.folder, run.target)
        words += [] if apart is None else ["--problem", apart]
        say(f"  replay       {shlex.join(words)}")
        return
    if not run.simulations and run.stopped == "interrupted":
        raise CommandError("interrupted before the first batch was finished", INTERRUPTED)
    if not run.simulations:
        raise CommandError("no simulation was finished, so nothing is known of it", BROKEN)
    from verifai_jax.core.messages.text import one_line

    counts = ", ".join(f"{n:,} {status}" for status, n in failed["status"].value_counts().items())
    messages = [text for text in failed["message"] if text] if "message" in failed else []
    raise CommandError(
        f"no simulation had a verdict, so nothing is known of the property: {counts}"
        + (f". The first says: {one_line(str(messages[0]))}" if messages else ""),
        BROKEN,
    )
