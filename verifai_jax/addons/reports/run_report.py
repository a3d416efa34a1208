"""The report on a run: its sections, its claims, and the answers to an auditor's questions."""

from dataclasses import dataclass

import numpy as np

from verifai_jax.addons.reports import run_findings
from verifai_jax.addons.reports.claims import Claim, about_json, claims_json
from verifai_jax.addons.reports.commands import report_command, run_command, run_python
from verifai_jax.addons.reports.english import formula_words
from verifai_jax.addons.reports.markup import element, paragraph, preformatted
from verifai_jax.addons.reports.page import Page, Section
from verifai_jax.addons.reports.provenance import Input, Link, Model, chained, folder_inputs
from verifai_jax.addons.reports.run_question import About, prior_rows, question, space_of
from verifai_jax.addons.reports.sections import (
    MODEL,
    answers_section,
    claims_section,
    model_answer,
    model_warnings,
    provenance_content,
)
from verifai_jax.addons.reports.studies import Studies, study
from verifai_jax.addons.reports.view import view_data
from verifai_jax.core.messages.text import format_features
from verifai_jax.evaluation.confirmations import describe_checks
from verifai_jax.falsification.no_rate import why_no_rate
from verifai_jax.falsification.run import Run
from verifai_jax.falsification.run_folder import RECORD, STATE, replay_command
from verifai_jax.falsification.segments import TAIL
from verifai_jax.falsification.table import FINISHED
from verifai_jax.mtl import parse

FILES = (
    (RECORD, "the record of the run"),
    (FINISHED, "the table"),
    ("table/*", "a part of the table"),
    (TAIL, "the tail of the table"),
    (STATE, "the state of the search"),
)
"""Files of a run, and what they are."""
ENDED = {
    "budget": "their number was fixed beforehand",
    "exhausted": "their number was fixed beforehand",
    "max_seconds": "their number was decided by the time spent, and not by the outcomes",
    "interrupted": "a person ended the run, and the outcomes had no part in when that was",
}
"""Assumption on what decided the number of samples, by what ended a run."""
BROKE_DOWN = "the run was cut off or broke down, and the outcomes had no part in when that was"
"""The same for every other end."""
FROM_DATA = "Verdicts are those of the robustness of the formulas, in {}; of exactly zero, Boolean."
"""Assumption of every count."""


@dataclass(frozen=True)
class Reproduction:
    """The basis of a report: the `links` of its chain of inputs, its `command`, and the `model`."""

    links: tuple[Link, ...]
    command: str | None
    model: Model

    @property
    def chain(self) -> str:
        """The last hash of the chain."""
        return self.links[-1].chain if self.links else ""


def run_page(
    run: Run, about: About, traces: int | None = None, studies: bool | None = None,
    modes: int | None = None, words: str | None = "",
) -> Page:  # fmt: skip
    """Make the report on a run, with `traces`, `studies` and `modes` as in `write_report`.

    `words` are further ones of the command that builds it again; None leaves that out.
    """
    found = study(run, traces, studies, modes)
    now = None if run.problem is None else run.problem.sources()
    model = Model.of(run.sources, now)
    links = tuple(chained(run_inputs(run) + model.inputs))
    command = None
    if run.folder is not None and words is not None:
        command = report_command(run.folder, about.units, about.reasons, traces, studies, modes)
        command += words
        if run.problem is None:
            command += " --without-problem"
        elif run.target is None:
            command += " --problem FILE.py:NAME"
    reproduction = Reproduction(links, command, model)
    claims = run_claims(run, found)
    view = view_data(run, found.traces, replay_command(run) if run.target and run.folder else None)
    sections = [
        _answers(run, found, reproduction),
        question(run, about),
        run_findings.findings(run),
        run_findings.failures(run, found, about),
        run_findings.reasons(found),
        None if found.modes is None else found.modes.section(about),
        run_findings.explore(run, view, found) if run.simulations else None,
        run_findings.analysis(found),
        run_findings.limits(run, found, assumptions(run)),
        claims_section(claims),
        _reproduce(run, reproduction),
    ]
    subject = about_json("run", run.formulas, run.requirements, run.model, run.backend)
    return Page(
        title=f"{run.name}: evidence report",
        headline=headline(run),
        tone="fails" if run.table.counts.claimed else "open",
        sections=tuple(section for section in sections if section is not None),
        claims=claims_json(run.name, claims, reproduction.chain, subject),
        view=view if run.simulations else None,
        warnings=model_warnings(model, found.findings),
    )


def headline(run: Run) -> str:
    """Write the main finding in a sentence or two."""
    counts, text = run.table.counts, _finding(run)
    if run.simulations in (0, counts.without_verdict):
        return text
    if run.failure_rate is not None:
        return f"{text} Failure rate {run.failure_rate}, as simulated."
    if not counts.violating:
        text += f" That shows no probability: {why_no_rate(run)}."
    return text


def _finding(run: Run) -> str:
    """Write the finding in one sentence."""
    counts = run.table.counts
    if not run.simulations:
        return f"Nothing was simulated; the run was stopped by {run.stopped}."
    if run.simulations == counts.without_verdict:
        return f"No verdict: none of {run.simulations:,} simulations ended properly."
    text = f"{counts.violating:,} of {run.simulations:,} simulations violate the property"
    if confirmed := run.verdict_counts.get("confirmed"):
        text += f", {confirmed:,} of them confirmed by closer replays"
    return f"{text}."


def assumptions(run: Run) -> list[str]:
    """Return the assumptions under which the numbers are valid."""
    items = [FROM_DATA.format(run.precision), MODEL]
    if (rate := run.failure_rate) is not None:
        text = "Interval of the failure rate: the rows are independent samples of the prior above;"
        why = f"{ENDED.get(run.stopped, BROKE_DOWN)} (Clopper and Pearson's exact interval)."
        if rate.at_any_time:
            why = "it holds whatever decided when sampling ended (a confidence sequence)."
        items.append(f"{text} {why}")
        if run.table.counts.repetitions.moved:
            items.append(
                "The system has memory or chance of its own, and a simulation may depend on those "
                "before it: the interval counts them as independent."
            )
        items.append(
            "The rate is one of the prior, which a person chose: of another distribution of the "
            "inputs it says nothing."
        )
    if run.checked:
        items.append(f"Confirmed means that a failure was seen {run.checked}.")
    return items


def run_claims(run: Run, studies: Studies) -> list[Claim]:
    """Return the claims that a run supports."""
    counts, table_ = run.table.counts, "the table of all simulations"
    common = (FROM_DATA.format(run.precision), MODEL)
    texts: list[tuple[str, tuple[str, ...], tuple[str, ...]]] = [(_finding(run), (table_,), common)]
    if confirmed := run.verdict_counts.get("confirmed"):
        checked = describe_checks(run.checks, of_step=False)
        sentence = f"{confirmed:,} of these failures were seen again {checked}."
        texts.append((sentence, (table_, "closer replays, column verdict"), common))
    if run.verdict_counts:
        sentence = (
            f"{counts.claimed:,} violations are claimed as failures. Not claimed are "
            f"{counts.refused:,}, on which closer replays do not agree, and "
            f"{counts.not_replayed:,} that were not replayed."
        )
        texts.append((sentence, ("closer replays, column verdict",), common))
    rates = {"as simulated": run.failure_rate, "confirmed": run.confirmed_failure_rate}
    for name, rate in rates.items():
        if rate is not None:
            sentence = f"The failure rate under the prior is {rate}, {name}."
            texts.append((sentence, (table_,), tuple(assumptions(run))))
    for failure in studies.failures[:1]:
        row = run.table.row(failure.row).to_dict()
        where = format_features({name: row[name] for name in run.table.features})
        depth = f"{abs(float(row['rho'])):z.4g}"
        sentence = f"The property fails at {where}, by {depth}: row {failure.row}."
        texts.append((sentence, (f"row {failure.row} of the table", "its replay"), common))
    if (small := studies.shrunk) is not None and small.count:
        apart = f"{small.count} of {len(small.u)} inputs away from nominal"
        sentence = f"{apart} are enough for a failure."
        less = "That fewer are not enough is not claimed: the search for fewer had a budget."
        texts.append((sentence, ("a simulation of the shrunk form",), (*common, less)))
    if studies.modes is not None:
        texts += studies.modes.claims()
    if without := counts.without_verdict:
        sentence = f"{without:,} of {run.simulations:,} simulations have no verdict."
        texts.append((sentence, (table_, "column status"), ()))
    claims = [Claim(f"C{i + 1}", *entry) for i, entry in enumerate(texts)]
    for name in run.requirements if run.simulations > counts.without_verdict else ():
        column = f"rho.{name}" if len(run.formulas) > 1 else "rho"
        rho = run.table.all[column].to_numpy(float)
        sentence = (
            f"{name}: the robustness is below zero in {np.sum(rho < 0):,} of {len(rho):,} "
            f"simulations, and {np.nanmin(rho):z.4g} at the lowest."
        )
        number = f"C{len(claims) + 1}"
        claims.append(Claim(number, sentence, (f"{table_}, column {column}",), common, (name,)))
    return claims


def chain_of(run: Run) -> str:
    """Return the last hash of the chain for a present report on the run."""
    links = chained(run_inputs(run) + Model.of(run.sources).inputs)
    return links[-1].chain if links else ""


def run_inputs(run: Run) -> list[Input]:
    """Return the files of a run with their hashes, or its table in memory."""
    if run.folder is not None:
        return folder_inputs(run.folder, FILES)
    digest = f"{run.table.digest(run.simulations):08x}"
    return [Input("table in memory (CRC-32)", "the table", digest)]


def _reproduce(run: Run, reproduction: Reproduction) -> Section:
    content = [element("h3", "The run")]
    if command := run_command(run):
        ended = f"The run was ended by {run.stopped}; repeated, it makes as many simulations as it"
        early = run.stopped not in ("budget", "exhausted")
        content += [paragraph(f"{ended} had made then.")] if early else []
        content.append(preformatted(command))
    worst = run.table.counts.best or 0
    content += [
        preformatted(run_python(run)),
        element("h3", "A failure"),
        preformatted(replay_command(run, worst) if run.simulations else ""),
    ]
    if reproduction.command is not None:
        text = "From the same folder, with the versions below, the file is the same byte for byte."
        content += [element("h3", "This report"), preformatted(reproduction.command)]
        content.append(paragraph(text))
    content.append(paragraph(f"The run was made with verifai_jax {run.version}, this report with:"))
    content += provenance_content(reproduction.links, reproduction.model)
    return Section("reproduce", "How to reproduce it", tuple(content))


def _answers(run: Run, studies: Studies, reproduction: Reproduction) -> Section:
    """Answer the questions of an auditor in a few words each, with links to the long answers."""
    counts, space, prior = run.table.counts, space_of(run), "see the table"
    if space is not None:
        prior = "; ".join(f"{name}: {words}" for name, words in prior_rows(space))
    words = "; ".join(formula_words(parse(text)) for text in run.formulas.values())
    verdicts = ", ".join(f"{count:,} {verdict}" for verdict, count in run.verdict_counts.items())
    rate = run_findings.no_rate(run)
    if run.failure_rate is not None:
        rate = f"{run.failure_rate}. {assumptions(run)[2]}"
    again = replay_command(run, studies.failures[0].row) if studies.failures else "there is none"
    made = f"Seed {run.seed}, verifai_jax {run.version}; chain {reproduction.chain[:16]}."
    decided = " ".join(f"{note}." for note in run.notes) or "Nothing that it noted."
    outside = "Values outside of the ranges above, and what follows."
    rows = [
        ("What was claimed?", headline(run), "claims"),
        ("What was the property?", words, "asked"),
        ("What was varied, and what was the prior?", prior, "asked"),
        ("How many simulations were there?", f"{run.simulations:,}", "found"),
        ("How many of them had no verdict?", f"{counts.without_verdict:,}", "limits"),
        ("How many violations were confirmed?", verdicts or "none was replayed", "found"),
        ("Which interval holds, under which assumption?", rate, "limits"),
        ("What was not sampled?", outside, "limits"),
        ("How is a failure reproduced?", again, "failures"),
        ("With which seed, code and versions?", made, "reproduce"),
        model_answer(reproduction.model),
        ("What did the tool decide by itself?", decided, "limits"),
    ]
    return answers_section(rows)
