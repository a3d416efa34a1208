"""The question of a run: the property, the space with its prior, the system, the search."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from verifai_jax.addons.reports.english import formula_words
from verifai_jax.addons.reports.markup import Child, Markup, element, paragraph, table
from verifai_jax.addons.reports.page import Section
from verifai_jax.core.messages.errors import check_names
from verifai_jax.core.messages.text import format_seconds, one_line
from verifai_jax.falsification.run import Run
from verifai_jax.features import FeatureSpace
from verifai_jax.features.english import number
from verifai_jax.mtl import parse
from verifai_jax.problem.problem import Problem

ENDS = {
    "hold": "After the end of a trace its last sample counts as if it went on for ever.",
    "truncate": "The reading of a formula beyond the end of a trace is left out.",
}
"""Meaning of the end of a trace for the formulas."""
NO_REASON = "not stated"
"""Cell of a missing unit or reason."""
DEMANDED = ("text", "source", "severity", "rationale", "links")
"""What is shown of a requirement."""


@dataclass(frozen=True)
class About:
    """A user's descriptions of the features: their `units` and the `reasons` of their ranges."""

    units: Mapping[str, str]
    reasons: Mapping[str, str]

    def check(self, space: FeatureSpace | None, columns: Iterable[str] = ()) -> None:
        """Raise `UnknownNameError` for a name that is no feature of the space and no column."""
        known = [*([] if space is None else space.domains), *columns]
        check_names("feature", [*self.units, *self.reasons], list(dict.fromkeys(known)))


def question(run: Run, about: About) -> Section:
    """Write the question that the run answers."""
    space = space_of(run)
    content = [
        *property_content(run.formulas, run.problem, run.requirements),
        element("h3", "What was varied, and how likely it is"),
        _space(run, space, about),
        *_constraint(run, space),
        element("h3", "The system, and how it was searched"),
        table(["what", "value"], system_rows(run)),
    ]
    return Section("asked", "What was asked", tuple(content))


def space_of(run: Run) -> FeatureSpace | None:
    """Return the feature space of a run; None if the record does not contain it."""
    if run.problem is not None:
        return run.problem.space
    try:
        return FeatureSpace.from_json(run.space_data or {}, where=_unknown)
    except ValueError:
        return None


def _unknown(features: Any) -> Any:
    """Stand for a constraint that is code, which a record does not hold."""
    raise ValueError("the constraint is code, which the record of a run does not hold")


def property_content(
    texts: Mapping[str, str], problem: Problem | None, requirements: Mapping[str, Mapping[str, str]]
) -> list[Markup]:
    """Write properties as formulas and in English, with what the problem says, if there is one."""
    rows = [
        (name, element("code", text), formula_words(parse(text))) for name, text in texts.items()
    ]
    kept = "this property" if len(rows) == 1 else f"all of these {len(rows)} properties"
    described = "" if problem is None else problem.description
    content = [paragraph(f"{described[:1].upper()}{described[1:]}.")] if described else []
    content += [
        paragraph(f"Every simulation was to keep {kept}."),
        table(["property", "formula", "in words"], rows),
    ]
    if requirements:
        about = []
        for name in texts:
            known = requirements.get(name, {})
            about.append((name, *(known.get(each, NO_REASON) for each in DEMANDED)))
        content.append(table(["requirement", *DEMANDED], about, "The requirements they stand for"))
    if problem is not None:
        content.append(paragraph(ENDS[problem.end]))
        if problem.priority is not None:
            content.append(paragraph(f"Priority among them: {problem.priority}."))
    return content


def prior_rows(space: FeatureSpace) -> list[tuple[str, str]]:
    """Return each feature with a description of its prior."""
    return [(name, domain.words()) for name, domain in space.domains.items()]


def _space(run: Run, space: FeatureSpace | None, about: About) -> Markup:
    if space is None:
        text = "The record of the run does not describe its feature space; its columns are"
        return paragraph(f"{text} {', '.join(run.table.features)}.")
    return space_table(space, {} if run.problem is None else dict(run.problem.nominal or {}), about)


def space_table(space: FeatureSpace, nominal: Mapping[str, Any], about: About) -> Markup:
    """Write each feature with its prior, unit, nominal value and the reason for its range."""
    rows: list[list[Child]] = []
    for name, words in prior_rows(space):
        usual = _nominal(nominal[name]) if name in nominal else NO_REASON
        unit, reason = about.units.get(name, NO_REASON), about.reasons.get(name, NO_REASON)
        rows.append([name, words, unit, usual, reason])
    return table(["feature", "values and prior", "unit", "nominal", "reason of the range"], rows)


def _nominal(value: Any) -> str:
    if np.ndim(value) == 0 or isinstance(value, str):
        return number(np.asarray(value).item() if np.ndim(value) == 0 else value)
    return one_line(str(value), 80)


def _constraint(run: Run, space: FeatureSpace | None) -> list[Markup]:
    named = (run.space_data or {}).get("where")
    if named is None and (space is None or space.where is None):
        return []
    text = (
        f"A constraint, {named or 'a function'}, decides which of these combinations count: "
        "the prior is the one above under that condition."
    )
    if run.acceptance is not None:
        text += f" It let through {run.acceptance:z.3g} of the proposals."
    return [paragraph(text)]


def system_rows(run: Run) -> list[tuple[str, Child]]:
    """Return names and descriptions of the system and the search."""
    problem = run.problem
    rows: list[tuple[str, Child]] = []
    if run.target is not None:
        rows.append(("problem", element("code", str(run.target))))
    if problem is not None:
        system = problem.system
        function = getattr(system, "__wrapped__", system)
        name = getattr(function, "__qualname__", type(system).__qualname__)
        module = getattr(function, "__module__", "") or ""
        rows.append(("system", element("code", f"{module}.{name}".removeprefix("__main__."))))
        form, duration = (None, None) if problem.black_box else (problem.form(), problem.duration)
        if form is not None and form.dt is not None and duration is not None:
            lasts, period = format_seconds(duration), format_seconds(form.dt)
            rows.append(("duration", f"{lasts}, a sample every {period}"))
        rows.append(("kind", "black box" if problem.black_box else "traced by JAX"))
        if system.exact_step:
            rows.append(("integration step", "belongs to the system, as its authors published it"))
    rows += [
        ("arithmetic", run.precision),
        ("backend", run.backend or "the only one of the system"),
        ("search", element("code", run.search)),
        ("seed", run.seed),
        ("budget", f"{run.budget:,} simulations, in batches of {run.batch:,}"),
        ("ended by", f"{run.stopped}, after {run.simulations:,} simulations"),
        ("closer replays", "yes" if run.confirm else "no: violations are claimed as simulated"),
        ("version of verifai_jax that made the run", run.version),
    ]
    return rows
