"""`verifai-jax synthesize specs/tuning.py:first_order --parameters k`."""

from pathlib import Path
from typing import Any

import click

from verifai_jax.cli import arguments
from verifai_jax.cli.arguments import PATH, option
from verifai_jax.cli.gates import Gate, check_gate, fail_on
from verifai_jax.cli.going_on import kept_until_done
from verifai_jax.cli.json_output import command, say, show_result

PARAMETER_CHOICE = arguments.all_of(
    option(
        "--aim",
        type=click.Choice(("robustness", "probability")),
        default="robustness",
        help="Robustness against an attack, or the lowest failure probability.",
    ),
    option("--margin", default=0.0, help="Robustness wanted."),
    option("--attack", default="cross_entropy", help="Search used for attacks."),
    option("--held-out", default=2000, help="Fresh simulations to check the result."),
    option(
        "--mass",
        default=0.999,
        help="Probability of the central part of the prior that is attacked; 1 for all of it.",
    ),
    click.option(
        "--gradient/--no-gradient",
        default=None,
        help="Use gradients  [default: if the system has them]",
    ),
    arguments.SEED,
    arguments.MAX_SECONDS,
    arguments.BACKEND,
)
"""Options of `synthesize` and `repair`, for `values_of`."""


@command()
@arguments.TARGET
@option("--parameters", metavar="NAMES", help="Features to choose, comma-separated  [default: all]")
@option("--budget", default=10_000, help="Maximum simulations.")
@PARAMETER_CHOICE
@option("--table", type=PATH, metavar="CSV", help="Write the candidates into a CSV file.")
@fail_on(unsafe="unless the formula holds with the parameters, in the check too")
def synthesize(
    target: str, parameters: str | None, budget: int, table: Path | None, fail_on: Gate | None,
    **keywords: Any,
) -> None:  # fmt: skip
    """Find parameters for which TARGET (specs/FILE.py:NAME) holds, whatever its other features."""
    from verifai_jax import synthesize as run_synthesize

    problem = arguments.load_problem(target)
    with kept_until_done() as kept:
        result = run_synthesize(problem, parameters, budget, **arguments.values_of(keywords))
        show_result(
            result, None, "parameters", "robustness", "holds", "margin", "converged",
            "simulations", "without_verdict", "held_out", "stopped", "seed", "sources",
        )  # fmt: skip
        kept.stopped(result.stopped)
    if table is not None:
        from verifai_jax.core.store.atomic_files import replacing

        with replacing(table) as partial:
            result.candidates.to_csv(partial, index=False)
        say(f"  candidates   {table}")
    check_gate(fail_on, {"unsafe": not result.holds})
