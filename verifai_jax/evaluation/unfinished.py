"""Finished simulations of work that may be killed, stored in a folder until it is done.

    with keeping(folder, {"command": "estimate", "seed": 0}) as kept:
        found = estimate(problem)
        kept.done = True

A function called again with the same arguments requests the same simulations in the same order. So
it reads those in the folder and continues with the same result, however the earlier call ended. A
simulation is recalled only for the same evaluator, point, random key, temperature and model;
otherwise the work begins again.
"""

import contextlib
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import jax
import numpy as np
from jaxtyping import Float, Int

from verifai_jax.core.display.progress import write_line
from verifai_jax.core.store.cache import Cache, CacheError, locked_cache
from verifai_jax.core.store.log import Arrays
from verifai_jax.core.user_code.sources import Sources, list_changes
from verifai_jax.evaluation.journal import Journal
from verifai_jax.evaluation.kept_work import PRESENT
from verifai_jax.evaluation.verdicts import RowVerdict, Verdicts
from verifai_jax.problem.problem import Problem

Form: TypeAlias = jax.tree_util.PyTreeDef  # pyright: ignore[reportInvalidTypeForm]
KIND = "unfinished"
"""Kind of the cache."""


class Unfinished:
    """The folder of work that continues when it is called again.

    - `done`: set by the caller that has the result; the content of the folder is then removed.
    """

    def __init__(self, cache: Cache, folder: Path) -> None:
        self.done = False
        self.cache, self.folder = cache, folder
        self._parts = 0
        self._keeps = True

    @property
    def empty(self) -> bool:
        """True if no simulation is stored."""
        return not self.cache.names() and not any(self.folder.glob("*.rows"))

    def part(self, problem: Problem, *mode: object) -> "Part":
        """Return the stored simulations of the next evaluator; none if the model has changed.

        **Arguments:**
        - `problem`: the problem of the evaluator.
        - `mode`: a text of the other settings that affect its verdicts.
        """
        number, self._parts = self._parts, self._parts + 1
        formulas = {name: str(formula) for name, formula in problem.formulas.items()}
        columns = list(map(str, problem.space.columns))
        about = [problem.name, formulas, problem.end, columns, [*map(str, mode)]]
        sources, name = problem.sources(), f"part/{number}"
        known = self.cache.note(name)
        if known is not None:
            then = Sources.from_json(known["sources"])
            changes = then.changes(sources)
            if changes or known["about"] != about or then.revision != sources.revision:
                why = list_changes(changes) or "it asks for other simulations"
                write_line(f"note: begun anew, since the model has changed since then: {why}")
                self.cache.clear()
                for path in self.folder.glob("*.rows"):
                    path.unlink()
                known = None
        if known is None:
            with self.writing():
                self.cache.note(name, {"about": about, "sources": sources.to_json()})
        return Part(self, number, jax.tree.structure(problem.space.feature_form))

    @contextlib.contextmanager
    def writing(self) -> Iterator[None]:
        """Stop storing if nothing can be written; the work itself needs no disk."""
        try:
            yield
        except (OSError, CacheError) as error:
            if self._keeps:
                write_line(f"note: goes on without keeping what is finished: {error}")
            self._keeps = False

    def put(self, number: int, entries: Mapping[str, Arrays]) -> None:
        """Store finished simulations of a part."""
        if self._keeps:
            with self.writing():
                self.cache.put(entries)


class Part:
    """The finished simulations of one evaluator.

    - `form`: structure of the features of its problem.
    """

    def __init__(self, of: Unfinished, number: int, form: Form) -> None:
        self.of, self.number, self._form = of, number, form
        self.journal = _Rows(of, number)
        self._known = {
            key: (arrays, i)
            for arrays in of.cache.entries(f"{number}/")
            for i, key in enumerate(_keys(arrays))
        }

    def recall_or(
        self, points: Float[np.ndarray, "n d"], numbers: Int[np.ndarray, " n"],
        temperature: Float[np.ndarray, " n"] | float, simulate: Callable[[], Verdicts],
    ) -> Verdicts:  # fmt: skip
        """Return verdicts of these points: the stored ones, or else those of `simulate`.

        **Arguments:**
        - `numbers`: the numbers of the simulations, from which their random keys are derived.
        """
        known = self.recall(points, numbers, temperature)
        if known is not None:
            return known
        verdicts = simulate()
        self.of.put(
            self.number,
            {
                f"{self.number}/{numbers[0]}": {
                    **_asked(points, numbers, temperature),
                    **_arrays(verdicts),
                }
            },
        )
        return verdicts

    def recall(
        self, points: Float[np.ndarray, "n d"], numbers: Int[np.ndarray, " n"],
        temperature: Float[np.ndarray, " n"] | float,
    ) -> Verdicts | None:  # fmt: skip
        """Return stored verdicts of these points; None if some are missing."""
        if not self._known:
            return None
        found = [self._known.get(k) for k in _keys(_asked(points, numbers, temperature))]
        if not all(found):
            return None
        return Verdicts.concatenate([_verdict(*one, self._form) for one in found if one])


class _Rows(Journal):
    """Simulations of a host system, on disk one by one."""

    def __init__(self, of: Unfinished, number: int) -> None:
        super().__init__(of.folder, f"{number}.rows")
        self._of = of

    def add(self, row: int, point: Float[np.ndarray, " d"], verdict: RowVerdict) -> None:
        with self._of.writing():
            super().add(row, point, verdict)


@contextlib.contextmanager
def keeping(folder: Path, work: Mapping[str, Any]) -> Iterator[Unfinished]:
    """Store the simulations of all evaluators used inside the block, until the work is done.

    **Arguments:**
    - `folder`: the folder; it is made, and removed when the work is done, or if it is empty.
    - `work`: the arguments of the call, as plain data.
    **Raises:** `FolderInUse` and `ValueError` as in `locked_cache`; `CacheError` for a folder of
    other work.
    """
    with locked_cache(folder, KIND) as cache:
        kept = Unfinished(cache, folder)
        try:
            cache.claim(work)
            token = PRESENT.set(kept)
            try:
                yield kept
            finally:
                PRESENT.reset(token)
        finally:
            if kept.done or kept.empty:
                shutil.rmtree(folder, ignore_errors=True)


def _asked(
    points: Float[np.ndarray, "n d"], numbers: Int[np.ndarray, " n"],
    temperature: Float[np.ndarray, " n"] | float,
) -> dict[str, np.ndarray]:  # fmt: skip
    return {
        "points": np.asarray(points),
        "numbers": np.asarray(numbers, np.int64),
        "temperature": np.broadcast_to(np.asarray(temperature, np.float32), len(points)),
    }


def _keys(asked: Arrays) -> Iterator[bytes]:
    for rows in zip(asked["points"], asked["numbers"], asked["temperature"], strict=True):
        yield b"".join(np.asarray(row).tobytes() for row in rows)


_FIELDS = ("rho", "status", "violated", "gradient", "clauses", "clause_gradients", "coverage_ids",
           "guidance")  # fmt: skip
"""Fields of verdicts that are kept."""
FEATURE = "feature."
"""Beginning of the names of the arrays of features."""


def _arrays(verdicts: Verdicts) -> dict[str, np.ndarray]:
    kept = {name: getattr(verdicts, name) for name in _FIELDS}
    arrays = {name: np.asarray(value) for name, value in kept.items() if value is not None}
    for i, leaf in enumerate(jax.tree.leaves(verdicts.features)):
        arrays[f"{FEATURE}{i}"] = np.asarray(leaf)
    if verdicts.messages is not None:
        arrays["messages"] = np.array([text or "" for text in verdicts.messages], dtype="U")
    return arrays


def _verdict(arrays: Arrays, row: int, form: Form) -> Verdicts:
    fields: dict[str, Any] = {
        name: arrays[name][row : row + 1] for name in _FIELDS if name in arrays
    }
    if f"{FEATURE}0" in arrays:
        leaves = [arrays[f"{FEATURE}{i}"][row : row + 1] for i in range(form.num_leaves)]
        fields["features"] = jax.tree.unflatten(form, leaves)
    messages = [str(arrays["messages"][row])] if "messages" in arrays else None
    return Verdicts(**fields, messages=messages)
