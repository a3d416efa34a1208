"""The report on a sweep: the trainings certified as safe, and the limits of these certificates."""

from typing import Any

from verifai_jax.addons.reports.claims import Claim
from verifai_jax.addons.reports.commands import report_command
from verifai_jax.addons.reports.markup import paragraph, picture, preformatted, table
from verifai_jax.addons.reports.page import Page
from verifai_jax.addons.reports.provenance import Model, folder_inputs
from verifai_jax.addons.reports.run_question import About, space_table
from verifai_jax.addons.reports.sections import MODEL, result_page
from verifai_jax.addons.reports.studies import png
from verifai_jax.addons.training.sweeps.record import STOPPED, TRAINED
from verifai_jax.addons.training.sweeps.result import Sweep
from verifai_jax.core.messages.text import counted, format_percent
from verifai_jax.features.english import number

FILES = (
    ("sweep.json", "the record of the sweep"), ("table.parquet", "the table"),
    ("failing.parquet", "the counterexamples"), ("curves.npz", "the learning curves"),
    ("policies/*.npz", "a policy"),
)  # fmt: skip
"""Files of a sweep, and what they are."""
TOGETHER = (
    "The intervals of all policies hold together, at any time, for independent samples of the "
    "problem's prior."
)
"""Assumption of every certificate."""
COLUMNS = ("verdict", "nominal_return", "failures", "simulations", "failure_low", "failure_high")
"""Columns of the table that a report shows in addition to the hyper-parameters."""
MAX_ROWS = 40
"""Policies that are listed at most."""


def sweep_page(sweep: Sweep, about: About, problem: object = None) -> Page:
    """Make the report on a sweep.

    **Arguments:**
    - `sweep`: the sweep; its study is not needed.
    - `about`: units and reasons of the hyper-parameters.
    """
    about.check(sweep.space, sweep.hyperparameters)
    record = sweep.record
    model = Model.of(record.sources, None if sweep.study is None else sweep.study.sources())
    frame, safe = sweep.table, sweep.safe
    limit = "a limit that is not recorded" if sweep.p is None else format_percent(sweep.p)
    headline = f"{sweep.headline[:1].upper()}{sweep.headline[1:].rstrip('.')}."
    counts = {str(k): int(n) for k, n in frame["verdict"].value_counts(sort=False).items()}
    verdicts = ", ".join(f"{counts[name]:,} {name or 'not certified'}" for name in sorted(counts))
    claims = [
        Claim("C1", headline, ("the table of the sweep",), (MODEL, TOGETHER)),
        Claim(
            "C2",
            f"{len(safe):,} of {len(frame):,} policies are shown to fail with a probability below "
            f"{limit}.",
            ("certificates: fresh samples of the problem's prior",), (MODEL, TOGETHER),
        ),
    ]  # fmt: skip
    names = [*sweep.hyperparameters, *(name for name in COLUMNS if name in frame.columns)]
    best = [*safe.index, *(i for i in frame.index if i not in safe.index)][:MAX_ROWS]
    rows: list[Any] = [
        [f"row {i}", *(number(frame[name][i]) for name in names)] for i in best
    ]  # fmt: skip
    options = [
        (name, str(value)) for name, value in sorted(record.options.items()) if value is not None
    ]
    ended = sum(status in (TRAINED, STOPPED) for status in frame["status"])
    asked = [paragraph(f"Which trainings of {sweep.name} are safe: fail below {limit}.")]
    if sweep.space is not None:
        asked.append(space_table(sweep.space, {}, about))
    asked.append(table(["option", "value"], [*options, ("seed", str(record.seed))]))
    repeat = []
    if sweep.folder is not None:
        command = report_command(sweep.folder, about.units, about.reasons)
        repeat.append(preformatted(command))
    kind, holds = "evidence report on a sweep", "holds" if len(safe) else "open"
    return result_page(
        sweep.name, kind, headline, holds, claims, model,
        files=[] if sweep.folder is None else folder_inputs(sweep.folder, FILES),
        answers=[
            ("What was varied?", ", ".join(sweep.hyperparameters), "asked"),
            ("How many policies were trained?", f"{len(frame):,}", "found"),
            ("How many are safe, unsafe, open?", verdicts, "found"),
            ("Which assumption is under the intervals?", TOGETHER, "limits"),
            ("With which seed?", str(record.seed), "reproduce"),
        ],
        asked=asked,
        found=[
            preformatted(sweep.summary()),
            picture(png(sweep.plot()), "Return against failure probability, and the curves"),
            paragraph(f"{len(rows):,} of {len(frame):,} policies, the safe ones first:"),
            table(["policy", *names], rows),
        ],
        limits=[
            "A high return is not safety: a policy without the verdict safe is not shown to be "
            "safe.",
            f"{counted(len(frame) - ended, 'training')} gave no policy, or one that is not finite.",
            *([] if record.complete else ["The sweep was cut off before its end."]),
            "An attack finds counterexamples and enters no interval.",
            MODEL,
            TOGETHER,
        ],
        reproduce=[*repeat, paragraph(f"The sweep was made with verifai_jax {record.version}.")],
    )  # fmt: skip
