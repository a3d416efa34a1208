"""Suggestions of a person or of a language model, from which another search continues.

    Suggested(ask_me)
    Suggested(ask_a_model, CMAES(), times=6, every=500, points=4, units={"mass": "kg"})

    def ask_me(question):
        print(question["problem"], question["worst"])
        return [{"mass": 1.2, "wind": "strong"}]

`falsify` asks at the start and between rounds, simulates the suggestions, and passes them to the
wrapped search, whose descents then start there; see `falsification/suggestions.py` for the content
of a question.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NoReturn, TypeAlias

from jaxtyping import PyTree

from verifai_jax.core.values.cube import Cube
from verifai_jax.search.base import Search, check_options
from verifai_jax.search.portfolio import Portfolio
from verifai_jax.search.wrapper import Wrapper

Suggest: TypeAlias = Callable[[dict[str, Any]], Iterable[Mapping[str, Any]]]
"""A function of a question, plain data as of JSON, that returns features by name, several times."""


@dataclass(frozen=True)
class Suggested(Wrapper[PyTree]):
    """A wrapper around another search, for which a function suggests points during the run.

    **Arguments:**
    - `suggest`: a function called with a question. It returns a list of suggestions: features by
      name, as a user writes them, or by the columns of the table. An empty list means no
      suggestion.
    - `search`: the wrapped search, which continues from the suggestions; it must learn.
    - `times`: maximum number of questions in a run; the first is asked before any simulation.
    - `every`: minimum number of simulations between two questions.
    - `points`: number of suggestions wanted for a question.
    - `rows`: maximum number of the table's latest rows in a question.
    - `worst`: number of rows with the lowest robustness that a question contains with their traces;
      each is simulated once more.
    - `units`: the units of features, by name, such as `{"mass": "kg"}`; only used in the question.
    - `context`: further information for the function; only used in the question.
    - `strict`: whether a suggestion that cannot be simulated ends the run. Otherwise it is left
      out, which the notes of the run and the next question mention.
    **Raises:** `TypeError` for anything that is neither a function nor a search; `ValueError` for a
    search that does not learn, or numbers out of range.
    """

    suggest: Suggest
    search: Search = field(default_factory=Portfolio)
    times: int = 4
    every: int = 128
    points: int = 4
    rows: int = 100
    worst: int = 3
    units: Mapping[str, str] = field(default_factory=dict)
    context: str = ""
    strict: bool = False

    def __post_init__(self) -> None:
        if not callable(self.suggest):
            raise TypeError(
                f"suggest must be a function of a question that returns suggestions; got "
                f"{self.suggest!r}"
            )
        if not isinstance(self.search, Search) or isinstance(self.search, Suggested):
            raise TypeError(f"Suggested needs a search like Portfolio(); got {self.search!r}")
        if not self.search.learns:
            raise ValueError(
                f"search {self.search!r} does not learn, so suggestions would not influence it; "
                "give one that does, such as Portfolio(), or only simulate them with "
                "falsify(first=...)"
            )
        check_options(self, {"times": 1, "every": 1, "points": 1, "rows": 0, "worst": 0})
        if not isinstance(self.units, Mapping):
            raise TypeError(f"units must be texts by the name of a feature; got {self.units!r}")

    @property
    def source(self) -> str:
        """Name of the function that suggests."""
        if isinstance(self.suggest, Absent):
            return self.suggest.source
        name = getattr(self.suggest, "__qualname__", type(self.suggest).__qualname__)
        return f"{getattr(self.suggest, '__module__', None) or '__main__'}:{name}"

    def check(self, cube: Cube) -> None:
        """Raise `ValueError`, since only the rounds of `falsify` can ask for suggestions."""
        raise ValueError(
            "suggestions are asked for between the rounds of vj.falsify and vj.resume, so "
            "Suggested must be the search itself, not a part of another one; got one around "
            f"{self.search!r}"
        )

    def __repr__(self) -> str:
        return f"Suggested({self.source}, {self.search!r})"


@dataclass(frozen=True)
class Absent:
    """The function of a loaded run; the record only has its name."""

    source: str

    def __call__(self, question: dict[str, Any]) -> NoReturn:
        """Raise `ValueError`."""
        raise ValueError(
            f"the suggestions of this run came from {self.source}, which a record does not hold; "
            "give it: resume(..., search=vj.search.Suggested(function, ...))"
        )


def without_suggestions(search: Any) -> tuple[Suggested | None, Any]:
    """Return the asking search, None if there is none, and the wrapped search."""
    if isinstance(search, Suggested):
        return search, search.search
    return None, search
