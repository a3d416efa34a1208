"""Findings of a run: numbers, failures with pictures, reasons, smallest departure, analysis."""

import math
from collections.abc import Iterable

from verifai_jax.addons.reports.markup import (
    Child,
    Markup,
    bullets,
    element,
    paragraph,
    picture,
    preformatted,
    table,
)
from verifai_jax.addons.reports.page import Section
from verifai_jax.addons.reports.run_question import About
from verifai_jax.addons.reports.studies import Failure, Studies, png
from verifai_jax.core.messages.errors import UnknownNameError
from verifai_jax.core.messages.text import format_percent
from verifai_jax.evaluation.confirmations import MEANING, VERDICTS
from verifai_jax.falsification.no_rate import what_lies_between, why_no_rate
from verifai_jax.falsification.run import Run
from verifai_jax.falsification.run_folder import replay_command
from verifai_jax.falsification.summary import first_message
from verifai_jax.features.density import tails
from verifai_jax.features.english import number
from verifai_jax.pictures.scatter import plot_features

DRAWN = ("clusters", "importance", "coverage")
"""Analyses of the table that a report draws."""
MAX_FEATURES = 40
"""Features of a failure that are listed one by one."""
_AGAIN = "Each can be simulated again from its row, bit for bit."
_NOT_AGAIN = "Not all rows give their numbers when they are simulated again."


def findings(run: Run) -> Section:
    """Write the findings in numbers."""
    content = [table(["number", "value"], number_rows(run))]
    content += [element("h3", "The summary, as the tool prints it"), preformatted(run.summary())]
    return Section("found", "What was found", tuple(content))


def number_rows(run: Run) -> list[tuple[str, Child]]:
    """Return the numbers of a run, each with its description."""
    counts = run.table.counts
    rows: list[tuple[str, Child]] = [
        ("simulations", f"{run.simulations:,}"),
        ("without a verdict", f"{counts.without_verdict:,}"),
        ("violating, as simulated", f"{counts.violating:,}"),
    ]
    for verdict in VERDICTS:
        if count := run.verdict_counts.get(verdict):
            rows.append((f"of these {verdict}", f"{count:,} ({MEANING[verdict]})"))
    if counts.repetitions.moved or counts.repetitions.rounded:
        rows.append(("simulated again", str(counts.repetitions)))
    rows.append(("claimed as failures", f"{counts.claimed:,}"))
    rows.append(("not claimed: closer replays do not agree", f"{counts.refused:,}"))
    rows.append(("not claimed: not replayed", f"{counts.not_replayed:,}"))
    if run.checked and run.verdict_counts.get("confirmed"):
        rows.append(("a confirmed failure fails", run.checked))
    if run.failure_rate is not None:
        rows.append(("failure rate, as simulated", str(run.failure_rate)))
        if run.confirmed_failure_rate is not None:
            rows.append(("failure rate, confirmed", str(run.confirmed_failure_rate)))
    else:
        rows.append(("failure rate", no_rate(run)))
    for name in run.formulas if len(run.formulas) > 1 else ():
        rows.append((f"property {name} fails in", f"{counts.failing_alone[name]:,}"))
    return rows


def no_rate(run: Run) -> str:
    """Explain why a run has no failure rate."""
    if not run.prior:
        return f"not given: {why_no_rate(run)}, so that the rows are no sample of the prior"
    return "not given: no simulation has a verdict"


def failures(run: Run, studies: Studies, about: About) -> Section:
    """Write a few failures with their values, pictures and the commands that repeat them."""
    shown = studies.failures
    if not shown:
        nothing = paragraph("The run claims no failure, so there is none to show.")
        return Section("failures", "Failures", (nothing,))
    claimed = run.table.counts.claimed
    more = f" Of {claimed:,} failures {len(shown)} are shown." if claimed > len(shown) else ""
    content = [
        paragraph(f"{_AGAIN if not studies.findings else _NOT_AGAIN}{more}"),
        *(_failure(run, each, studies, about) for each in shown),
    ]
    return Section("failures", "Failures, one by one", tuple(content))


def _failure(run: Run, failure: Failure, studies: Studies, about: About) -> Markup:
    row = run.table.row(failure.row).to_dict()
    features = list(run.table.features)
    # Control points of signals by their time.
    labels = {} if run.problem is None else run.problem.space.labels(run.problem.duration)
    rare = _improbability(run, failure.row)
    values, heads = [], ["feature", "value", *(["the prior has one as far out in"] if rare else [])]
    for name in features[:MAX_FEATURES]:
        value = f"{number(row[name])} {about.units.get(name, '')}".strip()
        share = [format_percent(rare[name]) if name in rare else ""] if rare else []
        values.append((labels.get(name, name), value, *share))
    verdict = str(row.get("verdict", "") or "not looked at more closely")
    meaning = f", {MEANING[verdict]}" if verdict in MEANING else ""
    content: list[Child] = [
        element("h3", f"Failure {failure.number}: row {failure.row}, {failure.why}"),
        paragraph(f"Robustness {float(row['rho']):z.6g}; closer replays: {verdict}{meaning}."),
        *(paragraph(text) for text in (failure.replay.warnings if failure.replay else ())),
        table(heads, values),
    ]
    if len(features) > MAX_FEATURES:
        content.append(paragraph(f"{len(features) - MAX_FEATURES} further features are left out."))
    if len(run.formulas) > 1:
        margins = [(name, number(row[f"rho.{name}"])) for name in run.formulas]
        content.append(table(["property", "robustness"], margins))
    if failure.replay is not None and run.problem is not None:
        # The first with all signals, the others with those that the property speaks of.
        own = [name for name in run.problem.monitored if name in failure.replay.trace.signals]
        signals = None if failure.number == 1 or not own else own
        words = f"Signals of row {failure.row} over time, with bounds and the deciding instant"
        content.append(picture(png(failure.replay.plot(signals=signals)), words))
    if failure.number == 1 and studies.animation is not None:
        caption = f"Row {failure.row} as an animation"
        content.append(picture(studies.animation, caption, kind="gif"))
    content += [paragraph("To see it again:"), preformatted(replay_command(run, failure.row))]
    return element("div", content, class_="failure", id=f"failure-{failure.number}")


def _improbability(run: Run, number: int) -> dict[str, float]:
    """Return how probable a value as far out is, for each column of a failure that says it."""
    try:
        columns = {str(name): [value] for name, value in run.table.row(number).items()}
        found = tails(run.space, columns)
    except ValueError:
        return {}  # The record does not describe the space.
    return {name: float(tail[0]) for name, tail in found.items() if tail[0] == tail[0]}


def reasons(studies: Studies) -> Section | None:
    """Write why the worst failure fails, and the smallest departure that still fails."""
    content: list[Markup] = []
    if (why := studies.explained) is not None:
        content += [
            element("h3", "The reason of failure 1"),
            *map(paragraph, str(why).splitlines()),
            picture(png(why.plot()), "The deciding signal, and the features that matter"),
        ]
    if (small := studies.shrunk) is not None:
        content += [
            element("h3", "Failure 1, shrunk"),
            preformatted(str(small)),
            picture(png(small.plot()), "What departs from nominal, and the signal that fails"),
        ]
    return Section("reasons", "Why it fails", tuple(content)) if content else None


def analysis(studies: Studies) -> Section:
    """Write the analyses of the table: rules, importance, kinds of failures, coverage."""
    found = studies.analysis
    content: list[Markup] = []
    if found.samples is not None:
        words = "Failures over the two most important features, with rules"
        content.append(picture(png(found.plot()), words))
    for part in found.parts[1:]:
        content += [element("h3", part.title), preformatted(part.words)]
        if part.name in DRAWN and hasattr(part.result, "plot"):
            content.append(picture(png(part.result.plot()), part.title))
    return Section("analysis", "What the failures have in common", tuple(content))


def explore(run: Run, view: dict, studies: Studies) -> Section:
    """Write the element of the interactive table, with its replacement without JavaScript."""
    shown, all_rows, features = view["shown"], run.simulations, run.table.features
    thinned = f"All {shown:,} rows are shown."
    if shown < all_rows:
        thinned = f"Of {all_rows:,} rows {shown:,} are shown, spread evenly over each verdict."
    if hidden := len(features) - sum(column["name"] in features for column in view["columns"]):
        thinned += f" {hidden} of {len(features)} features are left out."
    thinned += (
        " With JavaScript, a row under the pointer shows its values, and a click its trace: "
        f"{len(studies.traces)} rows were simulated beforehand."
    )
    still = picture(png(plot_features(run)), "Simulations over pairs of features, by verdict")
    # Without JavaScript the first stays hidden, and the picture is there.
    hidden_view = Markup('<div id="explore" hidden></div>')
    content = paragraph(thinned), hidden_view, element("div", still, id="still")
    return Section("table", "The table, to look at", content)


def not_claimed_rows(run: Run, maximum: int = 20) -> Iterable[Child]:
    """Write the rows that violate as simulated but that closer replays did not confirm."""
    rows = run.table.unconfirmed.sort_values("rho")
    for row_number, row in rows.head(maximum).to_dict("index").items():
        again = float(row.get("rho_again", math.nan))
        then = "" if math.isnan(again) else f", {again:z.4g} when simulated again"
        yield f"row {row_number}: {row.get('verdict', '')}, robustness {row['rho']:z.4g}{then}"
    if len(rows) > maximum:
        yield f"and {len(rows) - maximum:,} more"


def limits(run: Run, studies: Studies, assumptions: list[str]) -> Section:
    """Write the limits of the results, and the assumptions of each interval."""
    content = [
        element("h3", "Not sampled"),
        bullets(not_sampled(run, studies)),
        element("h3", "Without a verdict"),
        *_without_verdict(run),
        element("h3", "Not confirmed"),
        *_not_confirmed(run),
        element("h3", "Assumptions"),
        bullets(assumptions),
    ]
    notes = [*run.notes, *([f"Damaged: {run.damage}"] if run.damage else [])]
    if notes:
        content += [element("h3", "Decided or noticed by the tool"), bullets(notes)]
    if studies.left_out:
        content += [element("h3", "Left out of this report"), bullets(studies.left_out)]
    return Section("limits", "What was not shown", tuple(content))


def not_sampled(run: Run, studies: Studies) -> list[str]:
    """Write which inputs no simulation covered."""
    items = [
        "Values outside of the ranges above: nothing is known of them.",
        "Whatever the system does not take from the features, such as other disturbances, parts "
        "and faults: it is as the model fixes it.",
        what_lies_between(run),
    ]
    try:
        covered = studies.analysis["coverage"] if studies.analysis.samples is not None else None
    except UnknownNameError:
        covered = None
    if covered is not None:
        items += [line.strip() for line in str(covered).splitlines()[:1]]
    return items


def _without_verdict(run: Run) -> list[Markup]:
    counts = run.table.counts
    if not counts.without_verdict:
        return [paragraph("Every simulation ended with a verdict.")]
    listed = ", ".join(f"{count:,} {status}" for status, count in counts.failed.items())
    content = [
        paragraph(
            f"{counts.without_verdict:,} of {run.simulations:,} simulations have no verdict "
            f"({listed}). They are neither safe nor failing: each interval takes them for safe at "
            "its lower end and for failing at its upper end."
        )
    ]
    if (first := first_message(run)) is not None:
        content.append(paragraph(f"The first message, of row {first[0]}:"))
        content.append(preformatted(first[1][:2000]))
    return content


def _not_confirmed(run: Run) -> list[Markup]:
    counts, verdicts = run.table.counts, run.verdict_counts
    if not counts.violating:
        return [paragraph("There was no violation to confirm.")]
    if not run.confirm:
        return [paragraph("Violations were not replayed more closely: all are as simulated.")]
    if counts.claimed == counts.violating:
        return [paragraph("Every violation was confirmed.")]
    listed = "; ".join(
        f"{verdicts[v]:,} {v} ({MEANING[v]})"
        for v in VERDICTS
        if verdicts.get(v) and v != "confirmed"
    )
    left = counts.violating - counts.claimed
    return [
        paragraph(f"{left:,} rows violate as simulated and are not claimed: {listed}."),
        bullets(not_claimed_rows(run)),
    ]
