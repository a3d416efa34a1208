"""`verifai-jax trace specs/brake.py`: the evidence for each requirement, and broken links."""

from pathlib import Path

import click

from verifai_jax.cli.arguments import PATH, option
from verifai_jax.cli.gates import Gate, check_gate, fail_on
from verifai_jax.cli.json_output import command, give_result, say

FOLDER = PATH


@command()
@click.argument("targets", metavar="FILE.py...", nargs=-1, required=True)
@option(
    "--requirements", type=FOLDER, help="File of requirements  [default: those of the problems]"
)
@option("--tests", type=FOLDER, multiple=True, help="Files or folders of tests  [default: tests]")
@option("--runs", type=FOLDER, multiple=True, help="Folders of runs  [default: runs]")
@option(
    "--reports", type=FOLDER, multiple=True, help="Files or folders of reports  [default: reports]"
)
@option(
    "--results",
    type=FOLDER,
    multiple=True,
    help="Files of pytest --junitxml, or folders of them  [default: junit.xml]",
)
@option(
    "--without",
    multiple=True,
    type=click.Choice(["tests", "runs", "reports"]),
    help="Kind of link that is not required.",
)
@option("--csv", type=FOLDER, help="File to write the table to.")
@option("--report", type=FOLDER, help="HTML file to write.")
@fail_on(
    missing="if a link is missing",
    suspect="if a link is suspect",
    incomplete="if a link is missing or suspect",
    unmet="if a requirement is violated, not run, skipped or in error, or a link is suspect",
)
def trace(
    targets: tuple[str, ...],
    requirements: Path | None,
    tests: tuple[Path, ...],
    runs: tuple[Path, ...],
    reports: tuple[Path, ...],
    results: tuple[Path, ...],
    without: tuple[str, ...],
    csv: Path | None,
    report: Path | None,
    fail_on: Gate | None,
) -> None:
    """Follow each requirement of the problems in FILE.py to its tests, runs, claims and reports.

    Files of problems, and of tests, are run for that. pyproject.toml's vj_specs are tests too.
    """
    from verifai_jax import trace_matrix

    asked = {
        "tests": [*(tests or _usual("tests")), *_tested_files()],
        "runs": list(runs or _usual("runs")),
        "reports": list(reports or _usual("reports")),
    }
    found = trace_matrix(
        targets,
        requirements=requirements,
        results=results or [each for each in [Path("junit.xml")] if each.is_file()],
        **{name: None if name in without else given for name, given in asked.items()},
    )
    say(found)
    for name, path, write in (("table", csv, found.to_csv), ("report", report, found.report)):
        if path is not None:
            say(f"  {name:<12} {write(path)}")
    give_result(
        complete=found.complete,
        gaps=[gap._asdict() for gap in found.gaps],
        rows=[{**row._asdict(), "outcome": row.outcome} for row in found.rows],
    )
    missing, suspect = bool(found.missing), bool(found.suspect)
    failed = {"missing": missing, "suspect": suspect, "incomplete": missing or suspect}
    failed["unmet"] = suspect or bool(found.unmet)
    check_gate(fail_on, failed)


def _usual(name: str) -> list[Path]:
    return [Path(name)] if Path(name).is_dir() else []


def _tested_files() -> list[Path]:
    """Return the files of problems that the configuration of pytest says are tests."""
    from verifai_jax.core.store.foreign_files import parse_toml, read_text

    file = Path("pyproject.toml")
    if not file.is_file():
        return []
    try:
        options = parse_toml(read_text(file)).get("tool", {}).get("pytest", {})
    except ValueError as error:
        raise ValueError(f"{file} is not TOML: {error}") from None
    patterns = options.get("ini_options", {}).get("vj_specs", [])
    patterns = patterns.split() if isinstance(patterns, str) else patterns
    return sorted({path for pattern in patterns for path in Path().glob(str(pattern))})
