"""The tool's own oracles, run on the user's machine with the installed versions.

found = qualify()
found.save("qualification")
"""

import ast
import hashlib
import inspect
import re
import sys
import textwrap
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from types import FunctionType

from verifai_jax import mtl
from verifai_jax.addons.assurance.qualification.oracles import ORACLES
from verifai_jax.addons.assurance.qualification.result import Outcome, Qualification
from verifai_jax.addons.reports.provenance import versions
from verifai_jax.core.messages.errors import check_names
from verifai_jax.core.messages.text import one_line
from verifai_jax.core.user_code.user_files import PACKAGE


def qualify(only: Sequence[str] | None = None) -> Qualification:
    """Run the tool's own oracles on this machine: definitions, closed forms, kills, replays.

    **Arguments:**
    - `only`: names of oracles; all when left out, which takes a minute or two.
    **Returns:** the outcomes, with versions and one hash of all files of the package.
    **Raises:** `UnknownNameError` for an unknown oracle; it lists all names.
    """
    check_names("oracle", only or (), ORACLES)
    outcomes = []
    for name, check in ORACLES.items():
        if only and name not in only:
            continue
        begun, message = time.perf_counter(), ""
        try:
            check()
        except Exception as error:
            # Whatever an oracle raises, the tool is not what it says: that is what is recorded.
            message = one_line(f"{type(error).__name__}: {error}", 300)
        what = (check.__doc__ or "").strip()
        seconds = time.perf_counter() - begun
        outcomes.append(Outcome(name, what, not message, round(seconds, 2), message))
    now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    complete = len(outcomes) == len(ORACLES)
    run = [ORACLES[outcome.name] for outcome in outcomes]
    unseen = tuple(not_exercised([each for each in run if isinstance(each, FunctionType)]))
    return Qualification(tuple(outcomes), dict(versions()), package_hash(), now, complete, unseen)


def not_exercised(oracles: Sequence[FunctionType]) -> list[str]:
    """Return the public functions that are not named in the text of oracles, as users call them."""
    root = sys.modules["verifai_jax"]
    names = (*root.__all__, *(f"mtl.{name}" for name in dir(mtl)))
    called: set[str] = set()
    for oracle in oracles:
        parts = [*ast.walk(ast.parse(textwrap.dedent(inspect.getsource(oracle))))]
        called |= {part.id for part in parts if isinstance(part, ast.Name)}
        called |= {part.attr for part in parts if isinstance(part, ast.Attribute)}
        # A process that an oracle starts has its program as a text.
        for name in called & {name for name in oracle.__globals__ if name.isupper()}:
            called |= set(re.findall(r"vj\.(\w+)", str(oracle.__globals__[name])))
    found = []
    for name in names:
        value = root if "." not in name else mtl
        if inspect.isroutine(getattr(value, name.rpartition(".")[2], None)):
            found += [f"vj.{name}"] if name.rpartition(".")[2] not in called else []
    return found


def package_hash() -> str:
    """Return one SHA-256 of the files of the package, by name and content."""
    whole = hashlib.sha256()
    for file in sorted(PACKAGE.rglob("*")):
        if file.is_file() and "__pycache__" not in file.parts:
            whole.update(file.relative_to(PACKAGE).as_posix().encode())
            whole.update(hashlib.sha256(file.read_bytes()).digest())
    return whole.hexdigest()
