"""The section of a report on the modes of failure, and their claims."""

from verifai_jax.addons.estimation.failure_modes import Mode, Modes
from verifai_jax.addons.reports.markup import Markup, bullets, element, paragraph, picture, table
from verifai_jax.addons.reports.page import Section
from verifai_jax.addons.reports.run_question import About
from verifai_jax.addons.reports.sections import MODEL, NOT_SEEN, SAMPLES
from verifai_jax.addons.reports.studies import png
from verifai_jax.core.messages.text import format_percent
from verifai_jax.features.english import number

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
