"""`verifai-jax save-counterexamples runs/balance-1`, and `replay-counterexamples TARGET FOLDER`."""

from pathlib import Path

import click

import verifai_jax as vj
from verifai_jax.cli import arguments
from verifai_jax.cli.arguments import PATH, option
from verifai_jax.cli.gates import Gate, check_gate, fail_on
from verifai_jax.cli.json_output import command, give_result, say

CORPUS = Path("counterexamples")
"""Usual folder of a corpus."""


@command("save-counterexamples")
@arguments.RUN
@option("--into", type=PATH, default=CORPUS, help="Folder for the files, for version control.")
@option("--max-count", default=5, help="Maximum counterexamples.")
@option("--shrink/--no-shrink", default=True, help="Shrink each counterexample first.")
@option("--budget", default=1000, help="Simulations to shrink each one.")
@arguments.PROBLEM
def save_counterexamples(
    folder: Path, into: Path, max_count: int, shrink: bool, budget: int, target: str | None
) -> None:
    """Write counterexamples of the run in RUN as small files that can be replayed for ever."""
    run = arguments.load_judged_run(folder, target)
    paths = run.save_counterexamples(into, max_count=max_count, shrink=shrink, budget=budget)
    give_result(problem=run.name, files=paths)
    for path in paths:
        say(path)


@command("replay-counterexamples")
@arguments.TARGET
@click.argument("folder", metavar="FOLDER", type=PATH, default=CORPUS)
@option("--rename", multiple=True, metavar="OLD=NEW", help="Old and new name of a feature.")
@fail_on(counterexample="unless every one is simulated and fixed")
def replay_counterexamples(
    target: str, folder: Path, rename: tuple[str, ...], fail_on: Gate | None
) -> None:
    """Simulate the saved counterexamples in FOLDER (or one file) again, on TARGET as it is now."""
    names = dict(arguments.split_pairs("--rename", rename))
    result = vj.replay_counterexamples(arguments.load_problem(target), folder, rename=names)
    say(result)
    give_result(problem=result.problem, passed=result.passed, counterexamples=result.table)
    check_gate(fail_on, {"counterexample": not result.passed})
