"""`verifai-jax harden specs/FILE.py:STUDY`: train a policy on its failures, and certify it."""

from pathlib import Path
from typing import Any

from verifai_jax.cli import arguments
from verifai_jax.cli.arguments import PATH, option
from verifai_jax.cli.gates import Gate, check_gate, fail_on
from verifai_jax.cli.json_output import command, draw, give_result, say


@command()
@arguments.TARGET
@option("--rounds", default=8, help="Maximum attacks.")
@option("--steps", type=int, help="Environment steps of the first training.")
@option(
    "--further-steps",
    type=int,
    help="Environment steps of each round  [default: an eighth of --steps]",
)
@option("--samples", default=512, help="Minimum number of samples of each certificate.")
@option("--attack", default="cross_entropy", help="Search used for attacks.")
@option("--attack-simulations", default=512, help="Simulations of each attack.")
@option("--confidence", default=0.95, help="Confidence of each certificate.")
@option("--baseline", is_flag=True, help="Train with plain domain randomisation as well.")
@arguments.SEED
@arguments.MAX_SECONDS
@option("--folder", type=PATH, help="Folder to write, or to continue  [default: runs/harden-NAME]")
@arguments.EVEN_IF_CHANGED
@arguments.PLOT
@arguments.PROGRESS
@fail_on(unsafe="unless the policy is shown to be safe")
def harden(
    target: str, folder: Path | None, plot: Path | None, fail_on: Gate | None, **options: Any
) -> None:
    """Train a policy of the study TARGET (FILE.py:NAME), train it on its failures, certify it."""
    from verifai_jax import Certification, FurtherTraining, Stop, Study
    from verifai_jax import harden as run
    from verifai_jax.addons.estimation.simultaneous_interval import safe_at
    from verifai_jax.core.user_code.targets import load_target

    study = load_target(target, Study)
    into = folder or Path("runs") / f"harden-{target.rpartition(':')[2]}"
    names = ("samples", "confidence", "attack", "attack_simulations")
    certified = Certification(**{name: options.pop(name) for name in names})
    further = FurtherTraining(steps=options.pop("further_steps"))
    stop = Stop(seconds=options.pop("max_seconds"))
    result = run(study, folder=into, further=further, certification=certified, stop=stop, **options)
    say(result)
    say(f"  policy       {into}")
    verdict = result.after.verdict
    give_result(
        problem=result.problem, table=result.table, verdict=verdict, stopped=result.stopped,
        folder=into,
    )  # fmt: skip
    if plot is not None:
        draw(result, plot)
    check_gate(fail_on, {"unsafe": verdict != safe_at(study.p)})
