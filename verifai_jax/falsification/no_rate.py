"""Sentences on a run whose rows are not samples of the prior, so that it has no failure rate.

    why_no_rate(run)                   "its points are those of a sequence, spread on purpose"

All texts take the reason from here, so that they agree.
"""

from verifai_jax.falsification.run import Run

_WHY: dict[str, str] = {
    "given": "its rows were given",
    "sequence": "its points are those of a sequence, spread on purpose",
    "coverage": "this search goes where coverage grows",
    "learned": "this search goes where failures are",
}
_UNIFORM = "use search='uniform' for a rate"
_REMEDY: dict[str, str] = {
    "first": "leave out Start(rows=) for a rate",
    "given": "use vj.falsify(problem, 'uniform') for a rate",
}
_BETWEEN: dict[str, str] = {
    "prior": (
        "The points between the {rows} samples: only their failure rate is known, with its "
        "interval."
    ),
    "first": (
        "The points between the {rows} simulations: nothing is known of them. {given} of these "
        "were given, so that the share of failing rows is no probability."
    ),
    "given": (
        "All but the {rows} rows that were given: nothing is known of other points, and the share "
        "of failing rows is no probability."
    ),
    "sequence": (
        "The points between the {rows} of the sequence: nothing is known of them. They were not "
        "drawn independently, so that the share of failing rows is no probability with an interval."
    ),
    "coverage": (
        "The search chose its points by what it had covered before. Where it did not look nothing "
        "is shown, and the share of failing rows is not a probability."
    ),
    "learned": (
        "The search chose its points by what it had found before. Where it did not look nothing "
        "is shown, and the share of failing rows is not a probability."
    ),
}
_NO_RATE = "The points between the {rows} samples: nothing is known of them."


def why_no_rate(run: Run) -> str:
    """Explain why a run's rows give no failure rate; empty if they are samples of the prior."""
    if run.prior:
        return ""
    if run.origin == "first":
        count = len(run.first)
        return "its first row was given" if count == 1 else f"its first {count:,} rows were given"
    return _WHY[run.origin]


def remedy(run: Run) -> str:
    """Say how to run the problem so that the run has a failure rate."""
    return _REMEDY.get(run.origin, _UNIFORM)


def what_lies_between(run: Run) -> str:
    """Say what remains unknown about points that a run did not simulate."""
    origin = "prior" if run.prior else run.origin
    text = _BETWEEN[origin]
    if run.prior and run.failure_rate is None:
        text = _NO_RATE  # No simulation has a verdict, or they are of several models.
    return text.format(rows=f"{run.simulations:,}", given=f"{len(run.first):,}")
