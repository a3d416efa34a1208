"""The report on a verification: the proved, broken and undecided parts, and their boxes."""

from typing import Any

from verifai_jax.addons.reports.claims import Claim
from verifai_jax.addons.reports.markup import Child, paragraph, picture, preformatted, table
from verifai_jax.addons.reports.page import Page
from verifai_jax.addons.reports.provenance import Model
from verifai_jax.addons.reports.run_question import About
from verifai_jax.addons.reports.sections import MODEL, problem_content, result_page, subject_of
from verifai_jax.addons.reports.studies import png
from verifai_jax.addons.verification.picture import plot_verification, with_unit
from verifai_jax.addons.verification.result import Verification
from verifai_jax.core.messages.text import format_percent
from verifai_jax.problem.problem import Problem

SAMPLED = ("The bound on what is undecided rests on independent samples of it, and holds whenever "
           "one stops.")  # fmt: skip
"""Assumption of the upper bound of the failure probability."""
MAX_BOXES = 40
"""Boxes of a table, the most probable of each verdict."""


def verification_page(result: Verification, about: About, problem: Problem | None) -> Page:
    """Make the report on a verification, with its problem if that is available."""
    about.check(None, result.features)
    model = Model.of([result.sources], None if problem is None else problem.sources())
    proved, broken, undecided = result.proved, result.broken, result.undecided
    shares = [format_percent(part.mass) for part in (proved, broken, undecided)]
    of = result.of_prior
    headline = f"{shares[0]} {of} is proved, {shares[1]} broken, {shares[2]} undecided."
    low, high = result.probability
    sure = format_percent(result.confidence)
    bounds = f"{format_percent(low)} at least, {format_percent(high)} at most"
    what = "solution" if result.continuous else "simulation"
    verified = f"What is verified is {result.subject}."
    boxes, samples = f"{len(result.boxes):,} boxes", f"{int(result.boxes.samples.sum()):,} samples"
    tails = (f"{result.cut_off[:1].upper()}{result.cut_off[1:]}.",) if result.tails else ()
    rests = MODEL, verified, *tails
    # Where a constraint cuts boxes the accepted share of the proved ones has a lower bound.
    share = f"at least {format_percent(proved.low)} (at {sure})" if result.cut.any() else shares[0]
    claims = [
        Claim("C1", f"No {what} fails in {share} {of}.", (boxes,), rests),
        Claim("C2", f"The failure probability is {bounds}, at {sure}.", (boxes, samples),
              (*rests, SAMPLED)),
    ]  # fmt: skip
    if broken.mass:
        some = f"about {shares[1]}" if result.cut.any() else shares[1]
        found = f"Boxes of {some} {of} contain a point that fails for certain."
        claims.append(Claim("C3", found, (boxes,), rests))
    named = [
        ("proved: no point fails", proved), ("broken: a point fails for certain", broken),
        ("of these, every point fails", result.throughout), ("undecided", undecided),
    ]  # fmt: skip
    parts: list[tuple[str, Child, Child]] = [
        (name, format_percent(part.mass), format_percent(part.volume)) for name, part in named
    ]
    columns = ["verdict", "mass", "lowest", "highest", "failure_bound"]
    both = result.columns, [with_unit(name, about.units) for name in result.columns]
    ends, heads = ([f"{n} {end}" for n in names for end in ("from", "to")] for names in both)
    largest: Any = result.table.groupby("verdict", sort=False).head(MAX_BOXES // 3)
    cells = largest[[*columns, *ends]].itertuples(index=False)
    rows = [[f"{v:z.4g}" if isinstance(v, float) else str(v) for v in each] for each in cells]
    largest_boxes = "The most probable boxes, between these values of the features."
    failing = format_percent(result.failure_bound)
    open_part = f"{shares[2]} {of} is undecided; at most {failing} of it fails, at {sure}."
    python = (
        f"vj.verify(problem, boxes={result.looked_at}, precision={result.precision!r}, "
        f"confidence={result.confidence}, continuous={result.continuous})"
    )
    drawn = png(plot_verification(result, units=about.units))
    asked = [] if problem is None else problem_content(problem, about)
    return result_page(
        result.name, "evidence report on a verification", headline,
        "fails" if broken.mass else "open", claims, model,
        about=subject_of("verification", problem, model, result.formulas),
        answers=[("What was the prior?", "see what was asked", "asked"),
                 ("How many boxes are there?", boxes, "found"),
                 ("How probable is a failure?", f"{bounds}, at {sure}", "found"),
                 ("Which assumption is under what is proved?", verified, "limits")],
        asked=[paragraph(f"Where no {what} of {result.name} fails, for certain."), *asked],
        found=[table(["part", "of the prior", "of the volume"], parts),
               picture(drawn, "The parts, two coordinates at a time"),
               table([*columns, *heads], rows, largest_boxes)],
        limits=[open_part, verified, SAMPLED, MODEL, *tails, *result.notes],
        reproduce=[preformatted(python), paragraph(f"Made with verifai_jax {result.version}.")],
    )  # fmt: skip
