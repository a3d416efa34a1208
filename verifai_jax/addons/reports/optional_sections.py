"""Sections that a report may have: the error of its number, the design domain, failure modes."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

from verifai_jax.addons.analysis import OddCoverage
from verifai_jax.addons.estimation.error_budgets.result import ErrorBudget
from verifai_jax.addons.estimation.failure_modes import Mode, Modes
from verifai_jax.addons.reports.claims import Claim
from verifai_jax.addons.reports.markup import (
    Child,
    Markup,
    bullets,
    element,
    paragraph,
    picture,
    table,
)
from verifai_jax.addons.reports.page import Page, Section, before_limits
from verifai_jax.addons.reports.run_question import NO_REASON, About
from verifai_jax.addons.reports.sections import MODEL, NOT_SEEN, SAMPLES
from verifai_jax.addons.reports.studies import png
from verifai_jax.core.messages.text import format_percent
from verifai_jax.core.user_code.sources import Source as Input
from verifai_jax.features.english import number

ADDED = (
    "The parts are measured one by one and added. What two algorithms have in common, such as "
    "wrong equations, is in none of them."
)
"""Assumption of the sum."""


def with_errors(page: Page, errors: ErrorBudget) -> Page:
    """Return a page with this section before the limits, and its claim as `E1`."""
    rows: list[Sequence[Child]] = [
        (
            part.name,
            f"{part.low:+z.2g} to {part.high:+z.2g}" if part.measured else "not measured",
            "yes" if part.counted and part.measured else "no",
            part.text,
        )
        for part in errors.parts
    ]
    section = Section(
        "errors",
        "How wrong the number can be",
        (
            paragraph("Claim E1: ", errors.total),
            table(["part", "greater by", "in the sum", "how it was found"], rows),
            paragraph(ADDED),
            paragraph(f"The prior: {errors.prior}"),
        ),
    )
    evidence = (f"{errors.simulations:,} simulations", "section errors")
    claim = Claim("E1", errors.total, evidence, (ADDED,))
    claims = {**page.claims, "claims": [*page.claims["claims"], asdict(claim)]}
    return replace(before_limits(page, section), claims=claims)


def with_odd(page: Page, found: OddCoverage) -> Page:
    """Return a page with this section before the limits."""
    rows = []
    for each in found.domain.attributes:
        row = found.table.loc[each.name].to_dict()
        said = (each.reason or NO_REASON, each.source or NO_REASON)
        rows.append((each.name, row["feature"] or "none", row["inside"], *said, *_shares(row)))
    pairs = [(*names, *_shares(row)) for names, row in found.pairs.to_dict("index").items()]
    shares = ["cells with a row", "of the volume", "of the prior"]
    text = (
        f"Of {found.rows:,} rows with a verdict {found.outside:,} are outside the domain, and not "
        "counted below. A cell is a part of an attribute's range, or one of its values."
    )
    section = Section(
        "domain",
        f"The operational design domain {found.domain.name}",
        (
            paragraph(text),
            table(["attribute", "feature", "inside", "reason", "source", *shares], rows),
            table(["attribute", "with", *shares], pairs, "Pairs of attributes"),
        ),
    )
    return before_limits(page, section)


def with_files(page: Page, files: Sequence[Input]) -> Page:
    """Return a page with a section on further files, which are in its claims, too."""
    rows = [(each.name, each.role, element("code", each.sha256)) for each in files]
    content = table(["file", "what it is", "SHA-256"], rows)
    section = Section("files", "Further files that this report rests on", (content,))
    claims = {**page.claims, "files": [each._asdict() for each in files]}
    return replace(before_limits(page, section), claims=claims)


def _shares(row: Mapping[str, Any]) -> tuple[str, str, str]:
    """Write the cells of a row, and its shares of volume and prior."""
    mass = row["mass"]
    prior = format_percent(mass) if mass == mass else "not known"
    return f"{int(row['occupied'])} of {int(row['cells'])}", format_percent(row["volume"]), prior


MAX_MODES = 8
"""Ways of failing that are written out."""


def modes_section(found: Modes, about: About) -> Section:
    """Write the modes of failure, the most probable first."""
    content: list[Markup] = [paragraph(_whole(found))]
    if found.modes:
        rows = [
            (str(mode.number), mode.name, _probability(mode, found), format_percent(mode.share))
            for mode in found.modes
        ]
        content.append(table(["mode", "where", "probability", "of the failures"], rows))
        content.append(picture(png(found.plot()), "The ways of failing, with their probabilities"))
    for mode in found.modes[:MAX_MODES]:
        content.append(element("h3", f"Mode {mode.number}: its likeliest failure"))
        out = f"It lies {mode.distance:z.3g} standard deviations from the middle of the prior."
        content.append(paragraph(f"{_sentence(mode.cause)} {out}" if mode.cause else out))
        values = [
            (name, f"{number(value)} {about.units.get(name, '')}".strip())
            for name, value in mode.features.items()
        ]
        content.append(table(["feature", "value"], values))
    if (left := len(found.modes) - MAX_MODES) > 0:
        content.append(paragraph(f"{left} further ones stand in the table alone."))
    if found.notes:
        content.append(bullets([f"{note}." for note in found.notes]))
    return Section("modes", "Ways of failing, with their probabilities", tuple(content))


def mode_claims(found: Modes) -> list[tuple[str, tuple[str, ...], tuple[str, ...]]]:
    """Return sentence, evidence and assumptions of the claims that the modes support."""
    evidence = (f"{found.simulations:,} simulations of their own",)
    assumptions = (MODEL, SAMPLES, NOT_SEEN)
    claims: list[tuple[str, tuple[str, ...], tuple[str, ...]]] = [
        (_whole(found), evidence, assumptions)
    ]
    for mode in found.modes[:MAX_MODES]:
        sentence = (
            f"A failure of mode {mode.number} ({mode.name}) has probability "
            f"{_probability(mode, found)}."
        )
        claims.append((sentence, evidence, assumptions))
    return claims


def _whole(found: Modes) -> str:
    sure = format_percent(found.confidence)
    if found.probability is None:
        return (
            f"No way of failing was found in {found.simulations:,} simulations of this search; a "
            f"failure has probability {found.upper_bound:z.2g} at most ({sure} bound)."
        )
    text = (
        f"A failure has probability {found.probability:z.3g} ({sure} interval {found.low:z.3g} to "
        f"{found.high:z.3g}) under the prior, by {found.simulations:,} simulations."
    )
    if found.modes:
        low, high = found.unexplained
        text += (
            f" {format_percent(low)} to {format_percent(high)} of the failures belong to none of "
            "the modes."
        )
    return text


def _probability(mode: Mode, found: Modes) -> str:
    sure = format_percent(found.confidence)
    return f"{mode.probability:z.3g} ({sure} interval {mode.low:z.3g} to {mode.high:z.3g})"


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."
