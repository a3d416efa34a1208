"""The summary of a sweep in words, and as a table for a notebook.

format_headline(sweep)
print(format_summary(sweep))
"""

import html
from collections.abc import Mapping, Sequence
from itertools import repeat
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from verifai_jax.addons.estimation.simultaneous_interval import verdict_kind
from verifai_jax.addons.training.sweeps import ranking
from verifai_jax.addons.training.sweeps.record import algorithm_uses, error_message
from verifai_jax.core.messages.text import counted, format_features, format_percent, format_seconds

if TYPE_CHECKING:
    import pandas as pd
Sweep: TypeAlias = Any
"""A `Sweep`, whose file imports this one."""
MAX_ROWS = 8
"""Rows that a notebook shows."""
_VIEWS = ".table .safe .best .configurations .pareto() .importance() .plot() .problem(row)"
"""Views of the result that the summary points to."""
_WORK = {
    "train": "training checkpoint", "return": "nominal return", "certify": "block of simulations",
}  # fmt: skip
"""What each kind of cached work is called in a summary."""
_CSS = {"safe": "#3a9e7d", "unsafe": "#d1495b"}
"""Colours of verdicts in a notebook, those of the pictures; others are grey."""


def format_summary(sweep: Sweep) -> str:
    """Write the findings of a sweep, the most important first."""
    record, table = sweep.record, sweep.table
    groups: Any = sweep.configurations
    margins: Any = table.get("curve_robustness")
    lines = [f"{record.study}: {format_headline(sweep)}"]
    if len(record.sources) > 1:
        lines.append("  SEVERAL MODELS: the sweep went on although the study had changed")
    if not record.complete:
        lines.append("  NOT FINISHED: interrupted or out of time; the finished part is here")
    if len(groups):
        lines.append(f"  configurations  {format_verdicts(groups)}")
    if len(table) > len(groups):
        lines.append(f"  policies        {format_verdicts(table)}; each seed and checkpoint is one")
    if len(ranking.preference_order(table)):
        lines += _best_lines(sweep)
    if len(groups) and (groups["seeds"] > 1).any():
        lines += _seed_lines(sweep)
    if missing := _missing_policies(table):
        lines.append(f"  without policy  {missing}")
    if stopped := sum(str(status) == "stopped" for status in table["status"]):
        kind = "population" if "parents" in record.options else "halving"
        lines.append(f"  {kind:<15} stopped {counted(stopped, 'training')} before the end")
    correlation = (
        ranking.return_safety_correlation(ranking.last_checkpoints(table)) if len(table) else np.nan
    )
    if np.isfinite(correlation):
        lines.append(
            f"  return, safety  rank correlation {correlation:z.2f} "
            "(1: the higher the return the safer, 0: unrelated)"
        )
    if margins is not None and (margins := margins.dropna()).size:
        formula = record.options.get("curve")
        lines.append(
            f"  learning curve  {int((margins >= 0).sum())} of {len(margins)} policies satisfy "
            f"{formula or 'its formula'}"
        )
    if evidence := _evidence(sweep):
        lines.append(f"  evidence        {evidence}")
    if reused := _reuse(sweep.reuse):
        lines.append(f"  from the cache  {reused}")
    if seconds := _seconds(record.seconds):
        lines.append(f"  time            {seconds}")
    lines.append(f"  see             {_VIEWS}")
    return "\n".join(lines)


def format_headline(sweep: Sweep) -> str:
    """Write how many configurations reach full return, and how many of these are safe."""
    groups: Any = sweep.configurations
    if not len(groups):
        return "no configuration was trained"
    text = f"{counted(len(groups), 'configuration')}; "
    threshold = ranking.full_return_threshold(groups)
    if not np.isfinite(threshold):
        if all(policy is None for policy in sweep.record.policies):
            return text + "none has a policy"
        safe = f"{int(ranking.is_safe(groups).sum())} certified safe{_requirement(sweep.p)}"
        return f"{text}{safe}, and no return at the end of a training is known"
    full = groups.loc[groups["nominal_return"] >= threshold]
    safe = int(ranking.is_safe(full).sum())
    reach = "reaches" if len(full) == 1 else "reach"
    of_those = f"{safe} of those {len(full)}" if len(full) > 1 else ("it" if safe else "it is NOT")
    verb = {0: " are", 1: " is"}.get(safe, " are") if len(full) > 1 else (" is" if safe else "")
    return (
        f"{text}{len(full)} {reach} full return (at least {_format_return(threshold)}), "
        f"and {of_those}{verb} certified safe{_requirement(sweep.p)}"
    )


def format_verdicts(rows: "pd.DataFrame") -> str:
    """Write how many rows have each verdict."""
    verdicts: Any = rows["verdict"].astype(str)
    parts = [f"{int(ranking.is_safe(rows).sum())} safe"]
    for verdict in ("unsafe", "undecided"):
        if count := int((verdicts == verdict).sum()):
            parts.append(f"{count} {verdict}")
    if other := int((verdicts == "").sum()):
        parts.append(f"{other} not certified")
    return ", ".join(parts)


def format_failures(row: Mapping[str, Any]) -> str:
    """Write the number of failing samples of a row, including those without a verdict."""
    failed = round(float(row["failure_rate"]) * float(row["simulations"]))
    return f"{failed:,} of {int(row['simulations']):,} simulations fail"


def format_hyperparameters(sweep: Sweep, row: Mapping[str, Any]) -> str:
    """Write those hyper-parameters of a row that its algorithm has."""
    names = [name for name in sweep.record.hyperparameters if name != "steps"]
    algorithm = row.get("algorithm")
    values = {n: row[n] for n in names if algorithm_uses(sweep.used, algorithm, n)}
    unknown = [n for n, value in values.items() if isinstance(value, float) and value != value]
    return format_features({n: value for n, value in values.items() if n not in unknown})


def format_html(sweep: Sweep) -> str:
    """Write the headline, the first rows to choose from, and the summary to unfold."""
    record, table = sweep.record, sweep.table
    rows = table.iloc[ranking.preference_order(table)[:MAX_ROWS]]
    names = [name for name in record.hyperparameters if name != "steps"]
    heads = ["row", "verdict", "P(fail)", "nominal return", "steps", *names]
    entries: Any = rows.to_dict("records")
    body = "".join(map(_html_row, map(str, rows.index), entries, repeat(names)))
    left = len(table) - len(rows)
    more = f"<p>{counted(left, 'further row')}: <code>.table</code></p>" if left else ""
    summary = html.escape(format_summary(sweep))
    return (
        f"<p><b>{html.escape(record.study)}</b>: {html.escape(format_headline(sweep))}</p>"
        + "<table><thead><tr>"
        + "".join(f"<th>{html.escape(head)}</th>" for head in heads)
        + f"</tr></thead><tbody>{body}</tbody></table>{more}"
        + f"<details><summary>summary</summary><pre>{summary}</pre></details>"
    )


def _html_row(number: str, row: Mapping[str, Any], names: Sequence[str]) -> str:
    verdict = str(row["verdict"])
    colour = _CSS.get(verdict_kind(verdict), "#7f7f7f")
    texts = [
        f"{format_percent(row['failure_low'])} to {format_percent(row['failure_high'])}",
        _format_return(row["nominal_return"]),
        f"{int(row['steps']):,}",
        *(format_features({name: row[name]}).partition("=")[2] for name in names),
    ]
    cells = "".join(f"<td>{html.escape(text)}</td>" for text in texts)
    mark = f'<td style="color:{colour}"><b>{html.escape(verdict)}</b></td>'
    return f"<tr><td>{number}</td>{mark}{cells}</tr>"


def _best_lines(sweep: Sweep) -> list[str]:
    table = sweep.table
    number = table.index[ranking.preference_order(table)[0]]
    best: Any = table.loc[number].to_dict()
    verdict = str(best["verdict"])
    if verdict_kind(verdict) == "safe":
        which = f"row {number}, {verdict}"
    else:
        which = f"row {number} comes nearest, {verdict}: NONE IS CERTIFIED SAFE"
    lines = [
        f"  best            {which}; nominal return {_format_return(best['nominal_return'])}",
        f"                  {_interval(best)}",
    ]
    if values := format_hyperparameters(sweep, best):
        lines.append(f"                  {values}")
    price = f"{int(best['steps']):,} environment steps"
    if np.isfinite(seconds := best["training_seconds"]):
        price += f" in {format_seconds(float(f'{seconds:z.2g}'))} of a core"
    if best["simulations"] > 0:
        price += f", then {counted(int(best['simulations']), 'simulation')} for the certificate"
    lines.append(f"                  cost {price}")
    return lines


def _seed_lines(sweep: Sweep) -> list[str]:
    """Write the configurations that are safe whatever the training seed; one row may be luck."""
    groups: Any = sweep.configurations
    safe = groups.loc[ranking.is_safe(groups)].sort_values(
        ["nominal_return", "failure_high"], ascending=[False, True], kind="stable"
    )
    if not len(safe):
        return ["  every seed      no configuration is safe with all of its seeds"]
    number, best = safe.index[0], safe.iloc[0].to_dict()
    are = "are" if len(safe) > 1 else "is"
    return [
        f"  every seed      {counted(len(safe), 'configuration')} {are} safe with all seeds; the "
        f"best is {number}: nominal return {_format_return(best['nominal_return'])}",
        f"                  {format_hyperparameters(sweep, best)}",
    ]


def _interval(row: Mapping[str, Any]) -> str:
    low, high = format_percent(row["failure_low"]), format_percent(row["failure_high"])
    if row["simulations"] > 0:
        return f"{format_failures(row)}: between {low} and {high}"
    return f"failure probability between {low} and {high}"


def _missing_policies(table: "pd.DataFrame") -> str:
    """Write the number of rows that did not train, and the first error."""
    statuses: Any = table["status"].astype(str)
    parts = []
    if count := int((statuses == "nonfinite").sum()):
        parts.append(f"{count} not finite")
    messages = statuses.map(error_message)
    failed = messages.loc[messages.notna()]
    if len(failed):
        first = failed.iloc[0].strip() or "error"
        errors = counted(len(failed), "error")
        parts.append(f"{errors}, the first in row {failed.index[0]}: {first}")
    return "; ".join(parts)


def _requirement(p: float | None) -> str:
    return "" if p is None else f" (failure probability below {format_percent(p)})"


def _evidence(sweep: Sweep) -> str:
    """Write the number of simulations that the certificates rest on, and their confidence."""
    counts = sweep.table["simulations"].to_numpy(np.float64)
    total = int(np.nansum(np.maximum(counts, 0)))
    if not total:
        return ""
    text = f"{total:,} fresh simulations"
    confidence = sweep.record.options.get("confidence")
    if confidence is not None:
        text += f"; all intervals hold together at {format_percent(float(confidence))} confidence"
    return text


def _reuse(reuse: Mapping[str, tuple[int, int]]) -> str:
    """Write how much of the work was cached before; nothing where none was."""
    if not any(cached for cached, _ in reuse.values()):
        return ""
    return ", ".join(
        f"{cached:,} of {counted(used, _WORK.get(kind, kind))}"
        for kind, (cached, used) in reuse.items()
    )


def _seconds(seconds: Mapping[str, float]) -> str:
    parts = [f"{value:z.1f} s {stage}" for stage, value in seconds.items() if value >= 0.05]
    return ", ".join(parts)


def _format_return(value: float) -> str:
    """Write a return with four digits, and no exponent where it can be avoided."""
    if value != value:
        return "unknown"
    return f"{value:z,.0f}" if abs(value) >= 1000 else f"{value:z.4g}"
