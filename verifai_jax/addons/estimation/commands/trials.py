"""`verifai-jax trials FILE.py:NAME trials.csv`: the failure rate in reality, by trials."""

from pathlib import Path
from typing import Any

import click

from verifai_jax.cli import arguments
from verifai_jax.cli.arguments import PATH, option
from verifai_jax.cli.going_on import kept_until_done
from verifai_jax.cli.json_output import as_plain, command, give_result, say


@command()
@arguments.TARGET
@click.argument("trials", type=PATH, required=False)
@option("--simulations", default=10_000, help="Simulations of the prior.")
@option("--confidence", default=0.95)
@option("--allocated", is_flag=True, help="Trials were chosen by --next.")
@option(
    "--at-any-time", is_flag=True, help="Verdicts influenced when to stop, or which trials to make."
)
@option("--next", "count", type=int, help="Choose this many trials to make next.")
@option(
    "--sheet",
    type=PATH,
    metavar="HTML",
    help="Write a protocol of the next trials to print, and a CSV to fill in.",
)
@arguments.SEED
@arguments.PRECISION
@arguments.CLUSTER
def trials(
    target: str, trials: Path | None, count: int | None, sheet: Path | None, seed: int,
    cluster: str | None, **options: Any,
) -> None:  # fmt: skip
    """Estimate how often TARGET (FILE.py:NAME) fails in reality, by TRIALS and simulations.

    TRIALS is a CSV or Parquet file with a column for each feature, and `failed` (yes or no) or
    `recording` (a file of signals). Without it, --sheet plans the first trials.
    """
    from verifai_jax import RunOn, real_trials, trial_protocol

    problem = arguments.load_problem(target)
    if trials is None:
        if sheet is None:
            raise click.UsageError("give a file of trials, or --sheet HTML to plan the first ones")
        trial_protocol(problem, sheet, count or 20, seed=seed)
        say(f"sheet {sheet}, to fill in {sheet.with_suffix('.csv')}")
        return
    with kept_until_done(), arguments.on_cluster(cluster) as executor:
        found = real_trials(problem, trials, seed=seed, run_on=RunOn(executor=executor), **options)
    say(found)
    chosen = found.next_trials(count or 10, seed=seed) if count or sheet else None
    if chosen is not None:
        say(chosen.to_string(index=False))
    if sheet is not None:
        trial_protocol(problem, sheet, trials=chosen, seed=seed)
        say(f"sheet {sheet}, to fill in {sheet.with_suffix('.csv')}")
    give_result(
        rate=as_plain(found.rate), simulated=as_plain(found.simulated), wrong=len(found.wrong),
        notes=found.notes, next=None if chosen is None else chosen.to_dict("records"),
    )  # fmt: skip
