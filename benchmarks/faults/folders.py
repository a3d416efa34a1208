"""Run folders with damaged, exchanged and forged files.

What must hold: a folder is loaded, or refused by an error in words; the rows that are there are the
right ones; a run goes on to the table of an undamaged one, or is refused in words; the command line
prints no traceback. Nothing in a folder is executed.
"""

import functools
import json
import random
import shutil
import tempfile
from pathlib import Path
from typing import Any

import click.testing
import pandas as pd

import verifai_jax as vj
from benchmarks.faults.cases import Broken, chance
from benchmarks.faults.kills import SPACE, traced
from verifai_jax.cli.main import main as command_line

BEGUN, BUDGET, BATCH = 1024, 1536, 64
"""Rows in the folder, rows after it has gone on, and rows a round."""
_ALIENS: tuple[Any, ...] = (
    None, True, -1, 0, 1e300, "", "x", "../../x", "é\x1b[2J", [], {}, [[]], [None], {"": {}},
    "9" * 5000, 2**70, "NaN", -0.5, [1, "2"], "1999-99-99",
)  # fmt: skip
NAMED = (ValueError, OSError, RuntimeError)
"""Kinds of errors that say in words what is wrong; `KeyError` and its like do not."""

_UNSAID = ("KeyError", "AttributeError", "TypeError", "IndexError", "RecursionError", "EOFError")
"""Errors that say nothing to a person."""


@functools.cache
def _problem() -> vj.Problem:
    return vj.Problem("ramp", SPACE, traced, "always x <= 0.5")


def _falsify(budget: int, folder: Path | None) -> vj.Run:
    return vj.falsify(
        _problem(), "cross_entropy", budget, batch=BATCH, folder=folder, progress=False
    )


@functools.cache
def _whole() -> pd.DataFrame:
    return _falsify(BUDGET, None).table.all


@functools.cache
def _base() -> Path:
    root = Path(tempfile.mkdtemp(prefix="folders-"))
    _falsify(BEGUN, root / "run")
    return root / "run"


def case(number: int) -> str:
    """Damage a folder, and use it. **Returns:** what came of it."""
    random_ = chance(number, "folders")
    whole = _whole()
    with tempfile.TemporaryDirectory() as root:
        folder = Path(root) / "run"
        shutil.copytree(_base(), folder)
        for _ in range(random_.choice((1, 1, 1, 2, 3))):
            damage(folder, random_)
        _printed(folder)
        try:
            run = vj.load(folder, _problem())
        except NAMED as error:
            check_described(error)
            return "refused"
        _rows(run.table.all, whole)
        if not run.summary():
            raise Broken("a summary without a word")
        try:
            resumed = vj.resume(run, budget=BUDGET, progress=False)
        except NAMED as error:
            check_described(error)
            return "loaded, not resumed"
        if run.damage:
            raise Broken(f"a damaged run went on: {run.damage}")
        _rows(resumed.table.all, whole)
        if len(resumed.table) != BUDGET:
            raise Broken(f"{len(resumed.table)} rows instead of {BUDGET}")
        return "resumed"


def _printed(folder: Path) -> None:
    done = click.testing.CliRunner().invoke(command_line, ["replay", str(folder)])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise Broken(f"the command line: {done.exception!r}") from done.exception
    if any(word in done.output for word in ("Traceback", "\x1b", *_UNSAID)):
        raise Broken(f"the command line prints {done.output[-300:]!r}")


def check_described(error: Exception) -> None:
    """Check that an error says something, and not a book."""
    message = str(error)
    if not message or len(message) > 3000:
        raise Broken(f"an error of {len(message)} characters: {message[:200]!r}") from error


def _rows(table: pd.DataFrame, whole: pd.DataFrame) -> None:
    known = whole.reindex(table.index)
    for name in ("a", "b", "rho", "status"):
        if name not in table or not table[name].equals(known[name]):
            raise Broken(f"column {name!r} is not what was written")


def damage(folder: Path, random_: random.Random) -> None:
    """Change one file of a folder."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    if not files:
        return
    file = random_.choice(files)
    if file.suffix == ".json" and random_.random() < 0.7:
        _forge(file, random_)
        return
    data = bytearray(file.read_bytes())
    i, j = sorted(random_.randrange(len(data) + 1) for _ in range(2))
    match random_.randrange(8):
        case 0:
            del data[i:]
        case 1 | 2 | 3:
            for _ in range(random_.choice((1, 1, 4, 20))):
                if data:
                    data[random_.randrange(len(data))] ^= 1 << random_.randrange(8)
        case 4:
            data[i:i] = random_.randbytes(random_.randrange(1, 64))
        case 5:
            data[i:j] = bytes(j - i)
        case 6:
            file.unlink()
            if random_.random() < 0.3:
                file.mkdir()
            return
        case 7:
            data = bytearray(random_.choice(files).read_bytes())
    file.write_bytes(data)


def _forge(file: Path, random_: random.Random) -> None:
    """Change one value of a JSON file, or what it is."""
    try:
        content = json.loads(file.read_text())
    except (ValueError, RecursionError):
        return
    entries: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        items = node.items() if isinstance(node, dict) else enumerate(node)
        for key, value in list(items):
            entries.append((node, key))
            if isinstance(value, dict | list):
                walk(value)

    if isinstance(content, dict | list):
        walk(content)
    if not entries or random_.random() < 0.05:
        file.write_text(random_.choice(("", "null", "[]", "{}", "[" * 5000, '{"a": 1', "\x00")))
        return
    node, key = random_.choice(entries)
    if random_.random() < 0.3 and isinstance(node, dict):
        del node[key]
    else:
        node[key] = random_.choice(_ALIENS)
    file.write_text(json.dumps(content))
