"""Compilation of Scenic programs by Scenic itself, with VerifAI's parameters but without VerifAI.

    compiled = compile_program("cones.scenic", mode2D=True, params={})
    compiled.scenario                                   # scenic.core.scenarios.Scenario
    compiled.names                                      # names of the program's variables, by id

Scenic 3.1 imports `verifai` for `VerifaiRange` and its kin. If it is not installed, a stand-in with
the few needed names replaces it while the program compiles.
"""

import contextlib
import io
import random
import sys
import traceback
import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from verifai_jax.core.messages.errors import require
from verifai_jax.core.store.foreign_files import read_text


class ProgramError(ValueError):
    """An error for a Scenic program that does not compile: Scenic's message, with file and line."""


@dataclass(frozen=True, eq=False)
class Compiled:
    """A program compiled by Scenic.

    - `scenario`: Scenic's `Scenario`.
    - `namespace`: the variables of the program, by name.
    - `source`: the text of the program.
    - `filename`: the name of its file in Scenic's messages.
    """

    scenario: Any
    namespace: Mapping[str, Any]
    source: str
    filename: str

    @property
    def names(self) -> dict[int, str]:
        """Names of the program's own variables, by the identity of their values."""
        core = sys.modules["scenic.core.distributions"]
        held: dict[int, str] = {}
        parts = self.scenario.dynamicScenario
        local = {name: getattr(parts, name, None) for name in getattr(parts, "_locals", ())}
        for name, value in {**self.namespace, **local}.items():
            if not name.startswith("_") and isinstance(value, core.Samplable):
                held.setdefault(id(value), name)
        return held


def compile_program(
    program: str | Path, mode2D: bool, params: Mapping[str, Any], model: str | None = None,
    scenario: str | None = None,
) -> Compiled:  # fmt: skip
    """Compile a Scenic program.

    **Arguments:**
    - `program`: path of a `.scenic` file, or code, recognised by line breaks or spaces.
    - `mode2D`: Scenic's planar mode, in which objects lie in the plane.
    - `params`: global parameters to override.
    - `model`: Scenic module to use as world model instead of the program's own.
    - `scenario`: name of the modular scenario to compile, if there are several.
    **Raises:** `MissingExtra` without Scenic; `ProgramError` for a program that does not exist or
    does not compile.
    """
    hook = sys.excepthook
    require("scenic", "scenic")
    translator: Any = require("scenic.syntax.translator", "scenic")
    _with_time_series(require("scenic.syntax.veneer", "scenic"))
    sys.excepthook = hook  # Scenic's own would show every error of the user's program differently.
    path = _path_of(program)
    source = str(program) if path is None else read_text(path)
    filename = "<string>" if path is None else str(path.resolve())
    options = translator.CompileOptions(
        modelOverride=model, paramOverrides=dict(params), mode2D=mode2D
    )
    loaded = list(sys.modules)
    try:
        with without_verifai():
            try:
                file_name = None if path is None else str(path)
                with translator.topLevelNamespace(file_name) as namespace:
                    stream = io.BytesIO(source.encode())
                    translator.compileStream(stream, namespace, options, filename)
            finally:
                translator.purgeModulesUnsafeToCache(loaded)
            compiled = translator.constructScenarioFrom(namespace, scenario)
    except KeyboardInterrupt:
        raise
    except Exception as error:
        raise ProgramError(_message(error, filename, source)) from error
    return Compiled(compiled, namespace, source, filename)


def _with_time_series(veneer: Any) -> None:
    """Let programs say `TimeSeries(...)`, which Scenic has from 3.2 on."""
    if not hasattr(veneer, "TimeSeries"):
        veneer.TimeSeries = _time_series
        veneer.__all__ = (*veneer.__all__, "TimeSeries")


def _time_series(parameter: Any) -> Any:
    """Mark a parameter as one with a value at each step of a simulation."""
    if not isinstance(parameter, sys.modules["scenic.core.external_params"].ExternalParameter):
        raise TypeError(f"TimeSeries takes a VerifaiRange; got {type(parameter).__name__}")
    parameter.isTimeSeries = True
    return parameter


def _path_of(program: str | Path) -> Path | None:
    """Return the file that a program is in; None for code."""
    text = str(program)
    words = "\n" in text or (" " in text.strip() and not text.endswith((".scenic", ".sc")))
    if isinstance(program, str) and words:
        return None
    path = Path(program)
    if path.suffix not in (".scenic", ".sc"):
        raise ProgramError(
            f"a Scenic program is a .scenic file, or code of more than one word; got {text!r}"
        )
    if not path.is_file():
        folder = path.parent
        others = ", ".join(sorted(p.name for p in folder.glob("*.scenic"))) or "no .scenic file"
        raise ProgramError(f"no file {path}; {folder}/ has {others}")
    return path


def _message(error: BaseException, filename: str, source: str) -> str:
    """Return Scenic's message, with the file and line of the program that it is about."""
    line = getattr(error, "lineno", None)
    file = getattr(error, "filename", None) or filename
    if line is None:
        trace = error.__traceback__
        while trace is not None:
            code = trace.tb_frame.f_code
            if code.co_filename == filename or code.co_filename.endswith(".scenic"):
                file, line = code.co_filename, trace.tb_lineno
            trace = trace.tb_next
    if isinstance(error, NameError) and file == filename and line is not None:
        # Scenic gives assignments to ego the line of another statement.
        using = [i for i, text in enumerate(source.splitlines(), 1) if str(error.name) in text]
        line = line if line in using or not using else using[0]
    where = "" if line is None else f"{file}, line {line}: "
    text = str(error).strip().splitlines()
    first = text[0] if text else ""
    if first.startswith(str(file)) and len(text) > 1:
        first = text[-1]
    return f"{where}{type(error).__name__}: {first or _raised_at(error)}"


def describe_error(error: BaseException) -> str:
    """Return the type of an error and its message, or its source line if it has no message."""
    return f"{type(error).__name__}: {str(error).strip() or _raised_at(error)}"


def _raised_at(error: BaseException) -> str:
    """Return words for an error without a message: the line of code that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    if not frames:
        return "it came without a message"
    last = frames[-1]
    line = f" at `{last.line}`" if last.line else ""
    return f"it came without a message, from {Path(last.filename).name}, line {last.lineno}{line}"


@contextlib.contextmanager
def without_verifai() -> Iterator[None]:
    """Let Scenic's `VerifaiRange` and its kin work where VerifAI is not installed."""
    try:
        import verifai  # noqa: F401  # pyright: ignore[reportMissingImports]

        yield
        return
    except ImportError:
        pass
    root, features, server = (
        types.ModuleType(name) for name in ("verifai", "verifai.features", "verifai.server")
    )
    vars(root).update(features=features, server=server, __path__=[])
    vars(features).update(Box=_Box, DiscreteBox=_DiscreteBox, Feature=_Feature, FeatureSpace=dict)
    vars(server).update(choose_sampler=_choose_sampler)
    stand_ins = {module.__name__: module for module in (root, features, server)}
    sys.modules.update(stand_ins)
    try:
        yield
    finally:
        for name in stand_ins:
            sys.modules.pop(name, None)


class _Box:
    """An interval of real numbers, uniform."""

    def __init__(self, *intervals: Sequence[float]) -> None:
        self.intervals = tuple(tuple(interval) for interval in intervals)

    def draw(self) -> tuple[float, ...]:
        return tuple(random.uniform(*interval) for interval in self.intervals)


class _DiscreteBox(_Box):
    """An interval of integers, equally likely."""

    def draw(self) -> tuple[int, ...]:
        return tuple(random.randint(low, high) for low, high in self.intervals)  # pyright: ignore[reportArgumentType]


class _Feature:
    """A domain as VerifAI wraps it."""

    def __init__(self, domain: _Box) -> None:
        self.domain = domain


class _Sampler:
    """Uniform samples for Scenic's own `generate`; no search."""

    def __init__(self, space: Mapping[str, _Feature]) -> None:
        self.space = space

    def nextSample(self, feedback: object = None) -> Any:
        drawn = {name: feature.domain.draw() for name, feature in self.space.items()}
        return types.SimpleNamespace(**drawn)


def _choose_sampler(
    space: Mapping[str, _Feature], kind: str, sampler_params: object = None
) -> tuple[None, _Sampler]:
    return None, _Sampler(space)
