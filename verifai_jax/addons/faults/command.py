"""`verifai-jax fmea FILE.py:NAME`: the failure table of a problem with faults."""

from pathlib import Path
from typing import Any

from verifai_jax.cli import arguments
from verifai_jax.cli.arguments import PATH, option
from verifai_jax.cli.json_output import command, draw, give_result, say


@command()
@arguments.TARGET
@option("--rate", type=float, help="Rate of each fault per hour.")
@option("--mission-time", type=float, help="Duration of a mission in hours.")
@option("--samples", default=512, help="Simulations of each fault.")
@option(
    "--budget", default=2000, help="Simulations of the search for faults whose samples do not fail."
)
@option("--pairs/--no-pairs", default=True, help="Try pairs of faults.")
@option("--confidence", default=0.95)
@option("--detector", help="Formula that is true while a detector on board gives an alarm.")
@option("--words", type=PATH, help="CSV file: fault, component, cause, effect, severity, ...")
@option("--xlsx", type=PATH, help="Write the sheet of an FMEA.")
@arguments.SEED
@option("--folder", type=PATH, help="Folder to write, or to continue  [default: runs/fmea-NAME]")
@arguments.PLOT
@arguments.PROGRESS
def fmea(
    target: str, folder: Path | None, plot: Path | None, words: Path | None, xlsx: Path | None,
    **options: Any,
) -> None:  # fmt: skip
    """Tabulate the effect and the probability of each fault of TARGET (FILE.py:NAME)."""
    from verifai_jax import fmea as run

    problem = arguments.load_problem(target)
    into = folder or Path("runs") / f"fmea-{target.rpartition(':')[2]}"
    found = run(problem, folder=into, **options)
    say(found)
    found.to_csv(into / "fmea.csv")
    say(f"  table        {into / 'fmea.csv'}")
    for effect in found:
        if effect.row is not None:
            say(f"  {effect.name}: {effect.command}")
    if xlsx is not None or words is not None:
        sheet = found.sheet(words)
        say(f"  sheet        {sheet.to_csv(into / 'sheet.csv')}")
        if xlsx is not None:
            say(f"  sheet        {sheet.to_xlsx(xlsx)}")
    give_result(
        name=found.name, effects=found.effects, healthy=found.healthy,
        false_alarms=found.false_alarms,
    )  # fmt: skip
    if plot is not None:
        draw(found, plot)
