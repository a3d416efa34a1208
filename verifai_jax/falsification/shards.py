"""One run as a job array: each job simulates a part of the rows, and `merge` joins the parts.

    simulate_shard(problem, Shard(3, 16), "uniform", 10_000_000, folder="parts/3")
    merge(sorted(Path("parts").iterdir()), problem, folder="runs/merged")

This works for searches that do not learn: a point depends only on the seed and its number, so every
job can compute its own points. A job writes a log in blocks of a few thousand rows, and continues
from it after a kill. Merging performs the run with stored rows instead of simulations, so table,
confirmations and record are those of a run on one machine.
"""

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from verifai_jax import search as searches
from verifai_jax.core.compute.devices import describe_processor
from verifai_jax.core.compute.keys import run_keys
from verifai_jax.core.compute.precision import reproducible_settings
from verifai_jax.core.display.progress import SimulationProgress
from verifai_jax.core.messages.checks import check_count, check_options
from verifai_jax.core.messages.text import one_line
from verifai_jax.core.store.files import DamagedError
from verifai_jax.core.store.locks import LOCK, write_lock, writing
from verifai_jax.core.store.log import Log
from verifai_jax.core.user_code.sources import Sources, list_changes
from verifai_jax.evaluation.backends import resolved
from verifai_jax.evaluation.evaluator import Evaluator
from verifai_jax.evaluation.executor_engine import TOGETHER
from verifai_jax.evaluation.layout import chunks_and_lanes
from verifai_jax.evaluation.verdicts import Verdicts
from verifai_jax.evaluation.worker import ARRAYS, evaluate_block
from verifai_jax.falsification._falsify import falsify
from verifai_jax.falsification.run import Run
from verifai_jax.falsification.validation import adapt_search, check_search, usual_batch
from verifai_jax.problem.problem import Problem
from verifai_jax.search import Search
from verifai_jax.search.proposals import Proposals

SHARD = "shard.rows"
"""Name of the log in the folder of a part; it identifies run and part, and holds the rows."""
_ABOUT = "about"
"""Entry that identifies run and part; all others are blocks, named by their rows."""
_OPTIONS = (
    "name", "formulas", "features", "search", "budget", "batch", "seed", "precision", "backend",
    "confirm", "target",
)  # fmt: skip
"""Entries of the record that are the same for all parts of a run."""


@dataclass(frozen=True)
class Shard:
    """Part `number` of a run that is divided into `of` parts, counted from 1.

    **Raises:** `ValueError` for a part that does not exist.
    """

    number: int
    of: int

    def __post_init__(self) -> None:
        check_count("of", self.of)
        if not 1 <= self.number <= self.of:
            raise ValueError(
                f"a shard is one of 1 to {self.of}, as in 3/{self.of}; got {self.number}"
            )

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """Read a shard from its text, such as `3/16`.

        **Raises:** `ValueError` for other text.
        """
        match = re.fullmatch(r"(\d+)/(\d+)", text.strip())
        if match is None or not int(match[2]):
            raise ValueError(f"a shard is written as 3/16, the third of sixteen; got {text!r}")
        return cls(int(match[1]), int(match[2]))

    def rows(self, budget: int, unit: int) -> range:
        """Return the range of its rows out of this many; ranges begin at multiples of `unit`."""
        ends = [budget * i // self.of // unit * unit for i in (self.number - 1, self.number)]
        return range(ends[0], budget if self.number == self.of else ends[1])

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"


@reproducible_settings()
def simulate_shard(
    problem: Problem,
    shard: Shard,
    search: str | Search = "uniform",
    budget: int = 10_000,
    *,
    folder: str | Path,
    batch: int | None = None,
    seed: int = 0,
    precision: str = "float32",
    backend: str | None = None,
    confirm: bool = True,
    progress: bool | None = None,
    target: str | None = None,
) -> int:
    """Simulate one part of a run into a folder, or complete a part that was begun there.

    **Arguments:**
    - `shard`: the part.
    - `folder`: a folder for this part only.
    - all other arguments: as in `falsify`, the same for all parts; rows are confirmed when the
      parts are merged.
    **Returns:** the number of simulations of this part.
    **Raises:** `ValueError` for a search that learns, a system with several backends unless one is
    named, a folder with another part; the errors of `falsify`.
    """
    check_options(budget, 1 if batch is None else batch, seed, None, None)
    search = check_search(problem, search)
    if search.learns:
        names = [name for name in searches.names() if not searches.named(name).learns]
        raise ValueError(
            f"search {search!r} learns from all rows, so a part of the run cannot be simulated "
            f"alone; use one that does not ({', '.join(names)}), or a cluster"
        )
    if problem.system.backends and backend is None:
        raise ValueError(
            "every part must be simulated by the same backend, and none is named; give backend=, "
            f"one of {', '.join(problem.system.backends)}"
        )
    usual = usual_batch(search, budget, None, not problem.black_box)
    batch = min(usual if batch is None else batch, budget)
    problem = resolved(problem, batch=batch, budget=budget, precision=precision, wanted=backend)[0]
    problem.check()
    search, _ = adapt_search(problem, search)
    path = Path(folder)
    record = {
        "name": problem.name,
        "formulas": {name: str(formula) for name, formula in problem.formulas.items()},
        "features": list(problem.space.columns),
        "search": searches.to_json(search),
        "budget": int(budget),
        "batch": int(batch),
        "seed": int(seed),
        "precision": precision,
        "backend": backend,
        "confirm": confirm,
        "target": target,
        "shard": [shard.number, shard.of],
        "sources": problem.sources().to_json(),
    }
    with write_lock(path):
        log = Log(path / SHARD)
        _claim(log, record)
        rows = shard.rows(budget, _unit(problem, batch))
        _simulate(problem, search, rows, record, log, progress, str(shard))
    return len(rows)


def _unit(problem: Problem, batch: int) -> int:
    if problem.black_box:
        return TOGETHER if problem.system.can_simulate_batch else 1
    return chunks_and_lanes(problem, batch, len(jax.local_devices()))[1]


def _simulate(
    problem: Problem,
    search: Search,
    rows: range,
    record: Mapping[str, Any],
    log: Log,
    progress: bool | None,
    shard: str,
) -> None:
    """Simulate the rows that are not in the log yet."""
    batch, budget = record["batch"], record["budget"]
    evaluate = Evaluator(problem, batch, precision=record["precision"], seed=record["seed"])
    key, space = run_keys(record["seed"])[0], problem.space
    proposals = Proposals(search, space.cube, batch, key, space.constraint, 0)
    done = {name for name, _ in log.entries()}
    first = simulated = found = 0
    best = float("nan")
    with SimulationProgress(f"{problem.name} {shard}", len(rows), progress) as bar:
        while first < rows.stop and not proposals.exhausted:
            points = proposals.next(min(batch, budget - first))
            begin, stop = max(first, rows.start), min(first + len(points), rows.stop)
            if begin < stop:
                if f"{begin}-{stop}" not in done:
                    u = np.asarray(points, np.float32)[begin - first : stop - first]
                    verdicts = evaluate(u, first=begin)
                    _write(log, begin, u, verdicts)
                    found += int(verdicts.violated.sum())
                    best = float(np.fmin(best, np.fmin.reduce(verdicts.lowest)))
                simulated += stop - begin
                bar.update(simulated, found, best)
            first += len(points)


def _claim(log: Log, record: Mapping[str, Any]) -> None:
    """Write the record of a part; refuse the folder of another part."""
    assert log.path is not None
    path = log.path.parent
    if not log.names():
        if {path.name for path in path.iterdir()} - {LOCK, SHARD}:
            raise ValueError(f"folder {str(path)!r} is not empty; a part of a run needs a new one")
        with writing(path):
            log.put_json(_ABOUT, record)
        return
    known = read_shard(path)
    for name, value in json.loads(json.dumps(record)).items():
        if name == "sources":
            _check_same_model(path, known, Sources.from_json(value))
        elif known.get(name) != value:
            raise ValueError(
                f"{path} holds another part: its {name} is {one_line(str(known.get(name)))}, "
                f"here {one_line(str(value))}; give another folder"
            )


def _check_same_model(folder: Path, record: Mapping[str, Any], now: Sources) -> None:
    """Refuse a part that was simulated with another model.

    **Raises:** `ValueError`.
    """
    if changes := Sources.from_json(record["sources"]).changes(now):
        raise ValueError(
            f"the model has changed since the part in {folder} was simulated: "
            f"{list_changes(changes)}. Restore the files, or simulate the part again in a new "
            "folder: rows of one run are of one model"
        )


def read_shard(folder: Path) -> dict[str, Any]:
    """Read the record of a part of a run.

    **Raises:** `FileNotFoundError` where there is none; `DamagedError` for one that is damaged.
    """
    file = folder / SHARD
    if not file.is_file():
        raise FileNotFoundError(
            f"no part of a run in {folder}: it has no {SHARD}; give folders that "
            "verifai-jax falsify --shard has written"
        )
    if (about := Log(file).get_json(_ABOUT)) is None:
        raise DamagedError(
            f"{file} is damaged: it does not say which part of a run it is; simulate the part "
            "again in a new folder"
        )
    return about


def _write(log: Log, first: int, u: Float[np.ndarray, "n d"], verdicts: Verdicts) -> None:
    arrays: dict[str, Any] = {"u": u, "processor": np.array(describe_processor())}
    for name in ARRAYS:
        if (value := getattr(verdicts, name)) is not None:
            arrays[name] = value
    for i, leaf in enumerate(jax.tree.leaves(verdicts.features)):
        arrays[f"leaf{i}"] = np.asarray(leaf)
    if verdicts.messages is not None:
        arrays["messages"] = np.array(verdicts.messages, dtype=str)
    assert log.path is not None
    with writing(log.path.parent):
        log.put({f"{first}-{first + len(u)}": arrays})


def _blocks(log: Log) -> Iterator[tuple[range, Log, str]]:
    """Yield the rows of each block, its log, and its name in the log."""
    for name in log.names():
        if match := re.fullmatch(r"(\d+)-(\d+)", name):
            yield range(int(match[1]), int(match[2])), log, name


@lru_cache(maxsize=4)
def _read(log: Log, name: str) -> dict[str, np.ndarray] | None:
    return log.get(name)


class _StoredRows:
    """An executor that returns the rows stored in the logs of the parts."""

    _max_workers = 1

    def __init__(self, blocks: Sequence[tuple[range, Log, str]]) -> None:
        self._blocks = sorted(blocks, key=lambda block: (block[0].start, block[0].stop))

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> "Future[dict[str, Any]]":
        """Return a future with the stored rows, instead of simulating them with `function`.

        Replays that confirm violations are simulated here.
        """
        future: Future[dict[str, Any]] = Future()
        try:
            stored = self._stored(*arguments[3:5]) if function is evaluate_block else None
            future.set_result(function(*arguments) if stored is None else stored)
        except Exception as error:
            future.set_exception(error)
        return future

    def _stored(self, first: int, u: np.ndarray) -> dict[str, Any] | None:
        """Return stored rows in the form of `evaluate_block`; None if a row has another point."""
        try:
            parts = list(self._parts(first, u))
        except _OtherPointsError as error:
            if len(u) == 1:
                return None  # The nominal features, which are simulated in addition to the rows.
            raise ValueError(
                f"rows {first} to {first + len(u) - 1} of the parts are not at the points of this "
                "search: they are of another version of the problem or of verifai_jax"
            ) from error
        result: dict[str, Any] = {
            name: np.concatenate([part[name] for part in parts])
            for name in ARRAYS
            if name in parts[0]
        }
        leaves = [name for name in parts[0] if name.startswith("leaf")]
        result["leaves"] = [
            np.concatenate([part[f"leaf{i}"] for part in parts]) for i in range(len(leaves))
        ]
        messages = [str(text) for part in parts for text in part.get("messages", ())]
        result["messages"] = messages if "messages" in parts[0] else None
        others = {str(part["processor"]) for part in parts} - {describe_processor()}
        processor = min(others, default=describe_processor())
        return result | {"seconds": 0.0, "notes": (), "processor": processor}

    def _parts(self, first: int, u: np.ndarray) -> Iterator[dict[str, np.ndarray]]:
        at = first
        for rows, log, name in self._blocks:
            if rows.stop <= at or rows.start > at or at >= first + len(u):
                continue
            if (stored := _read(log, name)) is None:
                continue
            stop = min(rows.stop, first + len(u))
            cut = slice(at - rows.start, stop - rows.start)
            if not np.array_equal(stored["u"][cut], u[at - first : stop - first]):
                raise _OtherPointsError
            yield {
                name: values if values.ndim == 0 else values[cut] for name, values in stored.items()
            }
            at = stop
        if at < first + len(u):
            raise ValueError(
                f"row {at} is in none of the parts: one is not finished, or damaged; run it again"
            )


class _OtherPointsError(Exception):
    """Stored rows are not at the requested points."""


def merge(
    folders: Sequence[str | Path],
    problem: Problem,
    *,
    folder: str | Path | None = None,
    progress: bool | None = None,
) -> Run:
    """Merge the parts of a run; the table is that of a run on one machine, bit for bit.

    **Arguments:**
    - `folders`: the folders of all parts.
    - `problem`: the problem of the run.
    - `folder`: the folder for the merged run; when left out, it is in memory.
    - `progress`: as in `falsify`.
    **Returns:** the run.
    **Raises:** `ValueError` for parts of different runs, a part that is missing, duplicated or not
    finished, and another problem; `FileNotFoundError` for a folder without a part.
    """
    if not folders:
        raise ValueError("there is no part to merge")
    paths = [Path(path) for path in folders]
    records = [read_shard(path) for path in paths]
    first, of = records[0], records[0]["shard"][1]
    for path, record in zip(paths, records, strict=True):
        for name in _OPTIONS:
            if record[name] != first[name]:
                raise ValueError(
                    f"{path} is a part of another run than {paths[0]}: its {name} is "
                    f"{one_line(str(record[name]))}, there {one_line(str(first[name]))}"
                )
    numbers = [record["shard"] for record in records]
    twice = sorted({number for number, _ in numbers if numbers.count([number, of]) > 1})
    missing = sorted(set(range(1, of + 1)) - {number for number, _ in numbers})
    if any(each != of for _, each in numbers) or twice or missing:
        what = f"part {twice[0]} is there twice" if twice else "they are of different divisions"
        if missing:
            listed = ", ".join(f"{number}/{of}" for number in missing[:8])
            what = f"{listed}{', ...' if len(missing) > 8 else ''} missing"
        raise ValueError(f"a run of {of} parts needs each of them once: {what}")
    own = {name: str(formula) for name, formula in problem.formulas.items()}
    if own != first["formulas"] or list(problem.space.columns) != first["features"]:
        raise ValueError(
            f"the parts are of the problem {first['name']!r} with other formulas or features than "
            f"{problem.name!r} has now"
        )
    now = problem.sources()
    for path, record in zip(paths, records, strict=True):
        _check_same_model(path, record, now)
    stored = _StoredRows([block for path in paths for block in _blocks(Log(path / SHARD))])
    return falsify(
        problem,
        searches.from_json(first["search"]),
        first["budget"],
        batch=first["batch"],
        seed=first["seed"],
        folder=folder,
        precision=first["precision"],
        backend=first["backend"],
        confirm=first["confirm"],
        progress=progress,
        target=first["target"],
        executor=stored,
        keep_going=True,
    )
