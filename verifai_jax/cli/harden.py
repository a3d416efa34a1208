"""`verifai-jax harden specs/FILE.py:STUDY`: train a policy where it fails, and certify it."""

from pathlib import Path
from typing import Any

import click

from verifai_jax.cli import arguments
from verifai_jax.cli.gates import Gate, check_gate, fail_on
from verifai_jax.cli.json_output import command, draw, give_result


@command()
@arguments.TARGET
@click.option("--rounds", type=int, default=8, show_default=True, help="Attacks, at most.")
@click.option("--steps", type=int, help="Environment steps of the first training.")
@click.option("--further-steps", type=int, help="Of each round  [default: an eighth of --steps]")
@click.option("--samples", type=int, default=512, show_default=True, help="Of each certificate.")
@click.option("--attack", default="cross_entropy", show_default=True, help="Search that attacks.")
@click.option("--attack-simulations", type=int, default=512, show_default=True)
@click.option("--confidence", type=float, default=0.95, show_default=True)
@click.option("--baseline", is_flag=True, help="Train with plain domain randomisation as well.")
@arguments.SEED
@arguments.MAX_SECONDS
@click.option(
    "--folder",
    type=click.Path(path_type=Path),
    help="Folder to write, and to go on in  [default: runs/harden-NAME]",
)
@arguments.EVEN_IF_CHANGED
@arguments.PLOT
@arguments.PROGRESS
@fail_on(unsafe="unless the policy is shown to be safe")
def harden(
    target: str, folder: Path | None, plot: Path | None, fail_on: Gate | None, **options: Any
) -> None:
    """Train a policy of the study TARGET (FILE.py:NAME), go on where it fails, certify it."""
    from verifai_jax import Study
    from verifai_jax import harden as run
    from verifai_jax.core.targets import load_target
    from verifai_jax.core.text import printable
    from verifai_jax.statistics.confidence_sequences import safe_at

    study = load_target(target, Study)
    into = folder or Path("runs") / f"harden-{target.rpartition(':')[2]}"
    result = run(study, folder=into, **options)
    click.echo(printable(str(result)))
    click.echo(f"  policy       {into}")
    verdict = result.after.verdict
    give_result(
        problem=result.problem, table=result.table, verdict=verdict, stopped=result.stopped,
        folder=into,
    )  # fmt: skip
    if plot is not None:
        draw(result, plot)
    check_gate(fail_on, {"unsafe": verdict != safe_at(study.p)})
