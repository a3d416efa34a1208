"""`verifai-jax fuzz specs/handover.py:handover --stop-after 1`: search guided by coverage."""

from functools import partial
from pathlib import Path
from typing import Any

import click

from verifai_jax.cli import arguments
from verifai_jax.cli.arguments import option
from verifai_jax.cli.falsify import print_run
from verifai_jax.cli.gates import Gate, check_gate, fail_on
from verifai_jax.cli.json_output import command
from verifai_jax.cli.next_folder import given_or_next


@command()
@arguments.TARGET
@option("--budget", default=10_000, help="Maximum simulations.")
@option(
    "--cells",
    multiple=True,
    metavar="SIGNAL=LOW:HIGH:COUNT",
    help="Cells of a signal to cover  [default: the problem's behaviour]",
)
@arguments.BATCH
@arguments.SEED
@arguments.MAX_SECONDS
@arguments.STOP_AFTER
@arguments.PRECISION
@arguments.BACKEND
@arguments.RUN_FOLDER
@arguments.KEEP_GOING
@arguments.PICTURES
@arguments.PROGRESS
@fail_on(counterexample="if a counterexample was found")
def fuzz(
    target: str, cells: tuple[str, ...], folder: Path | None, pictures: bool, fail_on: Gate | None,
    **options: Any,
) -> None:  # fmt: skip
    """Look for failures of TARGET (specs/FILE.py:NAME) by covering its possible behaviour."""
    from verifai_jax import fuzz as run_fuzz

    chosen = {name: _cells(name, text) for name, text in arguments.split_pairs("--cells", cells)}
    problem = arguments.load_problem(target)
    ends = {"--max-seconds": options["max_seconds"], "--stop-after": options["stop_after"]}
    goes_on = partial(arguments.resuming, "falsify", target=target, options=ends)
    with given_or_next(folder, "runs", problem.name, goes_on) as path:
        values = arguments.values_of(options)
        run = run_fuzz(problem, cells=chosen or None, folder=path, **values)
    print_run(run, pictures, ends)
    check_gate(fail_on, {"counterexample": run.table.counts.may_fail})


def _cells(name: str, text: str) -> tuple[float, float, int]:
    """Read LOW:HIGH:COUNT."""
    try:
        low, high, count = text.split(":")
        return float(low), float(high), int(count)
    except ValueError:
        raise click.UsageError(
            f"--cells {name} must be LOW:HIGH:COUNT, such as 0:30:6; got {text!r}"
        ) from None
