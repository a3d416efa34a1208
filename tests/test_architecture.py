"""The direction of imports, and how little `import verifai_jax` brings along."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "verifai_jax"

# Which rooms a room may import. A room not named here may import any that is.
ALLOWED = {
    "errors": set(),
    "trace": set(),
    "figure": set(),
    "devices": set(),
    "rates": set(),
    "rulebook": {"errors"},
    "snapshot": set(),
    "waveform": {"errors"},
    "features": {"errors", "waveform"},
    "search": {"errors"},
    "mtl": {"errors", "figure", "trace"},
    "systems": {"errors", "trace", "waveform"},
    "table": {"errors"},
    "progress": set(),
    "journal": set(),
    "packing": set(),
    "gradients": set(),
    "backends": {"engine", "host", "problem", "run"},
    "problem": {"features", "mtl", "trace", "errors", "rulebook"},
    "carried": {"mtl", "problem", "trace"},
    "engine": {"carried", "problem", "devices", "gradients", "mtl", "packing", "trace"},
    "host": {"engine", "journal", "problem", "mtl", "systems", "trace"},
    "run": {
        "analysis",
        "engine",
        "mtl",
        "problem",
        "rates",
        "report",
        "rulebook",
        "snapshot",
        "table",
        "trace",
    },
    "proposals": {"features", "search"},
    "informative": {"problem"},
    "lockstep": {"devices", "engine", "problem", "proposals", "run", "search", "trace"},
    "replays": {
        "devices",
        "engine",
        "errors",
        "features",
        "host",
        "problem",
        "systems",
        "trace",
        "waveform",
    },
    "confirmation": {"engine", "errors", "problem", "replays", "run"},
    "evaluator": {"engine", "host", "problem", "run", "trace"},
    "rounds": {
        "confirmation",
        "engine",
        "evaluator",
        "host",
        "journal",
        "problem",
        "proposals",
        "rulebook",
        "run",
        "search",
        "snapshot",
        "table",
        "trace",
    },
    "options": {"errors", "informative", "problem", "proposals", "rates", "run", "search", "table"},
    "falsify": {
        "options",
        "backends",
        "engine",
        "errors",
        "problem",
        "progress",
        "proposals",
        "rates",
        "rounds",
        "run",
        "search",
        "table",
    },
    "trials": {
        "devices",
        "lockstep",
        "engine",
        "errors",
        "options",
        "problem",
        "proposals",
        "run",
        "search",
        "trace",
    },
    "analysis": {
        "backends",
        "engine",
        "errors",
        "features",
        "figure",
        "host",
        "problem",
        "rates",
        "report",
        "run",
        "table",
        "trace",
    },
    "rl": {"devices", "errors", "systems", "trace", "waveform"},
    "counterexample": {
        "backends",
        "confirmation",
        "engine",
        "errors",
        "evaluator",
        "features",
        "mtl",
        "problem",
        "proposals",
        "report",
        "run",
        "search",
        "trace",
        "waveform",
    },
    "estimation": {
        "backends",
        "engine",
        "errors",
        "evaluator",
        "features",
        "options",
        "problem",
        "progress",
        "rates",
        "report",
        "run",
    },
    "synthesis": {
        "backends",
        "engine",
        "errors",
        "evaluator",
        "features",
        "mtl",
        "options",
        "problem",
        "proposals",
        "rates",
        "report",
        "run",
        "search",
        "trace",
    },
    "certification": {
        "carried",
        "devices",
        "engine",
        "errors",
        "evaluator",
        "features",
        "options",
        "problem",
        "proposals",
        "rates",
        "rl",
        "search",
        "trace",
    },
    "sweeps": {
        "analysis",
        "certification",
        "devices",
        "errors",
        "falsify",
        "features",
        "mtl",
        "options",
        "problem",
        "progress",
        "proposals",
        "report",
        "rl",
        "run",
        "search",
        "targets",
        "trace",
    },
    "targets": {"errors", "problem", "sweeps"},
}


def imports_of(file: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{file}: imports are absolute"
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def room_of(file: Path) -> str:
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


@pytest.mark.parametrize("room", sorted(ALLOWED))
def test_imports_point_downwards(room):
    files = [PACKAGE / f"{room}.py"] if (PACKAGE / f"{room}.py").exists() else []
    files += sorted((PACKAGE / room).rglob("*.py"))
    assert files, f"there is no room {room}"
    rooms = {room_of(file) for file in PACKAGE.rglob("*.py")}
    for file in files:
        used = {name.split(".")[1] for name in imports_of(file) if name.startswith("verifai_jax.")}
        outside = (used & rooms) - ALLOWED[room] - {room}
        assert not outside, f"{file.name} imports {sorted(outside)}"


def test_library_does_not_know_its_content():
    for file in PACKAGE.rglob("*.py"):
        tops = {name.split(".")[0] for name in imports_of(file)}
        assert not tops & {"envs", "specs", "tests"}, f"{file} imports content"


def test_import_is_light():
    heavy = "pandas sklearn brax mujoco gymnax matplotlib pyarrow optax lark rich scipy.stats"
    code = f"import sys, verifai_jax\nprint(*[m for m in {heavy.split()} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
