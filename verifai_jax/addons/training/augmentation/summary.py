"""The summary of an augmentation: helpful and useless arms, with confidence.

arm               error  against none (95 % t interval) counterexamples   8.1 %  -3 points (-4.1 to
-1.9)
"""

import math
from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from verifai_jax.addons.training.paired import PairedDifference
from verifai_jax.core.messages.text import counted, format_percent, one_line

Augmentation: TypeAlias = Any
"""An `Augmentation`, whose file imports this one."""
BASE = "base"
"""Name of the base network among the arms of a table."""
TRAINED, NOT_FINITE = "trained", "not finite"
"""Status of a network."""
SHARES = ("error", "precision", "recall", "hard_error")
"""Metrics that are shares of a test."""
REFERENCES = ("none", "random")
"""Arms that all others are compared with."""


def summarize(result: Augmentation) -> str:
    """Write the summary of an augmentation; every number comes from its tables."""
    table, options = result.table, result.options
    if not len(table):
        return f"{result.task.name}: interrupted before a network was trained"
    seeds = len(set(table["seed"]))
    lines = [
        f"{result.task.name}: {counted(len(result.arms), 'arm')}, {counted(seeds, 'seed')}; "
        f"{options['added']:,} inputs to be added to {options['initial']:,}, then "
        f"{options['further_steps']:,} further training steps in every arm"
    ]
    if not result.complete:
        lines.append("  NOT FINISHED: interrupted; the finished networks are here")
    lines += _base_lines(result)
    lines += _table_lines(result)
    lines += _fewer_lines(result)
    lines += _not_finite_lines(result)
    lines += [f"  {line}" for line in findings(result)]
    return "\n".join(lines)


def findings(result: Augmentation, metric: str = "error") -> list[str]:
    """Write which arms lower a metric (lower is better), and which raise it.

    An arm counts as better or worse if its interval of paired differences excludes zero.
    """
    references = [arm for arm in REFERENCES if arm in result.arms]
    sentences = []
    for reference in references:
        differences = _differences(result, metric, reference)
        known = {arm: d for arm, d in differences.items() if math.isfinite(d.low)}
        if not known:
            continue
        better = [arm for arm, d in known.items() if d.negative]
        worse = [arm for arm, d in known.items() if d.positive]
        label = _label(metric)
        if better:
            better.sort(key=lambda arm: known[arm].mean)
            each = ", ".join(f"{arm} by {_size(metric, -known[arm].mean)}" for arm in better)
            sentences.append(f"Lower {label} than {reference}, beyond chance: {each}.")
        else:
            sentences.append(f"No arm has a lower {label} than {reference} beyond chance.")
        if worse:
            each = ", ".join(f"{arm} by {_size(metric, known[arm].mean)}" for arm in worse)
            sentences.append(f"Higher {label} than {reference}, beyond chance: {each}.")
    if not sentences and references:
        pairs = max(
            (d.pairs for r in references for d in _differences(result, metric, r).values()),
            default=0,
        )
        if pairs == 1:
            sentences.append("One seed gives no interval: these differences may be chance.")
    sentences += _gain(result, metric)
    return sentences


def _gain(result: Augmentation, metric: str) -> list[str]:
    """Compare the gains of counterexamples and random inputs, if the former is significant."""
    if not {"none", "random", "counterexamples"} <= {*result.arms}:
        return []
    differences = _differences(result, metric, "none")
    found = [differences.get(arm) for arm in ("counterexamples", "random")]
    if any(d is None or not d.mean < 0 for d in found) or not (found[0] and found[0].negative):
        return []
    guided, blind = (-d.mean for d in found if d is not None)
    return [
        f"Counterexamples lower the mean {_label(metric)} {guided / blind:z.2g} times as much as "
        "random inputs do, both against none."
    ]


def _base_lines(result: Augmentation) -> list[str]:
    table = result.table
    base = table.loc[(table["arm"] == BASE) & (table["status"] == TRAINED)]
    lines = []
    if len(base):
        error = base["error"].to_numpy(np.float64)
        spread = "" if len(error) == 1 else f" ({_span(error)} over seeds)"
        lines.append(f"  base         errs on {format_percent(error.mean())} of new inputs{spread}")
    if result.error_tables:
        rows = [len(t) for t in result.error_tables.values()]
        wrong = [_counterexamples(t) for t in result.error_tables.values()]
        low, high = min(wrong), max(wrong)
        count = f"{low:,}" if low == high else f"{low:,} to {high:,}"
        lines.append(
            f"  error table  {count} counterexample{'s' * (high != 1)} in {max(rows):,} inputs of "
            f"{result.options['search']}"
        )
        if high == 0:
            lines.append(
                "               no seed has a counterexample, so arms that draw from the error "
                "table add nothing"
            )
    if "hard_error" in table:
        size = result.options["hard"]
        text = f"{size:,} inputs on which an independent network errs"
        if not size:
            text = "no input was found on which an independent network errs"
        lines.append(f"  hard test    {text}")
    return lines


def _table_lines(result: Augmentation) -> list[str]:
    """Write the table of arms: means, and differences against none and random."""
    means = result.means
    references = [arm for arm in REFERENCES if arm in result.arms]
    sure = f"{100 * result.confidence:zg} % t interval"
    head = ["arm", "added", *(_label(m) for m in result.metrics)]
    head += [f"error against {reference} ({sure})" for reference in references]
    differences = {r: _differences(result, "error", r) for r in references}
    rows = [head]
    for arm in means.index:
        mean = means.loc[arm]
        row = [str(arm), "-" if np.isnan(mean["added"]) else f"{mean['added']:z,.0f}"]
        row += [_value(metric, float(mean[metric])) for metric in result.metrics]
        row += [_difference(differences[r].get(str(arm))) for r in references]
        rows.append(row)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  " + "  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]


def _fewer_lines(result: Augmentation) -> list[str]:
    """Say which arms added fewer inputs than asked for, and why."""
    lines = []
    for arm in result.arms:
        rows = result.table.loc[(result.table["arm"] == arm) & (result.table["why"] != "")]
        rows = rows.loc[rows["status"] == TRAINED]
        if len(rows):
            first = rows.iloc[0]
            lines.append(
                f"  {arm} added fewer than {result.options['added']:,} in "
                f"{counted(len(rows), 'seed')}; seed {first['seed']}: {one_line(str(first['why']))}"
            )
    return lines


def _not_finite_lines(result: Augmentation) -> list[str]:
    lost = result.table.loc[result.table["status"] != TRAINED]
    if not len(lost):
        return []
    counts = ", ".join(f"{n} of {arm}" for arm, n in lost["arm"].value_counts(sort=False).items())
    return [
        f"  not finite   {counted(len(lost), 'network')} ({counts}): left out of all means and "
        "differences"
    ]


def _differences(result: Augmentation, metric: str, reference: str) -> dict[str, PairedDifference]:
    return result.compare(metric, reference) if reference in {*result.table["arm"]} else {}


def _difference(difference: PairedDifference | None) -> str:
    if difference is None or not difference.pairs:
        return "-"
    mean = f"{100 * difference.mean:+z.2f} points"
    if not math.isfinite(difference.low):
        return mean
    return f"{mean} ({100 * difference.low:+z.2f} to {100 * difference.high:+z.2f})"


def _label(metric: str) -> str:
    return metric.replace("_", " ")


def _value(metric: str, value: float) -> str:
    if math.isnan(value):
        return "-"
    return format_percent(value) if metric in SHARES else f"{value:z.4g}"


def _size(metric: str, value: float) -> str:
    return f"{100 * value:z.2f} points" if metric in SHARES else f"{value:z.3g}"


def _span(values: np.ndarray) -> str:
    return f"{format_percent(values.min())} to {format_percent(values.max())}"


def _counterexamples(table: pd.DataFrame) -> int:
    violated, status = table["violated"].to_numpy(bool), table["status"].to_numpy(object)
    return int((violated & (status == "ok")).sum())
