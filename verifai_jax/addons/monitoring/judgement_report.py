"""The report on a judgement: which requirements fail on which recordings."""

import math

from verifai_jax.addons.monitoring.judgement import Judgement, Row
from verifai_jax.addons.reports.claims import Claim, claims_json
from verifai_jax.addons.reports.markup import Child, Markup, bullets, element, table
from verifai_jax.addons.reports.page import Page, Section
from verifai_jax.addons.reports.provenance import chained, versions
from verifai_jax.addons.reports.run_question import About
from verifai_jax.addons.reports.sections import (
    answers_section,
    chain_table,
    chain_words,
    claims_section,
)
from verifai_jax.core.messages.text import counted, format_time

MAX_ROWS = 2000
"""Verdicts that the report lists at most; those that fail are all among the first."""
RECORDED = "The recordings are of the system that the requirements are about, and their clocks run."
"""Assumption of every claim."""


def judgement_page(judgement: Judgement, about: About, problem: object = None) -> Page:
    """Make the report on a judgement."""
    about.check(None)
    failing, missing = judgement.failing, judgement.without_verdict
    verdicts = len(judgement.rows) - len(missing)
    fleet = counted(len(judgement.files), "recording")
    asked = counted(len(judgement.requirements), "requirement")
    headline = f"{len(failing):,} of {verdicts:,} verdicts fail: {asked} on {fleet}."
    headline += f" {len(missing):,} verdicts could not be given." if missing else ""
    if judgement.depending:
        headline += f" {len(judgement.depending):,} verdicts depend on values within error bars."
    tone = "fails" if failing else "holds" if judgement.all_hold and verdicts else "open"
    claims = []
    for index, each in enumerate(judgement.requirements, 1):
        rows = judgement.of(each.id)
        fails = sum(row.verdict == "fails" for row in rows)
        words = f"{each.id} fails on {fails:,} of {len(rows):,} recordings with a verdict."
        claims.append(Claim(f"C{index}", words, (f"{each.formula}",), (RECORDED,)))
    tightest = judgement.tightest
    near = "none has a finite robustness"
    if tightest is not None:
        near = f"{tightest.requirement} on {tightest.file}: {tightest.explanation}"
    links = tuple(chained(judgement.inputs))
    chain = links[-1].chain if links else ""
    answers = [
        ("What was found?", headline, "found"),
        ("Which requirement is the tightest?", near, "found"),
        ("How many verdicts are missing?", f"{len(missing):,}", "limits"),
    ]
    limits = [bullets([RECORDED, "A recording shows what happened, not what may happen."])]
    limits += [_rows(judgement, missing)] if missing else []
    inputs = (element("h3", "Inputs"), chain_table(links), chain_words(chain))
    sections = (
        answers_section(answers),
        _asked(judgement),
        _found(judgement),
        Section("limits", "What was not shown", tuple(limits)),
        claims_section(claims),
        Section(
            "reproduce", "Versions and inputs", (table(["package", "version"], versions()), *inputs)
        ),
    )
    title, data = f"Requirements on {fleet}", claims_json("requirements", claims, chain)
    return Page(title=title, headline=headline, tone=tone, sections=sections, claims=data)


def _asked(judgement: Judgement) -> Section:
    rows: list[tuple[Child, ...]] = [
        (each.id, each.text, element("code", str(each.formula)), each.unit, each.source)
        for each in judgement.requirements
    ]
    heads = ["requirement", "text", "formula", "unit", "source"]
    return Section("asked", "What was required", (table(heads, rows),))


def _found(judgement: Judgement) -> Section:
    spread = judgement.quantiles()
    heads = ["requirement", *map(str, spread.columns)]
    numbers = [
        (str(name), *(f"{value:z.4g}" for value in values))
        for name, values in zip(spread.index, spread.to_numpy(float), strict=True)
    ]
    content = [table(heads, numbers, "Robustness, by share of the recordings")]
    outliers = judgement.outliers()
    if len(outliers):
        columns = outliers[["requirement", "file", "robustness", "distance"]].to_numpy().tolist()
        found = [(id_, file, f"{rho:z.4g}", f"{away:z.3g}") for id_, file, rho, away in columns]
        heads = ["requirement", "recording", "robustness", "distance"]
        content.append(table(heads, found[:MAX_ROWS], "Recordings unlike the others"))
    held = [row for row in judgement.rows if row.verdict == "holds"]
    content.append(_rows(judgement, (*judgement.failing, *judgement.depending, *held)))
    return Section("found", "What was found", tuple(content))


def _rows(judgement: Judgement, rows: tuple[Row, ...]) -> Markup:
    heads = ["recording", "requirement", "verdict", "robustness", "at", "why"]
    listed = []
    for row in rows[:MAX_ROWS]:
        unit = f" {row.unit}" if row.unit else ""
        at = "" if math.isnan(row.instant) else f"{format_time(row.instant)} s"
        rho = "" if math.isnan(row.robustness) else f"{row.robustness:z.4g}{unit}"
        why = "; ".join(filter(None, (row.explanation or row.error, row.note)))
        listed.append((row.file, row.requirement, row.verdict or "none", rho, at, why))
    left = len(rows) - len(listed)
    more = f"; {left:,} more are in the table" if left else ""
    return table(heads, listed, f"Verdicts, those that fail first{more}")
