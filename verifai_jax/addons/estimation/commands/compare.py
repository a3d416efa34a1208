"""`verifai-jax compare specs/old.py:balance specs/new.py:balance --margin 0.002`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from verifai_jax.addons.estimation.commands.estimate import ERRORS
from verifai_jax.cli import arguments
from verifai_jax.cli.gates import Gate, check_gate, fail_on
from verifai_jax.cli.going_on import kept_until_done
from verifai_jax.cli.json_output import as_plain, command, give_result, say

if TYPE_CHECKING:
    from verifai_jax.addons.estimation.comparison.result import Compared


@command()
@arguments.TARGET
@click.argument("candidates", nargs=-1, required=True)
@click.option(
    "--margin",
    type=float,
    default=0.0,
    show_default=True,
    help="Largest difference of failure probabilities that does not matter.",
)
@click.option(
    "--confidence",
    type=float,
    default=0.95,
    show_default=True,
    help="Confidence of all verdicts together.",
)
@click.option("--budget", type=int, default=100_000, show_default=True, help="Maximum simulations.")
@click.option("--in-order", is_flag=True, help="Rows of scores are in the order of the trials.")
@arguments.SEED
@arguments.MAX_SECONDS
@arguments.CLUSTER
@arguments.REPORT
@ERRORS
@fail_on(regression="if a candidate fails more often, by more than the margin")
def compare(
    target: str, candidates: tuple[str, ...], cluster: str | None, report: Path | None,
    errors: int | None, fail_on: Gate | None, **options: Any,
) -> None:  # fmt: skip
    """Compare failure rates of CANDIDATES (specs/FILE.py:NAME) with that of TARGET, in pairs.

    specs/FILE.py:NAME@REVISION is the problem at a revision of git; the checkout is not touched.
    TARGET and the one candidate may be tables of scores (eval_info.json, CSV, Parquet, npz).
    """
    from verifai_jax import Problem
    from verifai_jax import compare as run_compare
    from verifai_jax.addons.estimation.comparison._compare_scores import compare_scores
    from verifai_jax.addons.estimation.comparison.score_tables import is_scores
    from verifai_jax.addons.estimation.revisions import load_at_revision

    if is_scores(target) and is_scores(candidates):
        if len(candidates) > 1:
            raise click.UsageError("a table of scores is compared with one other table")
        (other,), own = candidates, ("margin", "confidence", "in_order")
        scores = compare_scores((target, other), (target, other), cluster=None,
                                **{name: options[name] for name in own})  # fmt: skip
        say(scores)
        give_result(**as_plain(scores), verdict=scores.verdict, regression=scores.regression)
        return check_gate(fail_on, {"regression": scores.regression})
    if options.pop("in_order"):
        raise click.UsageError("--in-order goes with tables of scores")
    with kept_until_done() as kept, arguments.on_cluster(cluster) as executor:
        named = {name: name for name in candidates}
        result = run_compare(target, named, **arguments.values_of(options, executor=executor))
        say(result)
        kept.stopped(result.stopped)
    if errors is not None:
        from verifai_jax import error_budget

        with load_at_revision(target, Problem) as baseline:
            for one in result.candidates:
                with load_at_revision(one.name, Problem) as candidate:
                    found = error_budget(candidate, one, baseline=baseline, pairs=errors)
                say(found)
                give_result(**{f"errors of {one.name}": found.table})
    if report is not None:
        with load_at_revision(target, Problem) as baseline:
            path = result.report(report, problem=baseline)
        say(f"  report       {path}")
    give_result(
        baseline=result.baseline,
        verdict=result.verdict,
        regression=result.regression,
        candidates=list(map(stored_candidate, result.candidates)),
        simulations=result.simulations,
        stopped=result.stopped,
        seconds=result.seconds,
        seed=result.seed,
        notes=result.notes,
        sources=result.sources,
    )
    check_gate(fail_on, {"regression": result.regression})


def stored_candidate(one: "Compared") -> dict[str, Any]:
    """Return a candidate as JSON has it; `report.stored` reads it."""
    arm = one.undisturbed
    calm = arm and {"baseline_fails": arm[1], "candidate_fails": arm[2], **as_plain(arm[0])}
    return {
        "name": one.name, "verdict": one.verdict, "margin": one.margin,
        "difference": one.rates.estimate, "both_fail": one.both, **as_plain(one.rates),
        "undisturbed": calm,
    }  # fmt: skip
