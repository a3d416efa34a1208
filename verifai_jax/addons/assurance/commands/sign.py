"""`verifai-jax sign brake.html --key key.pem`: the signed manifest of a report."""

from pathlib import Path

import click

from verifai_jax.cli.arguments import PATH, option
from verifai_jax.cli.json_output import command, give_result, say


@command()
@click.argument("report", metavar="REPORT.html", type=PATH)
@click.argument("files", metavar="[FILE...]", nargs=-1, type=PATH)
@option("--key", type=PATH, required=True, help="File of a private key (PEM, Ed25519).")
def sign(report: Path, files: tuple[Path, ...], key: Path) -> None:
    """Sign REPORT.html, its claims, and FILEs or folders within its folder.

    Whoever has the public key checks them with verify_report.py, which needs Python alone.
    """
    from verifai_jax.addons.assurance import verify_report
    from verifai_jax.addons.assurance.signing import sign_report

    path = sign_report(report, key, files)
    say(f"  manifest     {path}")
    say(f"  check it     python {verify_report.__file__} {path} --key PUBLIC.pem")
    give_result(manifest=path)
