"""`verifai-jax repair specs/tuning.py:gains --parameters k_x,k_theta`."""

from pathlib import Path
from typing import Any

from verifai_jax.addons.synthesis.commands.synthesize import PARAMETER_CHOICE
from verifai_jax.cli import arguments
from verifai_jax.cli.arguments import PATH, option
from verifai_jax.cli.gates import Gate, check_gate, fail_on
from verifai_jax.cli.going_on import kept_until_done
from verifai_jax.cli.json_output import command, draw, give_result, say, show_result


@command()
@arguments.TARGET
@option("--parameters", required=True, metavar="NAMES", help="Features to change, comma-separated.")
@option(
    "--nominal",
    "nominal",
    multiple=True,
    metavar="NAME=VALUE",
    help="Initial value of a parameter  [default: the problem's nominal value]",
)
@option("--run", "folder", type=PATH, help="Run with counterexamples to start from.")
@option("--budget", default=20_000, help="Maximum simulations.")
@option(
    "--estimate",
    type=int,
    help="Simulations for each of the failure probabilities before and after  [default: none]",
)
@PARAMETER_CHOICE
@arguments.PLOT
@fail_on(unsafe="unless the repair held in the check")
def repair(
    target: str, parameters: str, nominal: tuple[str, ...], folder: Path | None, budget: int,
    estimate: int | None, plot: Path | None, fail_on: Gate | None, **keywords: Any,
) -> None:  # fmt: skip
    """Remove the failures of TARGET (specs/FILE.py:NAME) by a small change of its parameters."""
    from verifai_jax import repair as run_repair

    problem = arguments.load_problem(target)
    with kept_until_done() as kept:
        result = run_repair(
            problem if folder is None else arguments.read_run(folder, problem),
            parameters,
            budget,
            nominal=arguments.plain_values("--nominal", nominal) or None,
            **arguments.values_of(keywords),
        )
        show_result(
            result, None, "before", "parameters", "robustness", "repaired", "change",
            "held_out_before", "held_out_after", "simulations", "stopped", "seed", "sources",
            "changed",
        )  # fmt: skip
        if estimate is not None:
            estimates = result.estimate(budget=estimate, seed=result.seed)
            say(estimates)
            give_result(estimate_before=estimates.before, estimate_after=estimates.after)
        kept.stopped(result.stopped)
    if plot is not None:
        draw(result, plot)
    check_gate(fail_on, {"unsafe": not result.repaired})
