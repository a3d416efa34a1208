"""Settings of all tests: no compile cache, checked annotations, memory given back between files."""

import ctypes
import functools
import gc
import importlib
import importlib.util
import os
import resource
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# Tests measure what the code compiles, not what an earlier session left behind.
os.environ.setdefault("VERIFAI_JAX_CACHE", "off")

import matplotlib
import pytest
from checked_types import check_first_calls
from jaxtyping import install_import_hook
from legible import faults, on_curves

matplotlib.use("Agg")

PACKAGE = Path(__file__).parents[1] / "verifai_jax"

CHECKED_ROOMS: list[str] = [
    "addons.analysis",
    "addons.checking",
    "addons.estimation",
    "addons.events.automaton",
    "addons.events.event_tables",
    "addons.events.reactive",
    "addons.events.transitions",
    "addons.events.written_events",
    "addons.monitoring.recording",
    "addons.perception.camera",
    "addons.perception.conditions",
    "addons.perception.light",
    "addons.perception.solids",
    "addons.reports",
    "addons.rl",
    "addons.synthesis",
    "addons.training.augmentation",
    "addons.training.loggers",
    "addons.training.sweeps",
    "core.compute.devices",
    "core.compute.keys",
    "core.user_code.callbacks",
    "core.values.cube",
    "core.values.trace",
    "core.values.waveform",
    "falsification",
    "features",
    "mtl._explain",
    "problem",
    "search.halton",
    "search.point_list",
    "search.proposals",
    "statistics",
    "systems",
]
"""Rooms whose annotations, shapes included, are checked at run time in tests."""
UNCHECKED = {
    "addons.estimation.certification",
    "addons.estimation.comparison",
    "addons.estimation.error_budgets",
    "addons.estimation.failure_modes",
    "addons.estimation.revisions",
    "addons.estimation.trials",
    "addons.rl.policies",
}
"""Folders of them that are left out: their functions take NumPy's arrays for JAX's, or answer a
value of a wrong kind with a sentence of their own."""


def checked_modules() -> Iterator[str]:
    """Yield the modules whose annotations are checked, with all that is within them."""
    for room in CHECKED_ROOMS:
        if room.startswith("addons.") and not (PACKAGE / "addons").exists():
            continue  # The core alone.
        folder = PACKAGE / room.replace(".", "/")
        assert folder.is_dir() or folder.with_suffix(".py").exists(), f"{room} checks nothing"
        files = folder.glob("*") if folder.is_dir() else ()
        inside = {f"{room}.{path.stem}" for path in files if not path.name.startswith("__")}
        parts = inside - UNCHECKED if inside & UNCHECKED else {room}
        yield from (f"verifai_jax.{part}" for part in sorted(parts))


check_first_calls()
install_import_hook([*checked_modules()], "checked_types.check")

import verifai_jax  # noqa: E402 - before any test starts JAX's backend, as users should
from verifai_jax.core.display import figure  # noqa: E402

_plain_figure = figure._figure_class


@functools.cache
def _legible_figure() -> Any:
    """Return a figure of which no text may be cut off or lie on another when it is written."""

    class Legible(_plain_figure()):
        def savefig(self, *arguments: Any, **options: Any) -> None:
            super().savefig(*arguments, **options)
            with figure.missing_glyphs():
                found = faults(self) + on_curves(self)
            assert not found, "a picture that cannot be read: " + "; ".join(found)

    return Legible


figure._figure_class = _legible_figure

LONG_FILES = (
    "test_documents.py",
    "test_faults.py",
    "test_contract.py",
    "test_mujoco_gradients.py",
    "test_against_oracle.py",
    "test_pytest_plugin.py",
    "test_shrink.py",
    "test_scenic_program.py",
    "test_proposals.py",
    "test_anchors.py",
    "test_evidence.py",
    "test_brax.py",
    "test_bayes.py",
    "test_workers.py",
    "test_cluster_executors.py",
    "test_silent_mistakes.py",
    "test_scenic_gallery.py",
    "test_surrogates.py",
    "test_diverse_search.py",
    "test_repair.py",
    "test_mujoco_scene.py",
    "test_road.py",
    "test_remembered.py",
    "test_gaussian_process.py",
    "test_cli.py",
    "test_estimate_methods.py",
    "test_learning_curves.py",
    "test_sweep_driver.py",
    "test_summary.py",
)
"""Test files that take longest, the longest first: what begins last must be short."""


def pytest_configure(config: pytest.Config) -> None:
    """Take Scenic as not installed where OpenCV, which it needs, lacks a library of the system.

    What such an import leaves behind would stand in the way of others, in worker processes too.
    """
    if importlib.util.find_spec("scenic") is None or importlib.util.find_spec("cv2") is None:
        return
    path, modules = list(sys.path), set(sys.modules)
    try:
        importlib.import_module("cv2")
    except ImportError as error:
        sys.path[:] = path
        for name in set(sys.modules) - modules:
            if name.partition(".")[0] == "cv2":
                del sys.modules[name]
        sys.modules["scenic"] = None  # pyright: ignore[reportArgumentType]
        print(f"tests with Scenic are left out: OpenCV cannot be imported here ({error})")


def pytest_collection_finish(session: pytest.Session) -> None:
    """Leave what is imported out of garbage collections: nothing of it goes before the end."""
    # A test may edit a module twice in a second, which a compiled file cannot tell: from here on
    # none is kept.
    sys.dont_write_bytecode = True
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    gc.collect()
    gc.freeze()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first, so that two workers end at nearly the same time."""
    order = {name: place for place, name in enumerate(LONG_FILES)}
    items.sort(key=lambda item: order.get(item.path.name, len(order)))


KEPT = 1.3
"""Memory, in GB, up to which compiled programs are kept: small ones are used by many files."""


def memory() -> float:
    """Return the resident memory of this process now, in GB; infinite where it cannot be read."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return float("inf")
    return pages * resource.getpagesize() / 1e9


@pytest.fixture(scope="module", autouse=True)
def memory_given_back(request: pytest.FixtureRequest) -> Iterator[None]:
    """Free the programs that files have compiled, once they take much memory."""
    yield
    jax = sys.modules.get("jax")
    if jax is None or memory() < KEPT:
        return
    specs = [module for name, module in sys.modules.items() if name.startswith("specs")]
    for module in (request.module, *specs):
        for value in vars(module).values():
            if isinstance(value, verifai_jax.Problem):
                value.programs.clear()
    jax.clear_caches()
    gc.collect()
    # The C library keeps what a compiler has freed, half of the memory, unless it is asked.
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def peak_memory() -> float:
    """Return the peak resident memory of this process so far, in GB."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


PEAKS: list[float] = []
"""Peak memory of each worker that has ended, in GB."""


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Send a worker's peak memory to the main process."""
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["peak_memory"] = peak_memory()


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any, error: Any) -> None:
    """Receive a worker's peak memory."""
    PEAKS.append(getattr(node, "workeroutput", {}).get("peak_memory", 0.0))


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Print the peak memory, in GB, of the process that ran tests and needed most."""
    terminalreporter.write_line(f"peak memory of a worker: {max(PEAKS or [peak_memory()]):.1f} GB")


@pytest.fixture(scope="session")
def shared_cache(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of other processes that compile the same: they share what is compiled."""
    return {**os.environ, "VERIFAI_JAX_CACHE": str(tmp_path_factory.mktemp("cache"))}


@pytest.fixture
def compiled():
    """Names of the programs that are compiled, as they are."""
    import jax.monitoring

    names = []

    def listen(event, duration, **more):
        if event == "/jax/core/compile/backend_compile_duration":
            names.append(more["fun_name"])

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield names
    jax.monitoring.unregister_event_duration_listener(listen)
