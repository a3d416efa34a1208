"""`verifai-jax lint requirements.toml brakes.toml --on logs/`: requirements checked together."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

import verifai_jax as vj
from verifai_jax.addons.monitoring.commands.monitor_fleet import load_requirements
from verifai_jax.cli import arguments
from verifai_jax.cli.arguments import PATH, option
from verifai_jax.cli.gates import Gate, check_gate, fail_on
from verifai_jax.cli.json_output import command, give_result, show_result

if TYPE_CHECKING:
    from verifai_jax.addons.monitoring import Requirement


@command()
@click.argument("files", metavar="FILE...", nargs=-1, required=True)
@option("--on", "recordings", multiple=True, type=PATH, help="A recording, or a folder of them.")
@option("--unit", "units", multiple=True, metavar="SIGNAL=UNIT", help="Unit of a signal.")
@option(
    "--end", type=click.Choice(["hold", "truncate"]), default="hold",
    help="How a trace continues after the last sample.",
)  # fmt: skip
@arguments.NAMES
@fail_on(finding="if anything is suspicious")
def lint(
    files: tuple[str, ...], recordings: tuple[Path, ...], units: tuple[str, ...],
    end: Literal["hold", "truncate"], constants: tuple[str, ...], definitions: tuple[str, ...],
    fail_on: Gate | None,
) -> None:  # fmt: skip
    """Find requirements of all FILEs (or formulas) that contradict, repeat or imply each other, and
    what is suspicious about each.
    """
    names = arguments.read_names(constants, definitions)
    found: dict[str, Requirement] = {}
    for file in files:
        for each in load_requirements(file, *names):
            known = each.id if len(files) == 1 or each.id not in found else f"{each.id} ({file})"
            while known in found:
                known += "'"
            found[known] = dataclasses.replace(each, id=known)
    result = vj.mtl.lint(
        list(found.values()), recordings or None, end=end,
        units=dict(arguments.split_pairs("--unit", units)),
    )  # fmt: skip
    show_result(result, None, "recordings", "unread", "not_searched")
    give_result(findings=[finding._asdict() for finding in result])
    check_gate(fail_on, {"finding": bool(result)})
