"""Sections for an assessor, beyond the findings: credibility, the claims as a tree, signatures.

    with_assessment(page)                           # the page with three sections more

The steps are questions that assessors of simulations ask. A step refers to the parts of the report
that answer it. All other questions get an empty box, since the tool cannot know the answers.

The claims are drawn as a tree in Goal Structuring Notation: goals are rectangles, a strategy is a
parallelogram, solutions are circles, assumptions are ellipses with an A, the context is a rounded
rectangle, and a diamond marks a goal that is not developed.
"""

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from verifai_jax.addons.reports.markup import Markup, element, paragraph
from verifai_jax.addons.reports.page import Page, Section
from verifai_jax.addons.reports.signing import box, signing_section

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
    ("Adequacy, before", (), "Would evidence that reaches these goals be enough for the decision?"),
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
    """Return a page with a tree of claims, the nine steps of credibility, and signatures."""
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


WIDTH, LINE = 900, 16
GOALS, SOLUTIONS, ASSUMPTIONS = 30, 480, 720
"""Left ends of the columns of claims, of their evidence, and of what they assume."""
UNDEVELOPED = "The model that was simulated stands for the machine in its domain."
"""The goal that no simulation can support: a person argues it."""
INK = {"fill": "none", "stroke": "#30323d"}


def claims_tree(subject: str, headline: str, claims: Sequence[Mapping[str, Any]]) -> Markup:
    """Draw the tree: the headline at the root, the strategy, and a row for each claim."""
    shared = list(dict.fromkeys(text for each in claims for text in each["assumptions"]))
    parts: list[Markup] = []
    top = _box(parts, GOALS, 10, 420, f"G0 {headline}") + 10
    _box(parts, SOLUTIONS + 30, 10, 340, f"Context: {subject}", round_=14)
    _line(parts, GOALS + 420, 30, SOLUTIONS + 30, 30)
    y = top + 20
    _line(parts, GOALS + 60, top, GOALS + 60, y)
    strategy = "S1 Argue over each claim on its own evidence, and over what the tool cannot show"
    y = _box(parts, GOALS, y, 420, strategy, slant=14) + 24
    spine = y - 24
    for each in claims:
        bottom = _box(parts, GOALS + 30, y, 390, f"{each['identifier']} {each['claim']}")
        middle = y + 20
        _line(parts, GOALS + 10, middle, GOALS + 30, middle)
        _line(parts, GOALS + 420, middle, SOLUTIONS, middle)
        bottom = max(bottom, _round(parts, SOLUTIONS, y, 220, "; ".join(each["evidence"])))
        if each["assumptions"]:
            names = ", ".join(f"A{shared.index(text) + 1}" for text in each["assumptions"])
            bottom = max(bottom, _round(parts, ASSUMPTIONS, y, 150, names))
        y = bottom + 22
    bottom = _box(parts, GOALS + 30, y, 390, f"GM {UNDEVELOPED}")
    _line(parts, GOALS + 10, y + 20, GOALS + 30, y + 20)
    _line(parts, GOALS + 10, spine, GOALS + 10, y + 20)
    centre = GOALS + 225
    diamond = f"{centre},{bottom} {centre + 12},{bottom + 12} {centre},{bottom + 24}"
    parts.append(element("polygon", points=f"{diamond} {centre - 12},{bottom + 12}", **INK))
    y = bottom + 44
    for index, text in enumerate(shared, 1):
        y = _text(parts, GOALS, y, f"A{index} (assumption): {text}", 110) + 4
    return element(
        "svg", parts, viewBox=f"0 0 {WIDTH} {y + 10}", width=WIDTH, height=y + 10, role="img",
        aria_label=f"Tree of the claims on {subject}; the table of claims says the same",
    )  # fmt: skip


def _text(parts: list[Markup], x: int, y: int, text: str, columns: int) -> int:
    """Write lines from `y` on; return the end."""
    for line in textwrap.wrap(text, columns) or [""]:
        y += LINE
        parts.append(element("text", line, x=x, y=y, font_size=13, font_family="sans-serif"))
    return y


def _box(
    parts: list[Markup], x: int, y: int, width: int, text: str, round_: int = 0, slant: int = 0
) -> int:
    """Draw a rectangle around a text, or a parallelogram; return its lower end."""
    end = _text(parts, x + 10 + slant, y + 4, text, (width - 2 * slant) // 8) + 10
    if slant:
        points = f"{x + slant},{y} {x + width},{y} {x + width - slant},{end} {x},{end}"
        parts.append(element("polygon", points=points, **INK))
    else:
        shape = {"x": x, "y": y, "width": width, "height": end - y, "rx": round_}
        parts.append(element("rect", **shape, **INK))
    return end


def _round(parts: list[Markup], x: int, y: int, width: int, text: str) -> int:
    """Draw an ellipse around a text; return its lower end."""
    end = _text(parts, x + width // 6, y + 6, text, width // 12) + 14
    centre = {"cx": x + width // 2, "cy": (y + end) // 2, "rx": width // 2, "ry": (end - y) // 2}
    parts.append(element("ellipse", **centre, **INK))
    return end


def _line(parts: list[Markup], x1: int, y1: int, x2: int, y2: int) -> None:
    parts.append(element("line", x1=x1, y1=y1, x2=x2, y2=y2, stroke="#30323d"))
