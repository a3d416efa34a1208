"""Possible errors of the tool, each with the oracle that would catch it.

That it does is shown by planting each error in a copy of the package:
`tests/qualification/test_planted_errors.py`.
"""

from typing import NamedTuple


class Hazard(NamedTuple):
    """A possible error of the tool.

    - `oracle`: the name of the check that catches it.
    - `error`: the error in words.
    """

    oracle: str
    error: str


_BY_ORACLE = {
    "formulas": (
        "the last instant of a window is left out",
        "always takes the greatest value, or eventually the least",
        "until forgets what holds before",
        "a negation is dropped",
        "an implication is read backwards",
        "a comparison is read as its opposite",
        "a formula is written as another one",
        "after the end of a trace another value than the last one holds",
    ),
    "zeros": (
        "x > 0 holds at zero",
        "x >= 0 fails at zero",
        "a robustness of zero is a violation, whatever the comparison",
    ),
    "gradients": (
        "a gradient is not that of the robustness",
        "the smooth robustness does not tend to the robustness",
    ),
    "table": (
        "a violation counts as safe",
        "a safe simulation counts as a violation",
        "a row is lost",
        "a row is in the table twice",
        "a row has the robustness of another one",
        "violations are counted wrongly",
        "the worst row is not the worst",
        "samples of the prior are biased",
    ),
    "statuses": (
        "a simulation that raised counts as a failure, or as safe",
        "a signal that is not finite has a verdict",
        "simulations without a verdict do not widen the interval of a rate",
    ),
    "intervals": (
        "an interval of a rate is too narrow",
        "an interval that should hold at any time does not",
        "too few simulations without a failure are said to be enough",
    ),
    "probabilities": (
        "the estimate of a rare probability is wrong by its weights",
        "the guaranteed bound is too low",
    ),
    "priors": (
        "an interval is scaled wrongly",
        "a normal feature has another spread",
        "a logarithmic feature is uniform",
        "weights of choices are ignored",
    ),
    "steps": (
        "an integrator is of lower order than it says",
        "a finer step is not finer",
    ),
    "replays": (
        "the same seed gives another table",
        "another seed gives the same table",
        "a row is replayed under another random key",
    ),
    "kills": (
        "a run that was killed goes on as another run",
        "rows are lost when a process is killed",
        "a record that was changed is believed",
    ),
    "searches": (
        "a search does not learn, and misses what it should find",
        "a rate is given for samples that a search has chosen",
        "a shrunk counterexample does not fail",
    ),
    "confirmations": (
        "a failure of a coarse step alone is confirmed",
        "a real failure is refuted",
    ),
    "comparisons": (
        "the two sides of a pair have other features or random numbers",
        "better and worse are exchanged",
    ),
    "divergences": (
        "the worst prior is not the worst",
        "a claim is said to bear a greater shift of the prior than it does",
    ),
}

HAZARDS = {
    f"E{number:02}": hazard
    for number, hazard in enumerate(
        (Hazard(oracle, error) for oracle, errors in _BY_ORACLE.items() for error in errors), 1
    )
}
"""The errors by identifier."""
