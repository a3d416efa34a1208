"""The summary of a run: violations, confirmed failures, failure rate, and the worst case.

balance: 604 of 20000 simulations violate the property
property     always[0,4] (abs(x) <= 2.4 & abs(theta) <= 0.20944)
of these     334 confirmed in double precision, 102 refuted and not claimed, 168 undecided (...)
failure rate 3.02 % (95 % interval 2.79 % to 3.27 %) as simulated
"""

import numpy as np

from verifai_jax.core.display.lazy import lazy_import
from verifai_jax.core.messages.text import format_features, format_percent, one_line, printable
from verifai_jax.evaluation.confirmations import UNDECIDED
from verifai_jax.falsification.kinds import describe_kinds
from verifai_jax.falsification.no_rate import remedy, why_no_rate
from verifai_jax.falsification.run import Run

SHOWN = 0.005
"""Minimum seconds that the summary shows; less is left out."""


def summarize(run: Run) -> str:
    """Write the summary of a run; every number comes from its table.

    If rows of the table have changed on disk, no number is written.
    """
    if run.table.changed:
        lines = [f"{run.name}: its rows have changed since they were written, so they say nothing"]
        lines += [f"  damaged      {run.damage}", f"  search       {run.search}, seed {run.seed}"]
        return printable("\n".join(lines))
    counts = run.table.counts
    violating, failed = counts.violating, counts.without_verdict
    lines = [f"{run.name}: {_headline(run, violating)}"]
    repetitions = counts.repetitions
    if repetitions.moved:
        lines.append(f"  its own      {repetitions}")
    for name, text in run.formulas.items():
        lines.append(f"  {'property' if len(run.formulas) == 1 else name:<13}{text}")
        if len(run.formulas) > 1 and violating:
            lines[-1] += f" (fails in {counts.failing_alone[name]:,})"
    if violating and (verdicts := _closer_look(run)):
        lines.append(f"  of these     {verdicts}")
    lines += [f"  {'' if i else 'kinds':<13}{line}" for i, line in enumerate(describe_kinds(run))]
    lines += _rates(run)
    if failed < run.simulations:
        best = run.best.to_dict()
        labels = None if run.problem is None else run.problem.space.labels(run.problem.duration)
        where = format_features({name: best[name] for name in run.table.features}, labels)
        verdict = best.get("verdict", "")
        lines.append(
            f"  {'worst' if best['violated'] else 'nearest':<13}row {run.best.name}"
            f"{f' ({verdict})' if verdict else ''}, robustness {best['rho']:z.4g} at {where}"
        )
    if failed:
        statuses = ", ".join(f"{n} {status}" for status, n in counts.failed.items())
        lines.append(f"  no verdict   {statuses}")
        if (first := first_message(run)) is not None:
            number, message = first
            lines.append(f"               first in row {number}: {one_line(message)}")
    if lost := counts.not_differentiated:
        lines.append(f"  gradient     not finite in {lost} of {_differentiated(run)}")
    if repetitions.rounded and not repetitions.moved:
        lines.append(f"  note         {repetitions}")
    lines.extend(f"  note         {note}" for note in run.notes)
    if run.damage:
        lines.append(f"  damaged      {run.damage}")
    kept = 0
    if run.folder is not None:
        kept = lazy_import("verifai_jax.evaluation.journal", "count_unfinished")(
            run.folder, run.simulations
        )
    if kept:
        lines.append(
            f"  unfinished   {kept} finished simulations of a batch in flight are kept; resuming "
            "the run does not repeat them"
        )
    if run.acceptance is not None:
        lines.append(
            f"  constraint   let through {format_percent(run.acceptance)} of all proposals"
        )
    lines.append(f"  time         {_times(run)}; stopped by {run.stopped}")
    lines.append(f"  search       {run.search}, seed {run.seed}")
    # Names, values and notes come from files and systems, which a terminal must not obey.
    return printable("\n".join(lines))


def first_message(run: Run) -> tuple[int, str] | None:
    """Return number and text of the first row without a verdict that has a message.

    Rows of a traced system have no messages; the system's record of its first error is used.
    """
    counts = run.table.counts
    if counts.first_message is not None or run.problem is None or "error" not in counts.failed:
        return counts.first_message
    rows = run.table.failed
    row = rows[rows["status"] == "error"].iloc[0]
    reason = run.problem.system.why_error({name: row[name] for name in run.table.features})
    return None if reason is None else (int(row.name), reason)  # pyright: ignore[reportArgumentType]


def _differentiated(run: Run) -> str:
    """Count the simulations that were differentiated: all, or those whose row says so."""
    if "differentiated" not in next(run.table.blocks(), ()):
        return f"{run.simulations} simulations"
    blocks = run.table.blocks(["differentiated"])
    count = sum(int(np.count_nonzero(block["differentiated"])) for block in blocks)
    were = "simulation that was" if count == 1 else "simulations that were"
    return f"the {count} {were} differentiated"


def _headline(run: Run, violating: int) -> str:
    """Write the number of violations, and any doubts about it."""
    without = run.table.counts.without_verdict
    if run.has_several_models:
        return (
            f"{violating} of {run.simulations} simulations violate the property, and they are of "
            "several models: it went on although its model had changed"
        )
    if run.simulations and without == run.simulations:
        return f"no verdict: none of {run.simulations} simulations ended properly"
    if not run.simulations:
        return f"nothing was simulated; stopped by {run.stopped}"
    text = f"{violating} of {run.simulations} simulations violate the property"
    if without:
        text += f"; {without} have no verdict"
    counts = run.verdict_counts
    if counts.get("raised") and counts["raised"] == violating - counts.get("unexamined", 0):
        text += "; every replay to confirm them raised"
    return text


def _closer_look(run: Run) -> str:
    """Write the number of violating rows by verdict of closer replays."""
    counts = run.verdict_counts
    if not counts:
        return ""
    parts = []
    if counts.get("confirmed"):
        parts.append(f"{counts['confirmed']} confirmed {run.checked}".rstrip())
    if counts.get("refuted"):
        parts.append(f"{counts['refuted']} refuted and not claimed: they hold in finer replays")
    undecided = {name: counts[name] for name in UNDECIDED if counts.get(name)}
    if undecided:
        why = "; ".join(
            f"{count} {name}: {_UNDECIDED_IN_WORDS[name]}" for name, count in undecided.items()
        )
        parts.append(f"{sum(undecided.values())} undecided ({why})")
    return ", ".join(parts)


_UNDECIDED_IN_WORDS = {
    "fragile": "not claimed, as replays disagree",
    "raised": "not claimed, as a replay raised",
    "unexamined": "not claimed, as not replayed",
}


def _times(run: Run) -> str:
    """Write the time by activity; the parts are measured separately and add up."""
    simulating = run.simulate_seconds
    speed = f" ({run.simulations / simulating:z,.0f} simulations/s)" if simulating > 0 else ""
    parts = [f"{run.compile_seconds:z.1f} s to compile"]
    if run.search_seconds > 0:
        parts.append(f"{run.search_seconds:z.2f} s to search")
    parts.append(f"{simulating:z.2f} s to simulate{speed}")
    if run.checked:
        parts.append(f"{run.confirm_seconds:z.2f} s to confirm")
    if (rest := run.run_seconds - run.search_seconds - simulating) >= SHOWN:
        parts.append(f"{rest:z.2f} s for callbacks and files")
    return ", ".join(parts)


def _rates(run: Run) -> list[str]:
    """Write the failure rate as simulated, and the confirmed rate if it differs."""
    if not run.prior:
        return [f"  failure rate not given: {why_no_rate(run)}; {remedy(run)}"]
    if run.failure_rate is None:
        return []
    lines = [f"  failure rate {run.failure_rate} as simulated"]
    confirmed = run.confirmed_failure_rate
    if confirmed is not None and confirmed.failures < run.table.counts.violating:
        lines.append(f"               {confirmed} confirmed")
    return lines
