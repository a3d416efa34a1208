"""A protocol of trials to print: features drawn from the prior, in a random order, and blinded.

trial_protocol(problem, "sheet.html", 40)
trial_protocol(problem, "pairs.html", 20, policies=("old", "new"))      # which is A is in a key
"""

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from verifai_jax._version import __version__
from verifai_jax.core.messages.checks import check_count
from verifai_jax.core.messages.errors import suggests_options
from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.problem.problem import Problem

if TYPE_CHECKING:
    import pandas as pd
STYLE = """body{font:10pt sans-serif;margin:1.5cm}table{border-collapse:collapse;width:100%}
td,th{border:1px solid #888;padding:4px 6px;text-align:left}thead{display:table-header-group}
tr{page-break-inside:avoid}"""
RULES = (
    "Make the trials in this order, all of them. An order of one's own, or leaving out trials that "
    "look hard, spoils the statistics.",
    "Set each feature to its value; if a value is missed, write down the one that was set.",
    "Decide on the verdict by the property above alone, before the next trial begins.",
    "A trial that was cut short has no verdict: leave both boxes empty, say why, do not repeat it.",
)


@suggests_options
def trial_protocol(
    problem: Problem, path: str | Path, count: int = 20, *, policies: Sequence[str] = (),
    trials: "pd.DataFrame | None" = None, seed: int = 0,
) -> "pd.DataFrame":  # fmt: skip
    """Write a protocol sheet for real trials, and a table to fill in.

    A table with the name of the sheet `path` and the ending `.csv` is written next to it; fill in
    its column `failed` for `real_trials` or `compare_trials`. With policies, each pair of trials
    has the same features. The person who runs them sees only codes; the file that ends in
    `_key.csv` says which policy a code means.

    **Arguments:**
    - `problem`: the problem; its features are drawn from the prior, its formulas are the property.
    - `path`: the path of the HTML file.
    - `count`: number of trials, or of pairs.
    - `policies`: names of two policies to compare.
    - `trials`: features of the trials, such as those of `next_trials`, instead of drawn ones.
    - `seed`: the seed of the features, the order and the codes.
    **Returns:** the table.
    **Raises:** `ValueError` for a number of policies other than none or two; `OSError` where a file
    cannot be written.
    """
    check_count("count", count)
    if policies and len(set(policies)) != 2:
        raise ValueError(f"a protocol compares two policies; got {', '.join(policies)}")
    import pandas as pd

    path, rng = Path(path), np.random.default_rng(seed)
    columns = list(problem.space.columns)
    if trials is None:
        drawn = problem.space.sample(jax.random.key(seed), count)
        trials = pd.DataFrame(problem.space.rows(drawn))
    table: Any = trials[columns].reset_index(drop=True)
    key = pd.DataFrame({"code": ["A", "B"], "policy": rng.permutation(list(policies))[:2]}
                       if policies else {"code": [], "policy": []})  # fmt: skip
    if policies:
        order = np.concatenate([rng.permutation(2) for _ in range(len(table))])
        pairs = np.repeat(np.arange(len(table)), 2)
        table = table.take(pairs).reset_index(drop=True)
        table.insert(0, "policy", [key["code"][code] for code in order])
        table.insert(0, "pair", pairs + 1)
    table.insert(0, "trial", np.arange(1, len(table) + 1))
    table["failed"] = ""
    with replacing(path) as sheet, replacing(path.with_suffix(".csv")) as filled:
        sheet.write_text(_page(problem, table, seed), encoding="utf-8")
        table.to_csv(filled, index=False)
        if policies:
            with replacing(path.with_name(f"{path.stem}_key.csv")) as partial:
                key.to_csv(partial, index=False)
    return table


def _page(problem: Problem, table: "pd.DataFrame", seed: int) -> str:
    head = [name for name in table.columns if name != "failed"]
    cells = "".join(f"<th>{escape(name)}</th>" for name in (*head, "failed", "remarks"))
    rows = []
    for record in table[head].itertuples(index=False):
        values = (f"{v:z.6g}" if isinstance(v, float) else str(v) for v in record)
        texts = "".join(f"<td>{escape(text)}</td>" for text in values)
        rows.append(f"<tr>{texts}<td>&#9744; yes &#9744; no</td><td></td></tr>")
    property_ = "".join(
        f"<li><b>{escape(name)}</b>: {escape(str(f))}</li>" for name, f in problem.formulas.items()
    )
    rules = "".join(f"<li>{rule}</li>" for rule in RULES)
    name = escape(problem.name)
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{name}</title>'
        f"<style>{STYLE}</style><h1>Trials: {name}</h1><p>{escape(problem.description)}</p>"
        f"<p>A trial fails if it breaks one of:</p><ul>{property_}</ul><ol>{rules}</ol>"
        "<p>Place and date: ____________________ Made by: ____________________</p>"
        f"<table><thead><tr>{cells}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
        f"<p>{len(table):,} trials, seed {seed}, verifai_jax {__version__}</p></html>\n"
    )
