"""`verifai-jax estimate FILE.py:NAME`: the probability of a failure."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from verifai_jax.cli import arguments
from verifai_jax.cli.arguments import option
from verifai_jax.cli.exit_codes import BROKEN, INTERRUPTED, CommandError
from verifai_jax.cli.gates import RATE, Gate, check_gate, fail_on
from verifai_jax.cli.going_on import kept_until_done
from verifai_jax.cli.json_output import command, give_result, say, show_result

if TYPE_CHECKING:
    from verifai_jax import Estimate
ERRORS = option(
    "--errors", type=click.IntRange(1), metavar="PAIRS",
    help="Add how wrong the number can be, with this many pairs of simulations for each part.",
)  # fmt: skip


@command()
@arguments.TARGET
@option("--method", help="monte_carlo, importance, splitting or surrogate  [default: chosen]")
@option("--budget", default=50_000, help="Maximum simulations.")
@option("--p0", type=float, help="Failure probability to stay below.")
@option(
    "--simulations-are",
    type=click.Choice(["auto", "slow", "fast"]),
    default="auto",
    help="slow: a surrogate chooses a few hundred simulations.",
)
@option(
    "--within",
    type=float,
    help="With slow simulations, stop when both ends are within this factor.",
)
@option("--confidence", default=0.95)
@arguments.SEED
@arguments.ONLY
@arguments.BATCH
@arguments.MAX_SECONDS
@arguments.PRECISION
@arguments.BACKEND
@arguments.CLUSTER
@arguments.PROVED
@arguments.PLOT
@arguments.REPORT
@ERRORS
@fail_on(
    p0="unless the probability is shown to be below --p0",
    rate="unless it is shown to be at most P",
    counterexample="if any simulation failed",
)
def estimate(
    target: str, only: str | None, p0: float | None, cluster: str | None, plot: Path | None,
    report: Path | None, errors: int | None, fail_on: Gate | None, **options: Any,
) -> None:  # fmt: skip
    """Estimate the probability that TARGET (FILE.py:NAME) fails, with an interval and a bound."""
    from verifai_jax import estimate as run

    if fail_on is not None and fail_on.name == "p0" and p0 is None:
        raise click.UsageError("--fail-on p0 goes with --p0")
    if p0 is None and fail_on is not None:
        p0 = fail_on.bound
    problem = arguments.load_problem(target, only)
    with kept_until_done() as kept, arguments.on_cluster(cluster) as executor:
        found = run(problem, p0=p0, **arguments.values_of(options, executor=executor))
        show_result(found, plot)
        kept.stopped(found.stopped)
    budget = None
    if errors is not None:
        from verifai_jax import error_budget

        budget = error_budget(problem, found, pairs=errors)
        say(budget)
        give_result(errors=budget.table, error_low=budget.low, error_high=budget.high)
    if report is not None:
        path = found.report(report, problem=problem, errors=budget)
        say(f"  report       {path}")
    if not found.simulations:
        raise CommandError("interrupted before the first batch was finished", INTERRUPTED)
    if found.rest and found.prior_no_verdict == found.prior_simulations and not found.failures:
        raise CommandError(
            f"no simulation had a verdict, of {found.prior_simulations:,}: nothing is known of the "
            "probability; verifai-jax falsify says why",
            BROKEN,
        )
    failed = {"counterexample": found.failures > 0 or found.certain > 0}
    if p0 is not None:
        failed["p0"] = not _is_below(found, p0)
    if fail_on is not None and fail_on.bound is not None:
        failed[RATE] = not _is_below(found, fail_on.bound)
    check_gate(fail_on, failed)


def _is_below(found: "Estimate", p0: float) -> bool:
    """Return whether the bound or the interval shows a probability below `p0`."""
    return found.upper_bound <= p0 or (found.probability is not None and found.high < p0)
