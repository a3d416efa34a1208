"""Sections for an assessor, beyond the findings: credibility, the claims as a tree, signatures.

    with_assessment(page)                           # the page with three sections more

The steps are those of FDA, Assessing the Credibility of Computational Modeling and Simulation in
Medical Device Submissions (November 2023). What the report says to a step is referred to, and the
rest is an empty box with its question: a tool cannot know it, and does not make it up.
"""

from dataclasses import replace

from verifai_jax.reports.claims_tree import claims_tree
from verifai_jax.reports.markup import Markup, element, paragraph
from verifai_jax.reports.page import Page, Section
from verifai_jax.reports.signing import box, signing_section

STEPS = (
    ("Question of interest", ("asked",), "Which decision depends on this simulation?"),
    (
        "Context of use",
        ("asked",),
        "What part does the simulation have beside tests and analyses, and in which domain is the "
        "machine used?",
    ),
    (
        "Model risk",
        (),
        "How much does the decision rest on the simulation, and how grave is it if it is wrong?",
    ),
    (
        "Credibility evidence",
        ("found", "failures", "errors", "reproduce"),
        "Which evidence is there that the model stands for the machine: comparisons with "
        "measurements, reviews of the equations, earlier use?",
    ),
    (
        "Credibility factors and goals",
        (),
        "How good must each kind of evidence be for this risk, as set before the simulations?",
    ),
    (
        "Adequacy, before",
        (),
        "Would evidence that reaches these goals be enough for the decision?",
    ),
    (
        "Generation of the evidence",
        ("found", "limits", "reproduce"),
        "What was done apart from this run: measurements, other models, other versions?",
    ),
    (
        "Goals reached, and adequacy, after",
        ("claims", "limits"),
        "Which goals were reached, which were not, and is the evidence enough all the same?",
    ),
    ("Report", ("claims",), "Where is this report filed, and what goes with it?"),
)
"""Steps: name, sections of a report that serve it, and the question that a person answers."""


def with_assessment(page: Page) -> Page:
    """Return a page with the claims as a tree, the nine steps of credibility, and signatures."""
    titles = {section.anchor: section.title for section in page.sections}
    content: list[Markup] = [
        paragraph(
            "What this report says to a step is linked. The boxes are to be filled in by a person: "
            "the tool does not know the answers."
        )
    ]
    for number, (name, anchors, question) in enumerate(STEPS, 1):
        content.append(element("h3", f"{number}. {name}"))
        links = [element("a", titles[a], href=f"#{a}") for a in anchors if a in titles]
        said = [[", ", link] if i else [link] for i, link in enumerate(links)]
        content.append(
            paragraph("In this report: ", said if links else "nothing.", "." * bool(links))
        )
        content += box(question)
    tree = claims_tree(page.claims["subject"], page.headline, page.claims["claims"])
    sections = (
        *page.sections,
        Section("tree", "The claims as a tree", (element("figure", tree),)),
        Section("credibility", "Credibility of the simulation, in nine steps", tuple(content)),
        signing_section("the claims above follow from the evidence, within what was not shown"),
    )
    return replace(page, sections=sections)
