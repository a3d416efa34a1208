"""`verifai-jax explain runs/balance-1`: the predicate that breaks, when, and why."""

from pathlib import Path

import verifai_jax as vj
from verifai_jax.cli import arguments
from verifai_jax.cli.exit_codes import check_again
from verifai_jax.cli.json_output import command, draw, give_result, say


@command()
@arguments.RUN
@arguments.ROW
@arguments.PROBLEM
@arguments.EVEN_IF_CHANGED
@arguments.FOLDER
@arguments.PICTURES
def explain(
    folder: Path, row: int | None, target: str | None, even_if_changed: bool, into: Path | None,
    pictures: bool,
) -> None:  # fmt: skip
    """Say why a ROW (by default the worst) of the run in RUN fails, and draw it."""
    import textwrap

    from verifai_jax.core.messages.text import printable

    run = arguments.load_judged_run(folder, target)
    why = vj.explain(run, row)
    for line in printable(str(why)).splitlines():
        say(textwrap.fill(line, 88, break_on_hyphens=False))
    give_result(row=why.row, formula=why.formula, robustness=why.rho, text=str(why))
    give_result(effects={one.name: why.effect(one) for one in why.influences})
    again = why.replay
    give_result(simulations=why.simulations, changed=again.changed, finding=again.finding)
    if pictures:
        draw(why, (into or folder) / f"why-{why.row}.png")
    check_again(again.finding, even_if_changed)
