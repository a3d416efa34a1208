"""The settings that a test runner gives to all tests of problems."""

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from pathlib import Path

from verifai_jax.checking.check import Check, CheckOutcome

CORPUS = "counterexamples"
"""Usual folder of the corpus, below the root of the project."""


@dataclass(frozen=True)
class Session:
    """The settings of one test, given by whoever runs it.

    - `root`: folder that the corpus lies in.
    - `corpus`: folder of the corpus, as a path from there.
    - `budget`, `seed`: in place of those of the test, where they are given.
    - `outcomes`: what came of it, in order.
    """

    root: Path = field(default_factory=Path)
    corpus: str = CORPUS
    budget: int | None = None
    seed: int | None = None
    outcomes: list[CheckOutcome] = field(default_factory=list)

    def settings(self, check: Check) -> Check:
        """Return the settings of a test, with what is given for all in their place."""
        budget = check.budget if self.budget is None else self.budget
        seed = check.seed if self.seed is None else self.seed
        return replace(check, budget=budget, seed=seed)

    def corpus_folder(self, corpus: str | Path | None) -> Path:
        """Return the folder of a corpus: that of the test, or the usual one."""
        path = self.root / (self.corpus if corpus is None else corpus)
        # What is printed and typed again is the path from where one stands.
        return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


_SESSION: ContextVar[Session | None] = ContextVar("verifai_jax_session", default=None)


@contextlib.contextmanager
def session(settings: Session) -> Iterator[Session]:
    """Let checks inside take their settings from this session."""
    token = _SESSION.set(settings)
    try:
        yield settings
    finally:
        _SESSION.reset(token)


def current_session() -> Session:
    """Return the session, or that of whoever calls a test as a plain function."""
    return _SESSION.get() or Session()
