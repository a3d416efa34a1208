"""`verifai-jax analyze runs/balance-1`: the report on a run's table."""

from pathlib import Path

import click

from verifai_jax.cli.arguments import FOLDER, ODD, PROBLEM, RUN, load_judged_run, option
from verifai_jax.cli.json_output import command, give_result, say


@command()
@RUN
@PROBLEM
@FOLDER
@option(
    "--boundary",
    type=click.IntRange(1),
    metavar="POINTS",
    help="Learn the failing boundary, and suggest this many points to simulate next.",
)
@ODD
@option(
    "--next", "count", type=click.IntRange(1), default=10, help="Points of --odd to simulate next."
)
def analyze(
    folder: Path, target: str | None, into: Path | None, boundary: int | None, odd: Path | None,
    count: int,
) -> None:  # fmt: skip
    """Report rules, importance, kinds of failures and coverage of the run in RUN."""
    run = load_judged_run(folder, target)
    analysis = run.analyze()
    say(analysis)
    path = analysis.save((into or folder) / "analysis")
    say(f"  written      {path}")
    if boundary is not None:
        from verifai_jax import boundary as learn

        found = learn(run)
        say(found)
        points = found.next_points(boundary)
        say(points.to_string(index=False))
        give_result(boundary=found.calibration, brier=found.brier, next_points=points)
    if odd is not None:
        from verifai_jax import read_odd

        covered = read_odd(odd).coverage(run)
        say(covered)
        points = covered.next_points(count)
        say(points.to_string(index=False) if len(points) else "  all is covered")
        give_result(attributes=covered.table, uncovered=points)
    give_result(text=str(analysis), report=path)
