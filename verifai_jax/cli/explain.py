"""`verifai-jax explain runs/balance-1`: the predicate that breaks, when, and why."""

from pathlib import Path

import click

from verifai_jax.cli.arguments import FOLDER, PICTURES, PROBLEM, ROW, RUN, load_judged_run
from verifai_jax.cli.json_output import command, give_result


@command()
@RUN
@ROW
@PROBLEM
@FOLDER
@PICTURES
def explain(
    folder: Path, row: int | None, target: str | None, into: Path | None, pictures: bool
) -> None:
    """Say why a ROW (by default the worst) of the run in RUN fails, and draw it."""
    import textwrap

    from verifai_jax import counterexamples
    from verifai_jax.core.text import printable

    run = load_judged_run(folder, target)
    why = counterexamples.explain(run, row)
    click.echo(textwrap.fill(printable(str(why)), 88, break_on_hyphens=False))
    influences = {one.name: why.effect(one) for one in why.influences}
    give_result(
        row=why.row,
        formula=why.formula,
        robustness=why.rho,
        text=str(why),
        effects=influences,
        simulations=why.simulations,
    )
    if pictures:
        path = (into or folder) / f"why-{why.row}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        why.plot(path)
        click.echo(f"  picture      {path}")
