"""The report on an estimate: the probability, its interval, the bound that rests on the prior."""

from verifai_jax.addons.estimation.result import METHODS, Estimate
from verifai_jax.addons.reports import sections
from verifai_jax.addons.reports.claims import Claim
from verifai_jax.addons.reports.markup import Child, paragraph, picture, preformatted, table
from verifai_jax.addons.reports.page import Page
from verifai_jax.addons.reports.provenance import Model
from verifai_jax.addons.reports.run_question import About
from verifai_jax.addons.reports.sections import MODEL, NOT_SEEN, SAMPLES
from verifai_jax.addons.reports.studies import png
from verifai_jax.core.messages.text import format_percent
from verifai_jax.problem.problem import Problem


def estimate_page(estimate: Estimate, about: About, problem: Problem | None) -> Page:
    """Make the report on an estimate, with its problem if that is available."""
    about.check(None if problem is None else problem.space)
    model = Model.of([estimate.sources], None if problem is None else problem.sources())
    sure = format_percent(estimate.confidence)
    interval = f"{estimate.low:z.3g} to {estimate.high:z.3g}"
    bound = f"{estimate.upper_bound:z.2g}"
    if estimate.probability is None:
        headline = f"No estimate of the failure probability; at most {bound}, at {sure}."
    else:
        headline = (
            f"Fails with probability {estimate.probability:z.3g} ({sure} interval {interval}); "
            f"guaranteed at most {bound}."
        )
    drawn_from = "the prior" if estimate.rest == 1 else "what a proof leaves of the prior"
    method = METHODS.get(estimate.method or "", "none that gave an estimate")
    assumptions = [MODEL, SAMPLES]
    if estimate.method not in (None, "monte_carlo"):
        assumptions.append(NOT_SEEN)
    sampled = (
        f"{estimate.prior_failures:,} failures and {estimate.prior_no_verdict:,} without a verdict "
        f"in {estimate.prior_simulations:,} samples of {drawn_from}"
    )
    claims = [
        Claim("C1", headline, (f"{estimate.simulations:,} simulations",), tuple(assumptions)),
        Claim("C2", f"The failure probability is at most {bound} at {sure}.", (sampled,),
              (MODEL, SAMPLES)),
    ]  # fmt: skip
    if estimate.p0 is not None:
        shown = estimate.upper_bound <= estimate.p0
        words = "is shown" if shown else f"is not shown by samples of {drawn_from} alone"
        sentence = f"That the probability is below {estimate.p0:zg} {words}."
        claims.append(Claim("C3", sentence, ("the guaranteed bound",), (MODEL, SAMPLES)))
    numbers: list[tuple[str, Child]] = [
        ("simulations", f"{estimate.simulations:,} of {estimate.budget:,}"),
        ("failing", f"{estimate.failures:,}"),
        ("without a verdict", f"{estimate.no_verdict:,}"),
        ("method", method),
        ("interval", f"{interval}, at {sure}"),
        ("guaranteed bound", f"{bound}, at {sure}"),
        (f"independent samples of {drawn_from}", f"{estimate.prior_simulations:,}"),
        ("failures among these", f"{estimate.prior_failures:,}"),
        ("without a verdict among these", f"{estimate.prior_no_verdict:,}"),
        ("relative error", format_percent(estimate.relative_error)),
    ]
    if estimate.rest < 1:
        shares = map(format_percent, (estimate.rest, estimate.certain))
        numbers.append(("left by a proof, and certain to fail", ", ".join(shares)))
    asked = [paragraph(f"How probable a failure of {estimate.name} is, under the prior.")]
    asked += [] if problem is None else sections.problem_content(problem, about)
    prior = "not stated" if problem is None else "see the table of features"
    steps = [f"seed {estimate.seed}", f"precision {estimate.precision}"]
    steps += [f"backend {estimate.backend}"] if estimate.backend else []
    python = (
        f"vj.estimate(problem, budget={estimate.budget}, seed={estimate.seed}, "
        f"confidence={estimate.confidence}, precision={estimate.precision!r})"
    )
    without = (
        f"{estimate.no_verdict:,} simulations have no verdict; the upper ends take those of the "
        "prior's samples for failing."
    )
    return sections.result_page(
        estimate.name, "evidence report on a probability", headline, "open", claims, model,
        about=sections.subject_of("estimate", problem, model),
        answers=[
            ("What was the prior?", prior, "asked"),
            ("How many simulations were there?", f"{estimate.simulations:,}", "found"),
            ("How many had no verdict?", f"{estimate.no_verdict:,}", "limits"),
            ("Which assumption is under the interval?", assumptions[-1], "limits"),
            ("With which seed?", ", ".join(steps), "reproduce"),
        ],
        asked=asked,
        found=[
            table(["number", "value"], numbers),
            picture(png(estimate.plot()), "The interval, and what the method saw"),
        ],
        limits=[without, *assumptions, *estimate.notes],
        reproduce=[preformatted(python), paragraph(f"Made with verifai_jax {estimate.version}.")],
    )  # fmt: skip
