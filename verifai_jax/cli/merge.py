"""`verifai-jax merge runs/balance-parts/*`: one run of the parts of a job array."""

from pathlib import Path

import click

from verifai_jax.cli import arguments
from verifai_jax.cli.arguments import PATH
from verifai_jax.cli.falsify import check_run, print_run
from verifai_jax.cli.gates import Gate, fail_on
from verifai_jax.cli.json_output import command
from verifai_jax.cli.next_folder import given_or_next


@command()
@click.argument("folders", metavar="PARTS...", nargs=-1, required=True, type=PATH)
@arguments.PROBLEM
@arguments.ONLY
@arguments.RUN_FOLDER
@arguments.PICTURES
@arguments.PROGRESS
@fail_on(
    counterexample="if a counterexample was found",
    rate="unless the failure rate is shown to be at most P; needs parts of --search uniform",
)
def merge(
    folders: tuple[Path, ...],
    target: str | None,
    only: str | None,
    folder: Path | None,
    pictures: bool,
    progress: bool | None,
    fail_on: Gate | None,
) -> None:
    """Make one run of PARTS, the folders that `falsify --shard` has written."""
    from verifai_jax.core.user_code.targets import target_of_project
    from verifai_jax.falsification.shards import merge as merge_parts
    from verifai_jax.falsification.shards import read_shard

    if target is None:
        target = target_of_project(
            read_shard(folders[0]).get("target"),
            folders[0],
            kind="problem",
            remedy="--problem specs/FILE.py:NAME",
        )
    problem = arguments.load_problem(target, only)
    with given_or_next(folder, "runs", problem.name) as path:
        run = merge_parts(folders, problem, folder=path, progress=progress)
    print_run(run, pictures)
    check_run(run, fail_on)
