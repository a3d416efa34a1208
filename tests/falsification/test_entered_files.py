"""A falsification imports what it uses, and enters the files that the page on architecture lists.

python tests/falsification/test_entered_files.py > docs/entered_files.txt    # after a change
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from benchmarks.many_rows import SWING

ROOT = Path(__file__).parents[2]
LISTED = ROOT / "docs" / "entered_files.txt"
ENTERING = """
import inspect, json, sys, threading
entered = {}

def enter(frame, event, argument):
    code = frame.f_code
    if event == "call" and code.co_flags & inspect.CO_OPTIMIZED and "<" not in code.co_name:
        file, inside, name = code.co_filename.rpartition("/verifai_jax/")
        if inside:
            entered.setdefault(name, code.co_name)

threading.setprofile(enter)
sys.setprofile(enter)
vj.falsify(problem, "uniform", 2000, progress=False)
sys.setprofile(None)
threading.setprofile(None)
print(json.dumps({"entered": entered, "imported": [*sys.modules]}))
"""


def one_call() -> dict[str, dict[str, str]]:
    """Return the files that one call enters, with the first function of each, and all modules."""
    ours = ("JAX_", "XLA_", "VERIFAI_JAX")
    plain = {name: value for name, value in os.environ.items() if not name.startswith(ours)}
    with tempfile.TemporaryDirectory() as cache:
        done = subprocess.run(
            [sys.executable, "-c", SWING + ENTERING], capture_output=True, text=True, cwd=ROOT,
            env=plain | {"VERIFAI_JAX_CACHE": cache, "PYTHONPATH": str(ROOT)},
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def listed(entered: dict[str, str]) -> str:
    """Write the files in the order of their first calls."""
    return "".join(f"{name} ({function})\n" for name, function in entered.items())


@pytest.mark.addons
@pytest.mark.slow
def test_one_call_enters_the_files_of_the_list_and_imports_no_other_search_or_engine():
    call = one_call()
    known = {line.split(" ")[0] for line in LISTED.read_text().splitlines()}
    assert set(call["entered"]) == known
    imported = set(call["imported"])
    searches = ("portfolio", "gradient", "descent", "mutation", "cross_entropy", "halton")
    unwanted = {f"verifai_jax.search.{name}" for name in searches}
    unwanted |= {f"verifai_jax.evaluation.{name}" for name in ("host_engine", "journal")}
    assert not imported & unwanted
    rooms = (".addons.searches.", ".addons.clusters")
    assert not [name for name in imported if any(room in name for room in rooms)]
    assert "verifai_jax.search.uniform" in imported


if __name__ == "__main__":
    sys.stdout.write(listed(one_call()["entered"]))
