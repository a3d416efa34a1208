"""The report on one policy in two engines: their differences and the causes."""

from typing import Any

from verifai_jax.addons.estimation.comparison.result import Transfer
from verifai_jax.addons.reports.claims import Claim
from verifai_jax.addons.reports.markup import paragraph, picture, preformatted, table
from verifai_jax.addons.reports.page import Page
from verifai_jax.addons.reports.provenance import Model
from verifai_jax.addons.reports.run_question import About, space_table
from verifai_jax.addons.reports.sections import MODEL, result_page
from verifai_jax.addons.reports.studies import png
from verifai_jax.core.messages.text import format_percent
from verifai_jax.features.english import number

PAIRED = "Both simulations of a pair have the same features and the same random key."
MAX_PAIRS = 10
"""Pairs with different verdicts that are listed."""


def transfer_page(result: Transfer, about: About, problem: object = None) -> Page:
    """Make the report on one policy in two engines."""
    about.check(result.space)
    model = Model.of(result.sources.values())
    a, b = result.names
    pairs: Any = result.table
    proper = pairs[pairs["proper"]]
    lost, flips = len(pairs) - len(proper), result.flips
    if result.differs:
        headline = (
            f"{a} and {b} differ: traces part in {int(proper['differs'].sum()):,} of "
            f"{len(proper):,} pairs, verdicts in {len(flips):,}."
        )
        rule = "A difference that was seen is one; how often it occurs is of the sampled pairs."
    else:
        headline = f"No difference of {a} and {b} was seen in {len(proper):,} pairs."
        rule = "A difference that no pair has shown may exist elsewhere."
    searched = int(pairs["searched"].sum())
    evidence = f"{len(pairs) - searched:,} sampled and {searched:,} searched pairs"
    claims = [Claim("C1", headline, (evidence,), (MODEL, PAIRED, rule))]
    columns = [*result.space.columns, "robustness_a", "robustness_b", "gap", "signal", "parted"]
    furthest = flips.sort_values("gap", ascending=False).head(MAX_PAIRS)
    rows = [
        [f"{row:,}", *(v if isinstance(v, str) else number(v) for v in values)]
        for row, *values in furthest[columns].itertuples()
    ]
    flipped = [paragraph("No pair has different verdicts.")]
    if rows:
        text = f"{len(rows):,} of {len(flips):,} pairs with different verdicts:"
        flipped = [paragraph(text), table(["row", *columns], rows)]
    shares = [(name, format_percent(share)) for name, share in result.influence.items()]
    causes = [table(["feature", "share of the gap's variance"], shares)] if shares else []
    python = (
        f"vj.transfer(policy, problem_a, problem_b, seed={result.seed}, "
        f"tolerance={result.tolerance:zg})"
    )
    return result_page(
        f"{a} and {b}", "evidence report on a transfer", headline,
        "fails" if result.differs else "open", claims, model,
        answers=[
            ("What was varied?", "see the table", "asked"),
            ("How many pairs were there?", evidence, "found"),
            ("How many had no two verdicts?", f"{lost:,}", "limits"),
            ("With which seed?", str(result.seed), "reproduce"),
        ],
        asked=[
            paragraph(f"Whether the same policy does the same in {a} (a) and in {b} (b)."),
            space_table(result.space, {}, about),
        ],
        found=[
            preformatted(str(result)),
            picture(png(result.plot()), "The pair that parts most, and the gaps of all"),
            *flipped,
            *causes,
        ],
        limits=[
            f"{lost:,} pairs have no verdict in one of the two.",
            f"Gaps below {result.tolerance:zg} of a signal's range do not count, nor what rounding "
            "can make.",
            rule,
            MODEL,
            *result.notes,
        ],
        reproduce=[preformatted(python)],
    )  # fmt: skip
