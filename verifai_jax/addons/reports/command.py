"""`verifai-jax report runs/balance-1`: the evidence report on a folder of results."""

from pathlib import Path
from typing import Any

import click

from verifai_jax.cli import arguments
from verifai_jax.cli.arguments import PATH, option
from verifai_jax.cli.json_output import command, give_result, say


@command()
@click.argument("folder", metavar="FOLDER", type=PATH)
@arguments.PROBLEM
@option(
    "--output",
    type=PATH,
    metavar="HTML",
    help="File to write  [default: report.html in the folder]",
)
@option("--unit", "units", multiple=True, metavar="FEATURE=UNIT", help="Unit of a feature.")
@option(
    "--reason", "reasons", multiple=True, metavar="FEATURE=TEXT",
    help="Reason for the range of a feature.",
)  # fmt: skip
@option("--traces", type=int, help="Maximum rows simulated for the report  [default: chosen]")
@click.option(
    "--studies/--no-studies",
    default=None,
    help="Explain and shrink the worst failure  [default: unless it takes long]",
)
@option(
    "--modes",
    type=int,
    metavar="SIMULATIONS",
    help="Add all modes of failure and their probabilities, with this many simulations.",
)
@arguments.ODD
@option(
    "--section",
    "sections",
    multiple=True,
    metavar="NAME",
    help="Add a section of an installed package, by its entry point in verifai_jax.sections.",
)
@option(
    "--assessment",
    is_flag=True,
    help="Add the claims as a tree, boxes on credibility, and a page to be signed.",
)
@option(
    "--without-problem",
    is_flag=True,
    help="Simulate nothing: report only the content of the folder.",
)
def report(
    folder: Path,
    target: str | None,
    output: Path | None,
    units: tuple[str, ...],
    reasons: tuple[str, ...],
    odd: Path | None,
    sections: tuple[str, ...],
    without_problem: bool,
    **options: Any,
) -> None:
    """Write the evidence report on a run or a sweep: one HTML file, and its claims as JSON.

    FOLDER may also be a file that `estimate --json`, `compare --json` or `verify --into` wrote.
    """
    from verifai_jax.addons.reports.document import claims_path, write_report
    from verifai_jax.core.display.extensions import extension

    problem, output = None, output or folder / "report.html"
    if folder.is_file():
        from verifai_jax.addons.reports.stored import read_result

        problem = None if target is None else arguments.load_problem(target)
        result = read_result(folder, None if problem is None else problem.space)
        output = folder.with_suffix(".html") if output == folder / "report.html" else output
    elif arguments.is_sweep(folder):
        from verifai_jax import load_sweep

        result = load_sweep(folder)
    elif without_problem:
        result = arguments.read_run(folder)
    else:
        result = arguments.load_run(folder, target)
    if odd is not None:
        from verifai_jax import read_odd
    path = write_report(
        result,
        output,
        units=dict(arguments.split_pairs("--unit", units)),
        reasons=dict(arguments.split_pairs("--reason", reasons)),
        odd=None if odd is None else read_odd(odd),
        sections=[extension("verifai_jax.sections", name)(result) for name in sections],
        problem=problem,
        files=[folder] if folder.is_file() else [],
        **options,
    )
    give_result(report=path, claims=claims_path(path))
    say(f"  report       {path}")
    say(f"  claims       {claims_path(path)}")
