"""`verifai-jax explain runs/balance-1`: the predicate that breaks, when, and why."""

from pathlib import Path

import click

from verifai_jax.cli import arguments
from verifai_jax.cli.exit_codes import check_again
from verifai_jax.cli.json_output import command, draw, give_result


@command()
@arguments.RUN
@arguments.ROW
@arguments.PROBLEM
@arguments.EVEN_IF_CHANGED
@arguments.FOLDER
@arguments.PICTURES
def explain(
    folder: Path,
    row: int | None,
    target: str | None,
    even_if_changed: bool,
    into: Path | None,
    pictures: bool,
) -> None:
    """Say why a ROW (by default the worst) of the run in RUN fails, and draw it."""
    import textwrap

    import verifai_jax as vj
    from verifai_jax.core.messages.text import printable

    run = arguments.load_judged_run(folder, target)
    why = vj.explain(run, row)
    for line in printable(str(why)).splitlines():
        click.echo(textwrap.fill(line, 88, break_on_hyphens=False))
    influences = {one.name: why.effect(one) for one in why.influences}
    give_result(
        row=why.row,
        formula=why.formula,
        robustness=why.rho,
        text=str(why),
        effects=influences,
        simulations=why.simulations,
        changed=why.replay.changed,
        finding=why.replay.finding,
    )
    if pictures:
        draw(why, (into or folder) / f"why-{why.row}.png")
    check_again(why.replay.finding, even_if_changed)
