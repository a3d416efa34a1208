"""`verifai-jax verify FILE.py:NAME`: which parts of the feature space are proved, or broken."""

from pathlib import Path
from typing import Any

import click

from verifai_jax.cli import arguments
from verifai_jax.cli.arguments import PATH, option
from verifai_jax.cli.gates import Gate, check_gate, fail_on
from verifai_jax.cli.json_output import command, give_result, say, show_result


@command()
@arguments.TARGET
@click.argument("rule", required=False, type=PATH)
@option("--budget", type=float, help="Approximate time in seconds  [default: 60]")
@option("--boxes", type=int, help="Maximum boxes to examine.")
@option("--samples", default=4096, help="Simulations of the undecided part.")
@option("--confidence", default=0.95)
@arguments.SEED
@arguments.ONLY
@arguments.PRECISION
@option("--continuous", is_flag=True, help="Verify the differential equation at all times.")
@option("--into", type=PATH, help="File for the result, or to continue.")
@arguments.PLOT
@arguments.REPORT
@arguments.PROGRESS
@fail_on(
    counterexample="if any box contains a point that fails for certain",
    undecided="unless the whole space is proved",
)
def verify(
    target: str, rule: Path | None, only: str | None, into: Path | None, plot: Path | None,
    report: Path | None, fail_on: Gate | None, **options: Any,
) -> None:  # fmt: skip
    """Divide the features of TARGET (FILE.py:NAME) into proved, broken and undecided boxes.

    With RULE, a property in VNN-LIB, TARGET is a network in ONNX. The answer is `holds`,
    `counterexample` with its inputs and outputs, or `unknown`.
    """
    from verifai_jax import Stop
    from verifai_jax import verify as run

    if (rule is None) == target.endswith(".onnx"):
        raise click.UsageError(
            "a network and a property go together: NETWORK.onnx PROPERTY.vnnlib, or FILE.py:NAME "
            "without a property"
        )
    if rule is not None:
        _of_network(target, rule, into, fail_on, options)
        return
    problem = arguments.load_problem(target, only)
    before = into if into is not None and into.exists() else None
    stop = Stop(seconds=options.pop("budget"))
    found = run(problem, resume=before, stop=stop, **options)
    show_result(found, plot, "name", "looked_at", "simulations", "seconds", "stopped", "notes")
    low, high = found.probability
    parts = {name: getattr(found, name)._asdict() for name in ("proved", "broken", "undecided")}
    give_result(**parts, failing_at_least=low, failing_at_most=high, formulas=found.formulas)
    if into is not None:
        say(f"  result       {found.save(into)}")
    if report is not None:
        say(f"  report       {found.report(report, problem=problem)}")
    failed = {"counterexample": found.broken.mass > 0, "undecided": found.proved.mass < 1}
    check_gate(fail_on, failed)


def _of_network(
    target: str, rule: Path, into: Path | None, fail_on: Gate | None, options: dict[str, Any]
) -> None:
    """Answer a property of a network alone."""
    from verifai_jax.addons.verification.network import verify_network

    known = ("budget", "boxes", "seed", "precision", "progress")
    given = {name: options[name] for name in known if options[name] is not None}
    found = verify_network(target, rule, **given)
    say(found.verdict)
    for name in ("inputs", "outputs"):
        numbers = getattr(found, name)
        if numbers is not None:
            say(f"  {name:12} {' '.join(f'{number:z.9g}' for number in numbers)}")
    say(f"  proved       {100 * found.proved:z.4g} % of the inputs")
    counterexample = None if found.inputs is None else found.inputs.tolist()
    give_result(verdict=found.verdict, counterexample=counterexample, proved=found.proved)
    if into is not None:
        say(f"  boxes        {found.save(into)}")
    failed = {"counterexample": found.verdict == "counterexample",
              "undecided": found.verdict != "holds"}  # fmt: skip
    check_gate(fail_on, failed)
