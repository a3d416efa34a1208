"""The report on a comparison: differences of failure rates, and the features where they occur."""

from verifai_jax.addons.estimation.comparison.result import BETTER, SAME, WORSE, Comparison
from verifai_jax.addons.reports.claims import Claim
from verifai_jax.addons.reports.markup import Markup, element, paragraph, preformatted, table
from verifai_jax.addons.reports.page import Page
from verifai_jax.addons.reports.provenance import Model
from verifai_jax.addons.reports.run_question import About, space_table
from verifai_jax.addons.reports.sections import MODEL, problem_content, result_page
from verifai_jax.core.messages.text import format_percent
from verifai_jax.features.english import number
from verifai_jax.problem.problem import Problem

PAIRED = (
    "Both sides of a pair have the same features, drawn independently from the prior, and the same "
    "random key; the interval holds whenever sampling stops."
)
"""Assumption of the interval of a difference."""
MAX_PAIRS = 10
"""Pairs in which only one side fails that are listed."""


def comparison_page(comparison: Comparison, about: About, problem: Problem | None) -> Page:
    """Make the report on a comparison, with its baseline problem if that is available."""
    about.check(comparison.candidates[0].space)
    # That of one side says nothing of the files of the others.
    model = Model.of(comparison.sources.values())
    first = comparison.candidates[0]
    sure = format_percent(1 - len(comparison.candidates) * (1 - first.rates.confidence))
    verdicts = "; ".join(f"{each.name} is {each.verdict}" for each in comparison.candidates)
    compared = f"compared with {comparison.baseline}"
    headline = f"{verdicts}, {compared}. All verdicts hold together at {sure}."
    claims, rows = [], []
    for i, each in enumerate(comparison.candidates, 1):
        rates, text = each.rates, f"{each.name} is {each.verdict} {compared}: {each.rates}."
        evidence = (f"{rates.pairs:,} pairs of simulations",)
        claims.append(Claim(f"C{i}", text, evidence, (MODEL, PAIRED)))
        counts = (rates.pairs, rates.only_second, rates.only_first, each.both, rates.undecided)
        rows.append((each.name, each.verdict, str(rates), *(f"{count:,}" for count in counts)))
    heads = ["candidate", "verdict", "difference", "pairs", "only it fails"]
    heads += ["only the baseline fails", "both fail", "without both verdicts"]
    calm = [f"{each.name}: {each.calm}." for each in comparison.candidates if each.calm]
    asked = space_table(first.space, {}, about)
    without = sum(each.rates.undecided for each in comparison.candidates)
    python = (
        f"vj.compare(baseline, candidates, margin={first.margin}, seed={comparison.seed}, "
        f"budget={comparison.simulations})"
    )
    tone = {WORSE: "fails", BETTER: "holds", SAME: "holds"}.get(comparison.verdict, "open")
    return result_page(
        comparison.baseline, "evidence report on a comparison", headline, tone, claims, model,
        answers=[
            ("What was varied, and what was the prior?", "see the table", "asked"),
            ("How many simulations were there?", f"{comparison.simulations:,}", "found"),
            ("How many pairs had no two verdicts?", f"{without:,}", "limits"),
            ("Which assumption is under the intervals?", PAIRED, "limits"),
            ("With which seed?", str(comparison.seed), "reproduce"),
        ],
        asked=[
            paragraph(
                f"Whether a candidate fails more often than {comparison.baseline}, by more "
                f"than {100 * first.margin:zg} points."
            ),
            *([asked] if problem is None else problem_content(problem, about)),
        ],
        found=[table(heads, rows), *map(paragraph, calm), *_pairs(comparison)],
        limits=[
            f"In {without:,} pairs a side has no verdict: they widen the intervals in both "
            "directions.",
            "Single failures were not replayed more closely.",
            f"Sampling was ended by: {comparison.stopped}.", MODEL, PAIRED, *comparison.notes,
        ],
        reproduce=[preformatted(python)], warned=model._replace(parts=model.parts[:1]),
    )  # fmt: skip


def _pairs(comparison: Comparison) -> list[Markup]:
    """Write some pairs in which only one side fails."""
    content = []
    for each in comparison.candidates:
        if not len(each.discordant):
            continue
        names = [str(name) for name in each.discordant.columns if name != "worse"]
        rows = []
        for row in each.discordant.head(MAX_PAIRS).to_dict("records"):
            fails = each.name if bool(row["worse"]) else comparison.baseline
            rows.append([fails, *(number(row[name]) for name in names)])
        content += [
            element("h3", f"Pairs in which only one of {each.name} and the baseline fails"),
            paragraph(f"{len(rows):,} of {len(each.discordant):,}, in the order of sampling."),
            table(["fails", *names], rows),
        ]
    return content
