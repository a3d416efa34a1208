"""`verifai-jax verify FILE.py:NAME`: which parts of the feature space are proved, or broken."""

from pathlib import Path
from typing import Any

from verifai_jax.cli import arguments
from verifai_jax.cli.arguments import PATH, option
from verifai_jax.cli.gates import Gate, check_gate, fail_on
from verifai_jax.cli.json_output import command, give_result, say, show_result


@command()
@arguments.TARGET
@option("--budget", type=float, help="Approximate time in seconds  [default: 60]")
@option("--boxes", type=int, help="Maximum boxes to examine.")
@option("--samples", default=4096, help="Simulations of the undecided part.")
@option("--confidence", default=0.95)
@arguments.SEED
@arguments.ONLY
@arguments.PRECISION
@option("--continuous", is_flag=True, help="Verify the differential equation at all times.")
@option("--into", type=PATH, help="File for the result, or to continue.")
@arguments.PLOT
@arguments.REPORT
@arguments.PROGRESS
@fail_on(
    counterexample="if any box contains a point that fails for certain",
    undecided="unless the whole space is proved",
)
def verify(
    target: str,
    only: str | None,
    into: Path | None,
    plot: Path | None,
    report: Path | None,
    fail_on: Gate | None,
    **options: Any,
) -> None:
    """Divide the features of TARGET (FILE.py:NAME) into proved, broken and undecided boxes."""
    from verifai_jax import Stop
    from verifai_jax import verify as run

    problem = arguments.load_problem(target, only)
    before = into if into is not None and into.exists() else None
    stop = Stop(seconds=options.pop("budget"))
    found = run(problem, resume=before, stop=stop, **options)
    show_result(found, plot, "name", "looked_at", "simulations", "seconds", "stopped", "notes")
    low, high = found.probability
    parts = {name: getattr(found, name)._asdict() for name in ("proved", "broken", "undecided")}
    give_result(**parts, failing_at_least=low, failing_at_most=high, formulas=found.formulas)
    if into is not None:
        say(f"  result       {found.save(into)}")
    if report is not None:
        say(f"  report       {found.report(report, problem=problem)}")
    failed = {"counterexample": found.broken.mass > 0, "undecided": found.proved.mass < 1}
    check_gate(fail_on, failed)
