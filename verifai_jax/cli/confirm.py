"""`verifai-jax confirm runs/balance-1`: counterexamples replayed at a finer step."""

from pathlib import Path

import verifai_jax as vj
from verifai_jax.cli.arguments import EVEN_IF_CHANGED, PROBLEM, ROW, RUN, load_judged_run, option
from verifai_jax.cli.exit_codes import check_again
from verifai_jax.cli.gates import Gate, check_gate, fail_on
from verifai_jax.cli.json_output import as_plain, command, give_result, say


@command()
@RUN
@ROW
@PROBLEM
@option(
    "--engine", "engines", multiple=True, metavar="NAME",
    help="Another backend of the system that has to agree, or `all`.",
)  # fmt: skip
@EVEN_IF_CHANGED
@fail_on(unconfirmed="if any is not confirmed", counterexample="if any is confirmed")
def confirm(
    folder: Path, row: int | None, target: str | None, engines: tuple[str, ...],
    even_if_changed: bool, fail_on: Gate | None,
) -> None:  # fmt: skip
    """Replay the counterexamples of the run in RUN, or its ROW, at a finer step."""
    run = load_judged_run(folder, target)
    result = vj.confirm(run, row, engines=engines or None)
    say(result)
    if isinstance(result, vj.Confirmation):
        confirmed, examined = int(result.confirmed), 1
    else:
        confirmed, examined = len(result.confirmed), len(result)
    transferable = None if result.transferable is None else confirmed
    counts = {"confirmed": confirmed, "examined": examined, "transferable": transferable}
    give_result(**counts, **as_plain(result))
    if isinstance(result, vj.Confirmations):
        give_result(counts=result.counts, rows=result.table)
    check_gate(fail_on, {"unconfirmed": confirmed < examined, "counterexample": confirmed > 0})
    check_again(result.finding, even_if_changed)
