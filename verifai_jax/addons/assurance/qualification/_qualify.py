"""The tool's own oracles, run on the user's machine with the installed versions.

found = qualify()
found.save("qualification")
"""

import hashlib
import time
from collections.abc import Sequence
from datetime import UTC, datetime

from verifai_jax.addons.assurance.qualification.oracles import ORACLES
from verifai_jax.addons.assurance.qualification.result import Outcome, Qualification
from verifai_jax.addons.reports.provenance import versions
from verifai_jax.core.messages.errors import check_names
from verifai_jax.core.messages.text import one_line
from verifai_jax.core.user_code.source_objects import PACKAGE


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
    return Qualification(tuple(outcomes), dict(versions()), package_hash(), now, complete)


def package_hash() -> str:
    """Return one SHA-256 of the files of the package, by name and content."""
    whole = hashlib.sha256()
    for file in sorted(PACKAGE.rglob("*")):
        if file.is_file() and "__pycache__" not in file.parts:
            whole.update(file.relative_to(PACKAGE).as_posix().encode())
            whole.update(hashlib.sha256(file.read_bytes()).digest())
    return whole.hexdigest()
