"""Sections common to reports on all kinds of results: claims, inputs, versions, the question."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from verifai_jax.addons.reports.claims import Claim, about_json, claims_json
from verifai_jax.addons.reports.markup import Child, Markup, bullets, element, paragraph, table
from verifai_jax.addons.reports.page import Page, Section, before_limits
from verifai_jax.addons.reports.provenance import Input, Link, Model, chained, versions
from verifai_jax.addons.reports.run_question import About, property_content, space_table
from verifai_jax.problem.model_digest import digest_of_model
from verifai_jax.problem.problem import Problem

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

MAX_FINDINGS = 5
"""Rows that do not give their numbers again that are listed on the first page."""
SAMPLES = "The guaranteed bound rests on independent samples of the prior, and on nothing else."
"""Assumption of the bound."""


def claims_section(claims: list[Claim]) -> Section:
    """Write claims with their evidence, and shared assumptions only once."""
    shared = list(dict.fromkeys(text for each in claims for text in each.assumptions))
    rows = []
    for each in claims:
        assumed = ", ".join(f"A{shared.index(text) + 1}" for text in each.assumptions)
        rows.append((each.identifier, each.claim, "; ".join(each.evidence), assumed))
    name = element("code", "claims-json")
    content = (
        paragraph("The same is in this file as JSON, in the element ", name,
                  ", and in a file beside it."),
        table(["claim", "sentence", "evidence", "assumes"], rows),
        table(["assumption", "sentence"], [(f"A{i + 1}", t) for i, t in enumerate(shared)]),
    )  # fmt: skip
    return Section("claims", "Claims, for a safety case", content)


def model_warnings(model: Model, findings: Sequence[str] = ()) -> tuple[Markup, ...]:
    """Write how the model has changed, and which rows did not give their numbers; often empty."""
    content: list[Markup] = []
    if model.changes:
        changed = element("strong", "The model has changed since this result was made. ")
        text = (
            "Numbers of the result are of the model as it was; whatever was simulated for this "
            "report is of the model as it is now."
        )
        rows = []
        for name, was, now in model.changes:
            codes = (
                element("code", was or "had no part in it"),
                element("code", now or "is missing"),
            )
            rows.append((name, *codes))
        hashes = table(["file", "SHA-256 when it ran", "SHA-256 now"], rows)
        content += [paragraph(changed, text), hashes]
    if len(model.parts) > 1:
        notes = " and ".join(f"from row {part.first} on" for part in model.parts[1:])
        text = "The result is of several models or versions: it went on with others"
        content.append(paragraph(f"{text} {notes}."))
    if findings:
        text = "Simulated again, rows do not give their numbers:"
        content.append(paragraph(element("strong", text)))
        shown = [*findings[:MAX_FINDINGS]]
        if len(findings) > MAX_FINDINGS:
            shown.append(f"and {len(findings) - MAX_FINDINGS} more")
        content.append(bullets(shown))
    return tuple(content)


def model_answer(model: Model) -> tuple[str, str, str]:
    """Return whether the model has changed, as question, answer and anchor."""
    return "Is the model still the one that ran?", model.answer, "reproduce"


def chain_table(links: tuple[Link, ...]) -> Markup:
    """Write the inputs of a report with their hashes."""
    rows = []
    for (name, role, sha256), chain in links:
        rows.append((name, role, element("code", sha256), element("code", chain[:16])))
    return table(["input", "what it is", "SHA-256", "chain"], rows)


def version_table(model: Model) -> Markup:
    """Write the versions with which the result and the report were made."""
    now = dict(versions())
    then = dict(model.parts[-1].versions) if model.parts else {}
    names = dict.fromkeys((*now, *then))
    rows = [(name, then.get(name, "not recorded"), now.get(name, "not used")) for name in names]
    return table(["package", "the result", "this report"], rows)


def chain_words(chain: str) -> Markup:
    """Explain the chain, and write its last hash."""
    text = (
        "Each link is the SHA-256 of the link before (empty for the first), a line break, the name "
        "of the input, a line break, and its SHA-256. The last link stands for all inputs: "
    )
    return paragraph(text, element("code", chain), ".")


def provenance_content(links: Sequence[Link], model: Model) -> list[Markup]:
    """Write the versions and the inputs of a report, with their hash chain."""
    content = [element("h3", "Versions"), version_table(model)]
    if links:
        content += [
            element("h3", "Inputs"),
            chain_table(tuple(links)),
            chain_words(links[-1].chain),
            paragraph(
                "Files of the model have the hashes that they had when the result was made. What "
                "the system reads in any other way, such as in another process, is not among them."
            ),
        ]
    return content


def problem_content(problem: Problem, about: About) -> list[Markup]:
    """Write the property and the space of a problem."""
    nominal = dict(problem.nominal or {})
    texts = {name: str(formula) for name, formula in problem.formulas.items()}
    return [
        *property_content(texts, problem, problem.requirement_entries()),
        element("h3", "What was varied, and how likely it is"),
        space_table(problem.space, nominal, about),
    ]


def subject_of(
    kind: str, problem: Problem | None, model: Model, formulas: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Return what claims are about, as far as a problem says it; by default on its formulas."""
    if problem is None:
        return {}
    texts = {name: str(each) for name, each in (formulas or problem.formulas).items()}
    digest = "" if model.changes else digest_of_model(problem)
    return about_json(kind, texts, problem.requirement_entries(), digest)


def answers_section(rows: Sequence[tuple[str, str, str]]) -> Section:
    """Answer an auditor's questions; each row has the anchor of the section with details, too."""
    cells: list[list[Child]] = [
        [asked, answer, element("a", anchor, href=f"#{anchor}")] for asked, answer, anchor in rows
    ]
    content = table(["question", "answer", "section"], cells)
    return Section("answers", "In short: the questions of an auditor", (content,))


def result_page(
    name: str,
    kind: str,
    headline: str,
    tone: str,
    claims: list[Claim],
    model: Model,
    *,
    answers: Sequence[tuple[str, str, str]],
    asked: Sequence[Markup],
    found: Sequence[Markup],
    limits: Sequence[Child],
    reproduce: Sequence[Markup],
    files: Sequence[Input] = (),
    about: Mapping[str, Any] | None = None,
    warned: Model | None = None,
) -> Page:
    """Make the report on a result; all kinds of results have the same sections.

    **Arguments:**
    - `name`, `kind`: the subject of the claims, and the kind of report; both are its title.
    - `headline`, `tone`, `claims`, `about`: as in `Page` and `claims_json`.
    - `model`, `files`: files of the model, and of the result; `warned`: the model whose changes the
      page warns of, if it is another.
    - `answers`, `asked`, `found`, `limits`, `reproduce`: content of these sections.
    """
    links = tuple(chained([*files, *model.inputs]))
    chain = links[-1].chain if links else ""
    first = ("What was claimed?", headline, "claims")
    again = (*reproduce, *provenance_content(links, model))
    sections = (
        answers_section([first, *answers, model_answer(model)]),
        Section("asked", "What was asked", tuple(asked)),
        Section("found", "What was found", tuple(found)),
        Section("limits", "What was not shown", (bullets(limits),)),
        claims_section(claims),
        Section("reproduce", "How to reproduce it", again),
    )
    claimed = claims_json(name, claims, chain, about)
    warnings = model_warnings(warned or model)
    return Page(f"{name}: {kind}", headline, tone, sections, claimed, warnings=warnings)


def with_files(page: Page, files: Sequence[Input]) -> Page:
    """Return a page with a section on further files, which are in its claims, too."""
    rows = [(each.name, each.role, element("code", each.sha256)) for each in files]
    content = table(["file", "what it is", "SHA-256"], rows)
    section = Section("files", "Further files that this report rests on", (content,))
    claims = {**page.claims, "files": [each._asdict() for each in files]}
    return replace(before_limits(page, section), claims=claims)
