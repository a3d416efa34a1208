"""Sections that reports on all kinds of results share: claims, inputs, versions, what was asked."""

from collections.abc import Sequence

from verifai_jax.problem.problem import Problem
from verifai_jax.reports.claims import Claim
from verifai_jax.reports.markup import Child, Markup, element, paragraph, table
from verifai_jax.reports.page import Section
from verifai_jax.reports.provenance import Link, versions
from verifai_jax.reports.run_question import About, property_content, space_table

MODEL = (
    "The system is the one that was simulated: how far its model is from the machine is not part "
    "of this evidence."
)
"""Assumption of every claim about a system."""
NOT_SEEN = (
    "The interval holds if the method has met every part of the space in which failures are; the "
    "guaranteed bound needs no such assumption."
)
"""Assumption of an interval that a search has helped to find."""
SAMPLES = "The guaranteed bound rests on independent samples of the prior, and on nothing else."
"""Assumption of the bound."""


def claims_section(claims: list[Claim]) -> Section:
    """Write claims with their evidence, and the assumptions that they share once each."""
    shared = list(dict.fromkeys(text for each in claims for text in each.assumptions))
    rows = [
        (
            each.identifier,
            each.claim,
            "; ".join(each.evidence),
            ", ".join(f"A{shared.index(text) + 1}" for text in each.assumptions),
        )
        for each in claims
    ]
    return Section(
        "claims",
        "Claims, for a safety case",
        (
            paragraph(
                "The same is in this file as JSON, in the element ",
                element("code", "claims-json"),
                ", and in a file beside it.",
            ),
            table(["claim", "sentence", "evidence", "assumes"], rows),
            table(["assumption", "sentence"], [(f"A{i + 1}", t) for i, t in enumerate(shared)]),
        ),
    )


def chain_table(links: tuple[Link, ...]) -> Markup:
    """Write the inputs of a report with their hashes."""
    code = [
        (link.input.name, link.input.role, element("code", link.input.sha256), _short(link.chain))
        for link in links
    ]
    return table(["input", "what it is", "SHA-256", "chain"], code)


def _short(text: str) -> Markup:
    return element("code", text[:16])


def version_table() -> Markup:
    """Write the versions that built the report."""
    return table(["built with", "version"], versions())


def chain_words(chain: str) -> Markup:
    """Write how the chain is made, and its last hash."""
    return paragraph(
        "Each link is the SHA-256 of the link before (empty for the first), a line break, the name "
        "of the input, a line break, and its SHA-256. The last link stands for all inputs: ",
        element("code", chain),
        ". Data that the system reads in any other way is not among them.",
    )


def provenance_content(links: Sequence[Link]) -> list[Markup]:
    """Write the versions and the inputs of a report, and the chain of their hashes."""
    content = [element("h3", "Versions"), version_table()]
    if links:
        content += [
            element("h3", "Inputs"),
            chain_table(tuple(links)),
            chain_words(links[-1].chain),
        ]
    return content


def problem_content(problem: Problem, about: About) -> list[Markup]:
    """Write the property and the space of a problem."""
    nominal = dict(problem.nominal or {})
    texts = {name: str(formula) for name, formula in problem.formulas.items()}
    return [
        *property_content(texts, problem),
        element("h3", "What was varied, and how likely it is"),
        space_table(problem.space, nominal, about),
    ]


def answers_section(rows: Sequence[tuple[str, str, str]]) -> Section:
    """Answer the questions of an auditor, with links to the long answers.

    **Arguments:**

    - `rows`: question, answer, and the anchor of the section that says more.
    """
    cells: list[list[Child]] = [
        [asked, answer, element("a", anchor, href=f"#{anchor}")] for asked, answer, anchor in rows
    ]
    return Section(
        "answers",
        "In short: the questions of an auditor",
        (table(["question", "answer", "section"], cells),),
    )
