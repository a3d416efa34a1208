"""Problems and studies by the file or module that defines them: `specs/cartpole.py:balance`.

A target runs the Python file it names, as a test runner does; it is never read from a file.
"""

import importlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from verifai_jax.core.errors import unknown_name
from verifai_jax.problem.problem import Problem

if TYPE_CHECKING:
    from verifai_jax.sweeps.study import Study


class TargetError(ValueError):
    """A target that names no problem."""


def problems_in(place: str) -> dict[str, Problem]:
    """Problems of a file (`specs/cartpole.py`) or module (`specs.cartpole`), by name.

    **Raises:** `TargetError` where there is no such file or module, or it does not import.
    """
    return _defined(place, Problem, "Problem")


def studies_in(place: str) -> "dict[str, Study]":
    """Studies of a file or module, by name.

    **Raises:** as `problems_in`.
    """
    from verifai_jax.sweeps.study import Study

    return _defined(place, Study, "Study")


def defined_in(place: str) -> "dict[str, Problem | Study]":
    """Problems and studies of a file or module, by name.

    **Raises:** as `problems_in`, where there is neither.
    """
    from verifai_jax.sweeps.study import Study

    return _defined(place, (Problem, Study), "Problem and no Study")


def load_target(target: str) -> Problem:
    """The problem named by `FILE.py:NAME` or `MODULE:NAME`; NAME may be left out if it is alone.

    **Raises:** `TargetError` or `UnknownNameError`, listing what there is.
    """
    return _named(target, problems_in, "problem")


def load_study(target: str) -> "Study":
    """The study named by `FILE.py:NAME` or `MODULE:NAME`; NAME may be left out if it is alone.

    **Raises:** as `load_target`.
    """
    return _named(target, studies_in, "study")


def _defined(place: str, kind: Any, called: str) -> dict[str, Any]:
    module = _import(place)
    found = {p.name: p for p in vars(module).values() if isinstance(p, kind)}
    if not found:
        raise TargetError(f"{place} defines no {called}")
    return found


def _named(target: str, defined: Any, called: str) -> Any:
    place, colon, name = target.rpartition(":")
    if not colon:
        place, name = target, ""
    found = defined(place)
    if not name:
        if len(found) == 1:
            return next(iter(found.values()))
        plural = "studies" if called == "study" else f"{called}s"
        raise TargetError(
            f"{place} has {len(found)} {plural}; name one: "
            + ", ".join(f"{place}:{known}" for known in found)
        )
    if name not in found:
        raise unknown_name(f"{called} in {place}", name, found)
    return found[name]


def _import(place: str) -> ModuleType:
    # The file's own imports (`from envs import cartpole`) start where the user stands.
    if sys.path[0] != str(Path.cwd()):
        sys.path.insert(0, str(Path.cwd()))
    path = Path(place)
    if not (place.endswith(".py") or path.exists()):
        try:
            return importlib.import_module(place)
        except ModuleNotFoundError as error:
            if error.name is not None and place.startswith(error.name):
                raise TargetError(
                    f"no file and no module {place!r}; give FILE.py:NAME, "
                    "such as specs/cartpole.py:balance"
                ) from error
            raise
    if path.is_dir():
        raise TargetError(f"{place} is a folder; give a file in it: {_listing(path)}")
    if not path.exists():
        raise TargetError(f"no file {place}; {path.parent}/ has {_listing(path.parent)}")
    name = f"_target_{path.resolve().stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise TargetError(f"{place} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def _listing(folder: Path) -> str:
    files = sorted(p.name for p in folder.glob("*.py") if p.name != "__init__.py")
    return ", ".join(files) or "no Python file"
