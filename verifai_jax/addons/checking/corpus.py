"""Counterexamples as small readable files, for regression tests.

    run.save_counterexamples("counterexamples")         # a JSON file each, made for version control
    replay_counterexamples(problem, "counterexamples")  # all in one batch: failing, fixed, invalid

A file holds the features of one simulation, the formulas, the robustness, the search that found it
and the data to replay it. Nothing in it is executed: a replay needs the problem.
"""

import hashlib
import json
import os
import re
import shlex
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from types import FunctionType
from typing import Any

import jax
import numpy as np

from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.display.progress import shows_progress
from verifai_jax.core.messages.checks import check_count, is_number
from verifai_jax.core.messages.text import format_error, one_line
from verifai_jax.core.store.atomic_files import replacing
from verifai_jax.core.store.foreign_files import read_json
from verifai_jax.counterexamples._shrink import shrink as shrink_row
from verifai_jax.counterexamples.selection import columns_at, problem_of
from verifai_jax.evaluation.replay import replay
from verifai_jax.falsification.model_changes import sources_of_row
from verifai_jax.falsification.run import Run
from verifai_jax.problem.problem import Problem

FORMAT = 1
"""Format of the files; those of a later one are refused."""


class CorpusError(ValueError):
    """An error for a file that is not a counterexample, or a damaged one."""


@dataclass(frozen=True)
class SavedCounterexample:
    """One counterexample of a corpus, as plain data.

    - `problem`, `target`: the name of the problem, and its name on the command line.
    - `formulas`: their texts by name.
    - `features`: the columns of the feature space.
    - `robustness`: the robustness of each formula, as simulated.
    - `seed`, `row`: the run's seed and the row in its table, which determine the random key.
    - `precision`, `backend`: those of the simulation.
    - `verdict`: the verdict of closer replays of its row; empty if there were none.
    - `changed`: the departures from nominal, `[nominal, value]` by coordinate, if it was shrunk.
    - `found`: the search, its budget, the number of simulations, the version, the `sources`: the
      files of the model, as a run records them, and the `origin` of the problem (`origin_of`).
    """

    problem: str
    target: str | None
    formulas: dict[str, str]
    features: dict[str, Any]
    robustness: dict[str, float]
    seed: int
    row: int
    precision: str
    backend: str | None
    verdict: str
    changed: dict[str, Any] | None
    found: dict[str, Any]

    @property
    def name(self) -> str:
        """Name of its file: the problem's name, and a digest of what determines the simulation."""
        deciding = [self.problem, self.formulas, self.features, self.seed, self.row]
        # Another problem of this name has files of its own.
        deciding += [self.found["origin"]] if "origin" in self.found else []
        text = json.dumps(deciding, sort_keys=True)
        stem = re.sub(r"\W+", "-", self.problem).strip("-")[:60] or "counterexample"
        return f"{stem}-{hashlib.sha256(text.encode()).hexdigest()[:10]}.json"

    def write(self, folder: Path) -> Path:
        """Write the file into a folder; return its path.

        **Raises:** `OSError` that names the file, if the file system refuses.
        """
        path = folder / self.name
        content: dict[str, Any] = {"format": FORMAT, **asdict(self)}
        if self.target is not None:
            words = ["verifai-jax", "replay-counterexamples", self.target, str(path)]
            content["reproduce"] = shlex.join(words)
        with replacing(path) as partial:
            partial.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", "utf-8")
        return path

    @classmethod
    def read(cls, path: Path) -> "SavedCounterexample":
        """Read a file written by `write`, whether or not a person edited it.

        **Raises:** `CorpusError` for anything else.
        """
        try:
            content = read_json(path)
        except (OSError, ValueError) as error:
            raise CorpusError(f"{path} cannot be read: {one_line(format_error(error))}") from None
        form = content.get("format") if isinstance(content, dict) else None
        if form != FORMAT:
            raise CorpusError(
                f"{path} is not a counterexample of format {FORMAT}; its format is {form!r}"
            )
        missing = [field.name for field in fields(cls) if field.name not in content]
        if missing:
            raise CorpusError(f"{path} lacks {', '.join(missing)}")
        values = {field.name: content[field.name] for field in fields(cls)}
        for name, (fits, wanted) in _FORMS.items():
            if not fits(values[name]):
                raise CorpusError(
                    f"{path}: {name} must be {wanted}; got {one_line(repr(values[name]), 100)}"
                )
        return cls(**values)


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _is_entry(value: object) -> bool:
    return value is None or isinstance(value, bool | str) or (is_number(value) and _is_real(value))


def _is_real(value: Any) -> bool:
    return abs(value) <= sys.float_info.max  # Neither NaN nor an integer beyond all floats.


def _is_up_to(maximum: int) -> Callable[[object], bool]:
    def fits(value: object) -> bool:
        return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= maximum

    return fits


def _maps_to(fits: Callable[[object], bool]) -> Callable[[object], bool]:
    return lambda value: isinstance(value, dict) and all(map(fits, value.values()))


def _is_pair(value: object) -> bool:
    return isinstance(value, list) and len(value) == 2


_FORMS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "problem": (_is_text, "a text"),
    "target": (lambda value: value is None or _is_text(value), "a text or null"),
    "formulas": (_maps_to(_is_text), "an object of texts"),
    "features": (_maps_to(_is_entry), "an object of finite numbers, texts, truth values and nulls"),
    "robustness": (
        _maps_to(lambda value: value is None or (is_number(value) and _is_real(value))),
        "an object of finite numbers and nulls",
    ),
    "seed": (_is_up_to(2**63 - 1), "a whole number from 0 to 2**63 - 1"),
    "row": (_is_up_to(2**31 - 1), "a whole number from 0 to 2**31 - 1"),
    "precision": (lambda value: value in ("float32", "float64"), "float32 or float64"),
    "backend": (lambda value: value is None or _is_text(value), "a text or null"),
    "verdict": (_is_text, "a text"),
    "changed": (lambda value: value is None or _maps_to(_is_pair)(value), "an object of pairs"),
    "found": (lambda value: isinstance(value, dict), "an object"),
}
"""For each entry of a file, a check of its value, and the required form as text."""


@shows_progress("saving counterexamples of", of_budget=False)
def save_counterexamples(
    run: Run, folder: str | Path, *, max_count: int = 5, shrink: bool = True, budget: int = 1000,
    progress: bool | None = None,
) -> list[Path]:  # fmt: skip
    """Write counterexamples of a run into a folder, one small file each.

    Only claimed rows are written: if the run confirms, those that closer replays confirmed. The
    worst comes first, then each time the one farthest from those before, so a few represent all.

    **Arguments:**
    - `run`: a run with its problem.
    - `folder`: the folder, made if missing; existing files stay.
    - `max_count`: maximum number of counterexamples.
    - `shrink`: whether to shrink each towards the nominal features first, if these are known.
    - `budget`: maximum number of simulations to shrink one.
    - `progress`: whether to show one line of progress; see `core.display.progress` for the default.
    **Returns:** the paths of the files, without duplicates.
    **Raises:** `ValueError` for a run without its problem or without a counterexample.
    """
    problem = problem_of(run)
    check_count("max_count", max_count)
    check_count("budget", budget)
    claimed = run.table.counterexamples
    if not len(claimed):
        raise ValueError(
            f"the run of {run.name!r} claims no counterexample in {run.simulations} simulations"
        )
    ordered = claimed.sort_values("rho", kind="stable")
    points = problem.space.points(ordered)
    folder = Path(folder)
    paths: dict[Path, None] = {}
    for index in _spread(points, max_count):
        row = int(ordered.index[index])
        features = {name: ordered.iloc[index][name] for name in problem.space.columns}
        changed = None
        if problem.black_box:
            # What was not repeated in the run may not come again: it is no regression test then.
            first = replay(problem, features, run_keys(run.seed)[1], row, run.precision)
            if not first.violated:
                continue
        if shrink and problem.nominal is not None:
            try:
                small = shrink_row(run, row, budget=budget, others=False)
            except ValueError:
                if not problem.black_box:
                    raise
                continue  # This time it holds.
            features = columns_at(small.problem, small.u)
            changed = {
                name: [_plain(was), _plain(now)] for name, (was, now) in small.changed.items()
            }
        seen = replay(problem, features, run_keys(run.seed)[1], row, run.precision)
        if not seen.violated:
            # Shrinking in another precision, or rounding in the table, must not claim too much.
            features, changed = {name: ordered.iloc[index][name] for name in features}, None
            seen = replay(problem, features, run_keys(run.seed)[1], row, run.precision)
        if not seen.violated:
            continue
        verdict = str(ordered.iloc[index]["verdict"]) if "verdict" in ordered else ""
        saved = SavedCounterexample(
            problem=run.name,
            target=run.target,
            formulas=dict(run.formulas),
            features={name: _plain(value) for name, value in features.items()},
            robustness={name: _plain(value) for name, value in seen.rho.items()},
            seed=run.seed,
            row=row,
            precision=run.precision,
            backend=run.backend,
            verdict=verdict,
            changed=changed,
            found={
                "search": run.search,
                "budget": run.budget,
                "simulations": run.simulations,
                "version": run.version,
                "jax": jax.__version__,
                "sources": _sources(run, row),
                "origin": origin_of(problem),
            },
        )
        paths[saved.write(folder)] = None
    return list(paths)


def _sources(run: Run, row: int) -> dict[str, Any]:
    """Return the files with which a row was simulated, in a form for version control."""
    found = sources_of_row(run.sources, row)
    # Where the project lay on this machine is nobody else's concern.
    return {} if found is None else replace(found, root="", first=0).to_json()


def origin_of(problem: Problem) -> list[str]:
    """Return the file that makes a problem and, if others there have its name, its variable."""
    file = problem.made_in[-1].file if problem.made_in else ""
    here = Path(file).name if file else ""
    if file and Path(file).is_relative_to(Path.cwd()):
        here = Path(file).relative_to(Path.cwd()).as_posix()
    return [here, _namesakes(problem, file).get(id(problem), "")]


def is_elsewhere(saved: SavedCounterexample, problem: Problem) -> bool:
    """Return whether a counterexample is that of another problem of the same name.

    One whose file or variable is not there any more may be of this problem, which was moved.
    """
    origin = saved.found.get("origin")
    if not isinstance(origin, list) or len(origin) != 2 or not all(map(_is_text, origin)):
        return False
    file = problem.made_in[-1].file if problem.made_in else ""
    was, variable = Path(str(origin[0])), origin[1]
    if not file or not was.name:
        return False
    if Path(file).parts[-len(was.parts) :] != was.parts:
        return any((folder / was).is_file() for folder in Path(file).parents)
    others = {key: name for key, name in _namesakes(problem, file).items() if key != id(problem)}
    return variable in others.values()


def _namesakes(problem: Problem, file: str) -> dict[int, str]:
    """Return the variables, or the tests, of the problems in a module that share a name."""
    for module in [*sys.modules.values()]:
        path = getattr(module, "__file__", None)
        if not file or not path or os.path.abspath(path) != file:
            continue
        named: dict[int, str] = {}
        for name, value in vars(module).items():
            held = vars(value).values() if isinstance(value, type) else [value]
            for each in held:
                # A test has its problem among its attributes.
                tested = vars(each).values() if isinstance(each, FunctionType) else [each]
                for part in tested:
                    if isinstance(part, Problem) and part.name == problem.name:
                        named.setdefault(id(part), name)
        if id(problem) in named:
            return named if len(named) > 1 else {}
    return {}


def read_corpus(folder: str | Path) -> tuple[dict[Path, SavedCounterexample], dict[Path, str]]:
    """Read the files of a corpus: a folder with its subfolders, or one file.

    All files that end in `.json`, in upper or lower case, belong to it; hidden files do not.

    **Returns:** the counterexamples by path, and an error text for each other file.
    **Raises:** `FileNotFoundError` if the path does not exist.
    """
    location = Path(folder)
    if not location.exists():
        raise FileNotFoundError(f"there is no corpus of counterexamples in {location}")
    paths = [location]
    if location.is_dir():
        below = (path.relative_to(location) for path in sorted(location.rglob("*")))
        seen = (path for path in below if not any(part.startswith(".") for part in path.parts))
        paths = [location / path for path in seen if path.suffix.lower() == ".json"]
    entries, damaged = {}, {}
    for path in paths:
        try:
            entries[path] = SavedCounterexample.read(path)
        except CorpusError as error:
            damaged[path] = str(error)
    return entries, damaged


def renamed(features: Mapping[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    """Return columns under new names; the new name of a feature applies to all of its columns."""
    result = {}
    for column, value in features.items():
        stem = re.split(r"[.\[]", column, maxsplit=1)[0]
        new = names.get(column)
        if new is None and stem in names:
            new = names[stem] + column[len(stem) :]
        result[new or column] = value
    return result


def _spread(points: Any, maximum: int) -> list[int]:
    """Return indices of points, the first and then each time the one farthest from those before."""
    chosen = [0]
    distance = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < min(maximum, len(points)):
        farthest = int(np.argmax(distance))
        if distance[farthest] <= 0:
            break
        chosen.append(farthest)
        distance = np.minimum(distance, np.linalg.norm(points - points[farthest], axis=1))
    return chosen


def _plain(value: object) -> Any:
    """Return an entry of a table for JSON; absent items of arrays are null."""
    if isinstance(value, np.ndarray | jax.Array):
        return np.asarray(value).tolist()
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value
