"""The report on a failure table: the effect of each fault, its probability, and its replay."""

from verifai_jax.addons.faults.failure_table.result import Effect, FailureTable
from verifai_jax.addons.reports.claims import Claim
from verifai_jax.addons.reports.markup import paragraph, picture, preformatted, table
from verifai_jax.addons.reports.page import Page
from verifai_jax.addons.reports.provenance import Model
from verifai_jax.addons.reports.run_question import About
from verifai_jax.addons.reports.run_report import run_inputs
from verifai_jax.addons.reports.sections import MODEL, problem_content, result_page
from verifai_jax.addons.reports.studies import png
from verifai_jax.core.messages.text import format_percent, format_seconds
from verifai_jax.problem.problem import Problem

NOMINAL = "All features that are not of the faults of a row are nominal."
INDEPENDENT = "A fault happens at its rate, in a mission once at most, and independently of others."
SAMPLED = "The numbers of a fault are independent samples of its prior, given that it happens."


def failure_table_page(found: FailureTable, about: About, problem: Problem | None) -> Page:
    """Make the report on a table of a problem with faults, that of its run if it has one."""
    run, sure = found.run, format_percent(found.confidence)
    problem = problem if run is None else run.problem
    about.check(None if problem is None else problem.space)
    model = Model.of(() if run is None else run.sources, problem and problem.sources())
    failing = [each for each in found if each.fails]
    assumed = (MODEL, NOMINAL, SAMPLED, *([] if found.rate is None else [INDEPENDENT]))
    when = "in a mission" if found.rate is not None else "given that it happens"
    headline = (
        f"{len(failing):,} of {len(found):,} faults and pairs break the property; "
        f"{sum(each.confirmed for each in failing):,} of these are confirmed."
    )
    claims = [
        Claim(f"C{i + 1}", _sentence(each, when, sure), (_samples(each), each.command), assumed)
        for i, each in enumerate(found)
    ]
    heads = ["fault", "fails from", "breaks", "after the onset", "shown by", "probability", "low",
             "high", "verdict"]  # fmt: skip
    heads += [] if found.false_alarms is None else ["missed by the detector"]
    rows = [
        (
            each.name, each.severity_text, each.broken,
            format_seconds(each.delay, 3) if each.broken else "", each.shown_by,
            f"{each.probability:z.2g}", f"{each.low:z.2g}", f"{each.high:z.2g}",
            each.verdict or "no failure found",
            *([] if each.detection is None else [str(each.detection.missed)]),
        )
        for each in found
    ]  # fmt: skip
    commands = [f"{each.name}: {each.command}" for each in failing if each.command]
    limits = ["A fault without a failure may fail in ways that no sample and no search met."]
    if not found.healthy:
        limits.append("The nominal features break the property without any fault.")
    if found.false_alarms is not None:
        limits.append(f"The detector gives false alarms: {found.false_alarms}.")
    return result_page(
        found.name,
        "failure modes and effects of faults",
        headline,
        "fails" if failing else "open",
        claims,
        model,
        answers=[
            ("How probable is it?", f"see the table: {when}, {sure} intervals", "found"),
            ("What does it rest on?", SAMPLED, "limits"),
        ],
        asked=[
            paragraph(
                f"What each fault of {found.name} does, and each pair of those that do not fail "
                "alone."
            ),
            *([] if problem is None else problem_content(problem, about)),
        ],
        found=[
            table(heads, rows, f"Probabilities {when}, with {sure} intervals"),
            picture(png(found.plot()), "The probability of each row with its interval"),
        ],
        limits=[*limits, *assumed],
        reproduce=[preformatted("\n".join(commands))],
        files=[] if run is None else run_inputs(run),
    )


def _sentence(effect: Effect, when: str, sure: str) -> str:
    chance = f"{effect.probability:z.2g} ({sure} interval {effect.low:z.2g} to {effect.high:z.2g})"
    if not effect.fails:
        return f"No failure by {effect.name} was found; its probability {when} is {chance}."
    return f"{effect.name} breaks the property with probability {chance} {when}."


def _samples(effect: Effect) -> str:
    return f"{effect.failures:,} failures in {effect.simulations:,} samples of the prior"
