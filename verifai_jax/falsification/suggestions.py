"""Questions to a source of suggested points, and its suggestions.

    suggestions = Suggestions(search, problem, 'float32')   # of a `search.Suggested`
    suggestions.due(rows)                               # whether it is time for a question
    suggestions.ask(question(...), rows)                # checks what comes back, and keeps it
    suggestions.waiting(rows)                           # rows to simulate next, [n, row]

Suggestions are written to the checkpoint before they are simulated, so a resumed run does not ask
for them again.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Array, Float, Key

from verifai_jax.core.messages.text import format_error, one_line
from verifai_jax.core.user_code.forks import returning_once
from verifai_jax.falsification.table import ErrorTable
from verifai_jax.features.given import given_features, given_rows
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Suggested
from verifai_jax.search.suggested import Absent

POINTS, ASKED, REFUSED = "suggested.points", "suggested.asked", "suggested.refused"
LAST_REFUSED = "suggested.last_refused"
"""Entries of a checkpoint: all rows that were suggested, `[n, row]`; of each question the row at
which it was asked and how many points came, `[k, 2]`; what was wrong with others; and how many
of these the last question had."""


class SuggestionError(ValueError):
    """An error for a suggestion that cannot be simulated, or an answer without suggestions."""


class Suggestions:
    """The suggestions of one run; see the module's docstring.

    - `refused`: the reasons why suggestions were refused, one text each.
    """

    def __init__(self, search: Suggested, problem: Problem, precision: str) -> None:
        self.search, self.problem, self.precision = search, problem, precision
        self.points = np.zeros((0, problem.space.dim + problem.space.width))
        self.asked = np.zeros((0, 2), np.int64)
        self.refused: tuple[str, ...] = ()
        self.last_refused: tuple[str, ...] = ()

    @property
    def notes(self) -> tuple[str, ...]:
        """Write the number of suggestions, and the refused ones."""
        if not len(self.asked):
            return ()
        questions = f"{len(self.asked)} question{'s' * (len(self.asked) != 1)}"
        lines = [f"suggestions of {self.search.source}: {len(self.points)} from {questions}"]
        lines += [f"suggestion left out: {why}" for why in self.refused]
        return tuple(lines)

    def left(self) -> int:
        """Return the number of questions that may still be asked."""
        return self.search.times - len(self.asked)

    def check_source(self) -> None:
        """Refuse to continue without the function if questions are left.

        **Raises:** `ValueError`.
        """
        if self.left() > 0 and isinstance(self.search.suggest, Absent):
            self.search.suggest({})

    def due(self, rows: int) -> bool:
        """Return whether the next question is asked at this number of rows."""
        if self.left() <= 0:
            return False
        return not len(self.asked) or rows >= int(self.asked[-1, 0]) + self.search.every

    def waiting(self, rows: int) -> Float[np.ndarray, "n row"]:
        """Return the suggested rows that are not among the first `rows` rows."""
        if not len(self.asked):
            return self.points[:0]
        begin, count = self.asked[-1]
        done = max(rows - int(begin), 0)
        return self.points[len(self.points) - int(count) :][done:]

    def next_points(
        self, table: ErrorTable, key: Key[Array, ""], keep: Callable[[], None]
    ) -> Float[np.ndarray, "n row"]:
        """Return the next suggested rows; asks a question first if one is due.

        - `table`: the rows of the run so far.
        - `key`: the key of the run's simulations.
        - `keep`: writes a checkpoint, so that no question is asked twice.
        """
        rows = len(table)
        waiting = self.waiting(rows)
        if len(waiting) or not self.due(rows):
            return waiting
        from verifai_jax.falsification.suggestion_prompt import describe_run

        question = describe_run(
            self.problem, table.all, self.search, key, self.precision, self.last_refused
        )
        self.ask(question, rows)
        keep()
        return self.waiting(rows)

    def ask(self, question: dict[str, Any], rows: int) -> None:
        """Ask, and keep the suggestions that can be simulated.

        **Raises:** `SuggestionError` for an answer that is not a list of suggestions, and with
        `strict` for a suggestion that cannot be simulated; the errors of the function itself.
        """
        number = len(self.asked) + 1
        points, wrong = [], []
        with returning_once():
            suggested = self.search.suggest(question)
        for i, each in enumerate(_listed(suggested, self.search.source)):
            try:
                if i >= self.search.points:
                    raise SuggestionError(f"only {self.search.points} were asked for")
                points.append(row_of(self.problem, each, self.precision))
            except (TypeError, ValueError) as error:
                why = f"number {i + 1} of question {number}: {one_line(format_error(error), 400)}"
                if self.search.strict:
                    raise SuggestionError(f"{self.search.source} suggested {why}") from error
                wrong.append(why)
        rows_now = np.reshape(points, (-1, self.points.shape[1]))
        self.points = np.concatenate([self.points, rows_now])
        self.asked = np.concatenate([self.asked, [[rows, len(points)]]]).astype(np.int64)
        self.last_refused = tuple(wrong)
        self.refused = (*self.refused, *wrong)

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Return the suggestions as entries of a checkpoint."""
        refused = np.array(self.refused, dtype=np.str_)
        last = np.array(len(self.last_refused))
        return {POINTS: self.points, ASKED: self.asked, REFUSED: refused, LAST_REFUSED: last}

    def restore(self, checkpoint: Mapping[str, Any]) -> None:
        """Continue with the suggestions of a checkpoint."""
        if ASKED in checkpoint:
            self.points = np.asarray(checkpoint[POINTS], np.float64)
            self.asked = np.asarray(checkpoint[ASKED], np.int64)
            self.refused = tuple(str(why) for why in checkpoint[REFUSED])
            last = int(checkpoint[LAST_REFUSED])
            self.last_refused = self.refused[len(self.refused) - last :]


def row_of(problem: Problem, suggestion: object, precision: str) -> Float[np.ndarray, " row"]:
    """Return the row that simulates a suggestion exactly; see `given_rows`.

    **Arguments:**
    - `problem`: the problem that is falsified.
    - `suggestion`: features by name, as a user writes them, or by the columns of the table; columns
      that belong to no feature are ignored.
    - `precision`: the precision of the run.
    **Raises:** `TypeError` for a suggestion that is not a mapping; `ValueError` that names a
    feature that is missing, unknown or outside its domain, or for features that break the
    constraint.
    """
    if not isinstance(suggestion, Mapping):
        raise TypeError(f"a suggestion must be a mapping of names to values; got {suggestion!r}")
    return given_rows(problem.space, given_features(problem.space, suggestion, precision))[0]


def _listed(given: object, source: str) -> list[Any]:
    if hasattr(given, "to_dict") and hasattr(given, "columns"):
        return list(given.to_dict("records"))  # pyright: ignore[reportAttributeAccessIssue]
    if isinstance(given, Mapping | str | bytes) or not isinstance(given, Iterable):
        kind = type(given).__name__
        raise SuggestionError(
            f"{source} must return a list of suggestions, mappings of feature names to values; it "
            f"returned {kind} {one_line(repr(given), 80)}"
        )
    return list(given)
