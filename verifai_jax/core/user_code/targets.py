"""Objects named by the Python file or module that defines them.

    load_target("specs/cartpole.py:balance", Problem)
    definitions("specs/cartpole.py", Problem, Study)     # {"balance": Problem(...), ...}

Loading a target runs the Python file that it names, as a test runner does. `target_of_project`
keeps a folder that came from elsewhere from choosing which file is run.
"""

import importlib
import importlib.util
import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Protocol, TypeVar

from verifai_jax.core.messages.errors import MissingExtra, unknown_name
from verifai_jax.core.user_code.user_errors import explain_user_error
from verifai_jax.core.user_code.user_files import FENCE


class Named(Protocol):
    """An object that a target can name."""

    @property
    def name(self) -> str:
        """Name of the object, after the colon of a target."""
        ...


Kind = TypeVar("Kind", bound=Named)


class TargetError(ValueError):
    """An error for a target that cannot be loaded, or is not a file of the user's own project."""


class NothingDefined(TargetError):
    """An error for a file or module without an object of the requested kind."""


def definitions(location: str, *kinds: type[Kind]) -> dict[str, Kind]:
    """Return the objects of some classes that a file or module defines.

    **Arguments:**
    - `location`: a file (`specs/cartpole.py`) or module (`specs.cartpole`), which is run.
    - `kinds`: classes to look for.
    **Returns:** the objects in the order of their definition, by their names, or by their variables
    if several have the same name.
    **Raises:** `TargetError` if there is no such file or module, or it cannot be run;
    `NothingDefined` if it defines no such object.
    """
    return _by_name(_variables(location, *kinds))


def values_in(location: str) -> tuple[object, ...]:
    """Return all values that a file or module defines, by running it.

    **Raises:** `TargetError` if there is no such file or module, or it cannot be run.
    """
    return tuple(vars(_import(location)).values())


def _variables(location: str, *kinds: type[Kind]) -> dict[str, Kind]:
    """Return the objects of some classes that a file or module defines, by their variables."""
    variables = {
        name: value for name, value in vars(_import(location)).items() if isinstance(value, kinds)
    }
    if not variables:
        nouns = " and no ".join(kind.__name__ for kind in kinds)
        raise NothingDefined(f"{location} defines no {nouns}")
    return variables


def _by_name(variables: dict[str, Kind]) -> dict[str, Kind]:
    """Return the objects, once each, by their names or, where several have one, by variables."""
    once = {id(value): variable for variable, value in reversed(variables.items())}
    kept = {variable: value for variable, value in variables.items() if once[id(value)] == variable}
    names = [value.name for value in kept.values()]
    return {
        value.name if names.count(value.name) == 1 else variable: value
        for variable, value in kept.items()
    }


def load_target(target: str, kind: type[Kind]) -> Kind:
    """Load the object named by a target.

    **Arguments:**
    - `target`: `FILE.py:NAME` or `MODULE:NAME`, with the name of the object or of its variable; the
      name may be left out if the file defines only one object of this kind.
    - `kind`: class of the object.
    **Raises:** `TargetError` if there is no such file or module, or not exactly one object without
    a name; `UnknownNameError` for a name that the file does not define, with those that it does.
    """
    location, colon, name = target.rpartition(":")
    if not colon:
        location, name = target, ""
    variables = _variables(location, kind)
    objects = _by_name(variables)
    noun = kind.__name__.lower()
    if name in objects:
        return objects[name]
    if name in variables:
        return variables[name]
    if name:
        raise unknown_name(f"{noun} in {location}", name, dict.fromkeys((*objects, *variables)))
    if len(objects) == 1:
        return next(iter(objects.values()))
    plural = noun.removesuffix("y") + "ies" if noun.endswith("y") else f"{noun}s"
    raise TargetError(
        f"{location} has {len(objects)} {plural}; name one: "
        + ", ".join(f"{location}:{known}" for known in objects)
    )


def target_of_project(target: object, folder: Path, *, kind: str, remedy: str) -> str:
    """Return a recorded target if it names a file of the user's own project.

    Loading a target runs its file, so a folder from elsewhere must not choose one. The target must
    be the path of an existing Python file below the current folder, and outside all folders of
    results: the folder that names it, its siblings and parents, any folder called `runs` or
    `sweeps`, and any with the files of a run or a sweep.

    **Arguments:**
    - `target`: the target recorded in the folder, of any type.
    - `folder`: the folder that records it.
    - `kind`: noun of the object, such as `"problem"`, for the message.
    - `remedy`: words for the message that say how to name the target by hand.
    **Raises:** `TargetError` for any other target.
    """
    if isinstance(target, str):
        location, colon, _ = target.rpartition(":")
        if _is_of_project(location if colon else target, folder.resolve()):
            return target
    raise TargetError(
        f"{folder} does not record to which {kind} of this project it belongs; give it: {remedy}"
    )


RESULTS = ("runs", "sweeps")
"""Names of the folders in which the command line keeps results."""
_OF_RESULTS = ("run.json", "sweep.json", "sweep.cache")


def _is_of_project(location: str, folder: Path) -> bool:
    """Return whether a place is a Python file of the project, and of no folder of results."""
    here = Path.cwd().resolve()
    # Anything else than an existing file would be imported as a module, from wherever it lies.
    if not location.endswith(".py") or "\0" in location or not Path(location).is_file():
        return False
    file = Path(location).resolve()
    if not file.is_relative_to(here) or file.is_relative_to(folder):
        return False
    folders = file.relative_to(here).parts[:-1]
    if any(name in RESULTS for name in folders):
        return False
    # Files of the same archive lie next to the folder.
    inside = folder.relative_to(here).parts[:1] if folder.is_relative_to(here) else ()
    if inside and inside == folders[:1]:
        return False
    inner = file.parents[: len(folders)]
    return not any((each / name).exists() for each in inner for name in _OF_RESULTS)


def _import(location: str) -> ModuleType:
    # The file's own imports (`from envs import cartpole`) start where the user stands.
    if sys.path[0] != str(Path.cwd()):
        sys.path.insert(0, str(Path.cwd()))
    path = Path(location)
    fence = os.environ.get(FENCE)
    # A link in the folder may lead out of it; a module could come from anywhere.
    if fence and not (path.exists() and path.resolve().is_relative_to(fence)):
        raise TargetError(f"{location} leads out of {fence}; only files in it are run here")
    if not (location.endswith(".py") or path.exists()):
        try:
            return importlib.import_module(location)
        except ModuleNotFoundError as error:
            if error.name is not None and location.startswith(error.name):
                raise TargetError(
                    f"no file and no module {location!r}; give FILE.py:NAME, "
                    "such as specs/cartpole.py:balance"
                ) from error
            raise
    if path.is_dir():
        raise TargetError(f"{location} is a folder; give a file in it: {_python_files(path)}")
    if not path.exists():
        raise TargetError(f"no file {location}; {path.parent}/ has {_python_files(path.parent)}")
    name = f"_target_{path.resolve().stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise TargetError(f"{location} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except MissingExtra:
        raise
    except SyntaxError as error:
        raise TargetError(f"{location} is not Python: {error}") from error
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise TargetError(f"{location} cannot be run: {explain_user_error(error)}") from error
    return module


def _python_files(folder: Path) -> str:
    files = sorted(p.name for p in folder.glob("*.py") if p.name != "__init__.py")
    return ", ".join(files) or "no Python file"
