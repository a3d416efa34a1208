"""`verifai-jax replay runs/balance-1 417`: one simulation of a run, again."""

from pathlib import Path

import click

from verifai_jax.cli import arguments
from verifai_jax.cli.arguments import option
from verifai_jax.cli.exit_codes import check_again
from verifai_jax.cli.gates import Gate, check_gate, fail_on
from verifai_jax.cli.json_output import command, give_result, say


@command()
@arguments.RUN
@arguments.ROW
@arguments.PROBLEM
@option(
    "--precision", type=click.Choice(["float32", "float64"]),
    help="[default: float64, and that of the run for a system that draws random numbers]",
)  # fmt: skip
@arguments.EVEN_IF_CHANGED
@arguments.FOLDER
@arguments.PICTURES
@fail_on(counterexample="if it violates the property, or has no verdict")
def replay(
    folder: Path, row: int | None, target: str | None, precision: str | None, even_if_changed: bool,
    into: Path | None, pictures: bool, fail_on: Gate | None,
) -> None:  # fmt: skip
    """Simulate a ROW (by default the worst) of the run in RUN again, and draw it."""
    from verifai_jax.core.messages.text import one_line, printable
    from verifai_jax.pictures import write_replay_pictures

    run = (arguments.load_judged_run if row is None else arguments.load_run)(folder, target)
    number = int(run.best.name) if row is None else row  # pyright: ignore[reportArgumentType]
    if precision is None:
        assert run.problem is not None
        precision = run.precision if run.problem.draws() else "float64"
    again = run.replay(number, precision)
    stored = run.table.row(number)
    for text in again.warnings:
        say(text)
    say(f"{run.name}, row {number}, {precision}")
    for name in run.table.features:
        value = stored[name]
        number_like = isinstance(value, (int, float)) or hasattr(value, "dtype")
        text = f"{value:z.6g}" if number_like else one_line(str(value))
        say(f"  {printable(name):<12} {text}")
    for name, rho in again.rho.items():
        say(f"  {run.formulas[name]}")
        # With several formulas `rho` is the least, and each has a column of its own.
        before = stored.get(f"rho.{name}", stored["rho"])
        say(f"    robustness {rho:z.6g} in {precision}, {before:z.6g} in the table")
    status = again.status.name.lower()
    say(f"  status {status}; {'violated' if again.violated else 'satisfied'}")
    features = {name: stored[name] for name in run.table.features}
    give_result(row=number, precision=precision, features=features, robustness=again.rho)
    give_result(stored_robustness=stored["rho"], status=status, violated=again.violated)
    changed = [change._asdict() for change in run.changes(number)]
    give_result(changed=changed, finding=again.finding)
    if pictures:
        for path in write_replay_pictures(again, into or folder):
            say(f"  picture      {path}")
    check_gate(fail_on, {"counterexample": again.violated or again.status.name != "OK"})
    check_again(again.finding, even_if_changed)
