"""The section of a report on the error of its number."""

from dataclasses import asdict, replace

from verifai_jax.addons.estimation.error_budgets.result import ErrorBudget
from verifai_jax.addons.reports.claims import Claim
from verifai_jax.addons.reports.markup import paragraph, table
from verifai_jax.addons.reports.page import Page, Section, before_limits

ADDED = (
    "The parts are measured one by one and added. What two algorithms have in common, such as "
    "wrong equations, is in none of them."
)
"""Assumption of the sum."""


def with_errors(page: Page, errors: ErrorBudget) -> Page:
    """Return a page with this section before the limits, and its claim as `E1`."""
    rows = []
    for part in errors.parts:
        by = f"{part.low:+z.2g} to {part.high:+z.2g}" if part.measured else "not measured"
        rows.append((part.name, by, "yes" if part.counted and part.measured else "no", part.text))
    content = (
        paragraph("Claim E1: ", errors.total),
        table(["part", "greater by", "in the sum", "how it was found"], rows),
        paragraph(ADDED),
        paragraph(f"The prior: {errors.prior}"),
    )
    section = Section("errors", "How wrong the number can be", content)
    evidence = (f"{errors.simulations:,} simulations", "section errors")
    claim = Claim("E1", errors.total, evidence, (ADDED,))
    claims = {**page.claims, "claims": [*page.claims["claims"], asdict(claim)]}
    return replace(before_limits(page, section), claims=claims)
