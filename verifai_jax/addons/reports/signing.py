"""A page to be signed: boxes that a person fills in by hand."""

from collections.abc import Sequence

from verifai_jax.addons.reports.markup import Markup, element, paragraph, table
from verifai_jax.addons.reports.page import Section

ROLES = ("prepared by", "checked by", "approved by")


def signing_section(sentence: str) -> Section:
    """Return the section with fields for signatures."""
    rows = [(role, *(blank(name) for name in ("name", "date", "signature"))) for role in ROLES]
    content = (
        paragraph(f"By signing, each person confirms that {sentence}."),
        table(["", "name", "date", "signature"], rows),
        *box("Restrictions and remarks"),
    )
    return Section("signatures", "To be signed", content)


def blank(name: str) -> Markup:
    """Return an empty cell to fill in by hand, with a description for screen readers."""
    return element("span", class_="blank", role="img", aria_label=f"{name}: to be filled in")


def box(question: str) -> Sequence[Markup]:
    """Return a question with an empty box below it."""
    text = element("strong", question)
    return paragraph(text), element("div", class_="box", role="img", aria_label="to be filled in")
