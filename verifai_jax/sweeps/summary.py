"""A sweep in words, and as a table for a notebook."""

import html
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from verifai_jax.core.text import format_features, format_percent
from verifai_jax.sweeps.ranking import (
    chosen_first,
    is_safe,
    last_snapshots,
    least_full_return,
    return_and_safety,
)

if TYPE_CHECKING:
    from verifai_jax.sweeps.result import Sweep

MOST_ROWS = 8
"""Rows that a notebook shows."""
_VIEWS = ".table .safe .best .configurations .pareto() .importance() .plot() .problem(row)"


def summary(sweep: "Sweep") -> str:
    """The findings of a sweep, the most important first."""
    table: Any = sweep.table
    groups: Any = sweep.configurations
    lines = [f"{sweep.name}: {lead(sweep)}"]
    if not sweep.record.complete:
        lines.append("  NOT FINISHED: interrupted or out of time; what was finished is here")
    if len(groups):
        lines.append(f"  configurations  {verdict_counts(groups)}")
    several = len(table) > len(groups)
    if several:
        lines.append(f"  policies        {verdict_counts(table)}; each seed and snapshot is one")
    if len(chosen_first(table)):
        lines += _best(sweep)
    if len(groups) and (groups["seeds"] > 1).any():
        lines += _every_seed(sweep)
    if lost := _lost(table):
        lines.append(f"  without policy  {lost}")
    if stopped := int((table["status"].astype(str) == "stopped").sum()):
        lines.append(f"  halving         stopped {plural(stopped, 'training')} before the end")
    correlation = return_and_safety(last_snapshots(table)) if len(table) else np.nan
    if np.isfinite(correlation):
        lines.append(
            f"  return, safety  rank correlation {correlation:.2f} "
            "(1: the higher the return the safer, 0: unrelated)"
        )
    if "curve_robustness" in table and (judged := table["curve_robustness"].dropna()).size:
        formula = sweep.record.options.get("curve")
        lines.append(
            f"  learning curve  {int((judged >= 0).sum())} of {len(judged)} policies keep "
            f"{formula or 'its formula'}"
        )
    if evidence := _evidence(sweep):
        lines.append(f"  evidence        {evidence}")
    if spent := _spent(sweep.record.seconds):
        lines.append(f"  time            {spent}")
    lines.append(f"  see             {_VIEWS}")
    return "\n".join(lines)


def lead(sweep: "Sweep") -> str:
    """How many configurations reach full return, and how many of those are safe."""
    groups: Any = sweep.configurations
    if not len(groups):
        return "no configuration was trained"
    text = f"{plural(len(groups), 'configuration')}; "
    least = least_full_return(groups)
    if not np.isfinite(least):
        return text + "none has a policy"
    full = groups.loc[groups["nominal_return"] >= least]
    safe = int(is_safe(full).sum())
    reach = "reaches" if len(full) == 1 else "reach"
    of_those = f"{safe} of those {len(full)}" if len(full) > 1 else ("it" if safe else "it is NOT")
    verb = {0: " are", 1: " is"}.get(safe, " are") if len(full) > 1 else (" is" if safe else "")
    return (
        f"{text}{len(full)} {reach} full return (at least {number(least)}), "
        f"and {of_those}{verb} certified safe{_below(sweep)}"
    )


def verdict_counts(rows: Any) -> str:
    """How many rows have which verdict."""
    verdicts = rows["verdict"].astype(str)
    parts = [f"{int(is_safe(rows).sum())} safe"]
    for verdict in ("unsafe", "undecided"):
        if count := int((verdicts == verdict).sum()):
            parts.append(f"{count} {verdict}")
    if other := int((verdicts == "").sum()):
        parts.append(f"{other} not certified")
    return ", ".join(parts)


def interval(row: Any) -> str:
    """The failures of a row and the ends of its failure probability."""
    text = f"between {format_percent(row['failure_low'])} and {format_percent(row['failure_high'])}"
    if row["simulations"] > 0:
        return f"{failures(row)}: {text}"
    return f"failure probability {text}"


def failures(row: Any) -> str:
    """How many of the samples failed; those without a verdict count as failures, as in the rate."""
    failed = round(float(row["failure_rate"]) * float(row["simulations"]))
    return f"{failed:,} of {int(row['simulations']):,} simulations fail"


def number(value: float) -> str:
    """A return for people: four digits, no exponent where it can be helped."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def plural(count: int, what: str) -> str:
    """`1 configuration`, `2 configurations`."""
    return f"{count:,} {what}{'s' * (count != 1)}"


def values_of(sweep: "Sweep", row: Any) -> str:
    """The hyper-parameters of a row, those that its algorithm has."""
    names = [name for name in sweep.hyperparameters if name != "steps"]
    values = {name: row[name] for name in names if sweep.applies(name, row.get("algorithm"))}
    missing = [
        name for name, value in values.items() if isinstance(value, float) and value != value
    ]
    return format_features({name: value for name, value in values.items() if name not in missing})


def as_html(sweep: "Sweep") -> str:
    """The lead, the first rows to choose from, and the summary to unfold."""
    table = sweep.table
    rows = table.iloc[chosen_first(table)[:MOST_ROWS]]
    names = [name for name in sweep.hyperparameters if name != "steps"]
    heads = ["row", "verdict", "P(fail)", "nominal return", "steps", *names]
    body = "".join(_html_row(int(i), row, names) for i, row in rows.iterrows())  # pyright: ignore
    left = len(table) - len(rows)
    more = f"<p>{plural(left, 'further row')}: <code>.table</code></p>" if left else ""
    return (
        f"<p><b>{html.escape(sweep.name)}</b>: {html.escape(lead(sweep))}</p>"
        + "<table><thead><tr>"
        + "".join(f"<th>{html.escape(head)}</th>" for head in heads)
        + f"</tr></thead><tbody>{body}</tbody></table>{more}"
        + f"<details><summary>summary</summary><pre>{html.escape(summary(sweep))}</pre></details>"
    )


def _html_row(i: int, row: Any, names: list[str]) -> str:
    from verifai_jax.plotting.style import FAILING, SAFE, WITHOUT_VERDICT

    verdict = str(row["verdict"])
    colour = SAFE if verdict.startswith("safe") else WITHOUT_VERDICT
    colour = FAILING if verdict == "unsafe" else colour
    shown = [
        f"{format_percent(row['failure_low'])} to {format_percent(row['failure_high'])}",
        number(row["nominal_return"]),
        f"{int(row['steps']):,}",
        *(format_features({name: row[name]}).partition("=")[2] for name in names),
    ]
    cells = "".join(f"<td>{html.escape(cell)}</td>" for cell in shown)
    mark = f'<td style="color:{colour}"><b>{html.escape(verdict)}</b></td>'
    return f"<tr><td>{i}</td>{mark}{cells}</tr>"


def _best(sweep: "Sweep") -> list[str]:
    best: Any = sweep.best
    verdict = str(best["verdict"])
    if verdict.startswith("safe"):
        which = f"row {best.name}, {verdict}"
    else:
        which = f"row {best.name} comes nearest, {verdict}: NONE IS CERTIFIED SAFE"
    lines = [
        f"  best            {which}; nominal return {number(best['nominal_return'])}",
        f"                  {interval(best)}",
    ]
    if values := values_of(sweep, best):
        lines.append(f"                  {values}")
    price = f"{int(best['steps']):,} environment steps"
    if np.isfinite(best["training_seconds"]):
        price += f" in {best['training_seconds']:.1f} s of a core"
    if best["simulations"] > 0:
        price += f", then {plural(int(best['simulations']), 'simulation')} for the certificate"
    lines.append(f"                  cost {price}")
    return lines


def _every_seed(sweep: "Sweep") -> list[str]:
    """The configurations that are safe whatever the training seed; one row may be luck."""
    groups: Any = sweep.configurations
    safe = groups.loc[is_safe(groups)].sort_values(
        ["nominal_return", "failure_high"], ascending=[False, True], kind="stable"
    )
    if not len(safe):
        return ["  every seed      no configuration is safe with all of its seeds"]
    best = safe.iloc[0]
    are = "are" if len(safe) > 1 else "is"
    return [
        f"  every seed      {plural(len(safe), 'configuration')} {are} safe with all seeds; the "
        f"best is {best.name}: nominal return {number(best['nominal_return'])}",
        f"                  {values_of(sweep, best)}",
    ]


def _lost(table: Any) -> str:
    """Rows that did not train, and why the first did not."""
    statuses = table["status"].astype(str)
    parts = []
    if count := int((statuses == "nonfinite").sum()):
        parts.append(f"{count} not finite")
    failed = statuses.loc[statuses.str.startswith("error")]
    if len(failed):
        first = failed.iloc[0].partition(":")[2].strip() or "error"
        parts.append(f"{plural(len(failed), 'error')}, the first in row {failed.index[0]}: {first}")
    return "; ".join(parts)


def _below(sweep: "Sweep") -> str:
    return "" if sweep.p is None else f" (failure probability below {format_percent(sweep.p)})"


def _evidence(sweep: "Sweep") -> str:
    """How many simulations the certificates rest on, and how sure they are."""
    counts = sweep.table["simulations"].to_numpy(np.float64)
    total = int(np.nansum(np.maximum(counts, 0)))
    if not total:
        return ""
    text = f"{total:,} fresh simulations"
    confidence = sweep.record.options.get("confidence")
    if confidence is not None:
        text += f"; all intervals hold together at {format_percent(float(confidence))} confidence"
    return text


def _spent(seconds: Mapping[str, float]) -> str:
    parts = [f"{value:.1f} s {what}" for what, value in seconds.items() if value >= 0.05]
    return ", ".join(parts)
