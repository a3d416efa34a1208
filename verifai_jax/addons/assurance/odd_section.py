"""The section of a report on the design domain that a run covers."""

from collections.abc import Mapping
from typing import Any

from verifai_jax.addons.assurance.odd_coverage import OddCoverage
from verifai_jax.addons.reports.markup import paragraph, table
from verifai_jax.addons.reports.page import Page, Section, before_limits
from verifai_jax.addons.reports.run_question import NO_REASON
from verifai_jax.core.messages.text import format_percent


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
    content = (
        paragraph(text),
        table(["attribute", "feature", "inside", "reason", "source", *shares], rows),
        table(["attribute", "with", *shares], pairs, "Pairs of attributes"),
    )
    title = f"The operational design domain {found.domain.name}"
    return before_limits(page, Section("domain", title, content))


def _shares(row: Mapping[str, Any]) -> tuple[str, str, str]:
    """Write the cells of a row, and its shares of volume and prior."""
    mass = row["mass"]
    prior = format_percent(mass) if mass == mass else "not known"
    return f"{int(row['occupied'])} of {int(row['cells'])}", format_percent(row["volume"]), prior
