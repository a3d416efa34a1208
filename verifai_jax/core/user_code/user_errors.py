"""Messages for errors that user code raises, with the line of the user's own file.

    try:
        system(features, key)
    except Exception as error:
        explain_user_error(error, features)     # 'sim.py, line 12, in simulate (`f["mas"]`): there
                                                # is no feature 'mas'; did you mean 'mass'? ...'
        format_user_error(error)                # the same in one bounded line, with its type

The origin of an error is the innermost line of its traceback that belongs neither to this package,
nor to Python, nor to an installed library.
"""

import ast
import inspect
import linecache
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import CodeType, FrameType, TracebackType
from typing import Any, NamedTuple

import jax

from verifai_jax.core.messages.errors import nearest_names
from verifai_jax.core.messages.text import storable
from verifai_jax.core.user_code.user_files import is_notebook_cell, is_user_file
from verifai_jax.core.values.waveform import IS_CALLED

MAX_CODE = 80
"""Characters of a line of code that a message quotes."""
MAX_MESSAGE = 300
"""Maximum characters of a message of a library or a simulator."""
MAX_READ = 4 * MAX_MESSAGE
"""Characters of a message that are read at all: one of megabytes costs no time."""
MAX_TRACEBACK = 100_000
"""The same for a message that begins with a traceback and ends with the error."""
MAX_NAMES = 12
"""Names that a message lists."""
ONCE_FOR_ALL = "JAX traces the code once for all simulations, so its values are not known yet"
AS_PYTHON = "; or run the system as plain Python, without gradients, by vj.blackbox"
AS_NATIVE = (
    '; or run it with backend="native", which calls a controller in Python, without gradients'
)
TRACING: tuple[tuple[type[Exception], str], ...] = (
    (
        jax.errors.TracerBoolConversionError,
        f"it asks whether a value is true, and {ONCE_FOR_ALL}. Choose between values by "
        "jnp.where(condition, one, other), between computations by jax.lax.cond, and join "
        "conditions by & and | instead of and and or",
    ),
    (
        jax.errors.TracerIntegerConversionError,
        f"it uses a value as a plain integer, an index of a list or a count, and {ONCE_FOR_ALL}. "
        "Index jnp.array(the_list) instead of the list, and count by jax.lax.fori_loop",
    ),
    (
        jax.errors.TracerArrayConversionError,
        f"it gives a value to NumPy, and {ONCE_FOR_ALL}. Use jnp in place of np",
    ),
    (
        jax.errors.NonConcreteBooleanIndexError,
        f"it selects entries by a condition, and {ONCE_FOR_ALL}, nor is the number of entries. Use "
        "jnp.where(condition, values, other)",
    ),
    (
        jax.errors.UnexpectedTracerError,
        "it uses a value from another call, stored in a variable outside the function or in an "
        "attribute. Return such values, and pass them on as state or memory",
    ),
    (
        jax.errors.ConcretizationTypeError,
        "it needs a plain number, as float(), int(), .item(), range() and the math module do, and "
        f"{ONCE_FOR_ALL}. Leave out float() and .item(), use jnp instead of math, and "
        "jax.lax.fori_loop for loops",
    ),
)
"""Errors of JAX about values that it traces, each with what to do; the special before the general.
"""
WRITES = (
    f"it writes a value into an array of NumPy, and {ONCE_FOR_ALL}. Use jnp in place of np, and "
    "array = array.at[i].set(value)"
)
TRACING_BY_WORDS = {
    "Shapes must be 1D sequences of concrete": (
        f"it makes an array whose length is a value, and {ONCE_FOR_ALL}. Use the greatest possible "
        "length, and jnp.where(jnp.arange(maximum) < length, values, other)"
    ),
    # The first are the words of JAX 0.10, the second of 0.12.
    "Slice entries must be static|Array slice indices must have static": (
        f"it slices with values as ends, and {ONCE_FOR_ALL}. Use jax.lax.dynamic_slice for a slice "
        "of fixed length, or jnp.where over all entries"
    ),
    "Only integer scalar arrays can be converted to a scalar index": (
        f"it counts by a value, as range(value) and list[value] do, and {ONCE_FOR_ALL}. Count by "
        "jax.lax.fori_loop, and index jnp.array(the_list) by an integer"
    ),
    r"Tracer\.__format__": (
        f"it writes a value into a text, and {ONCE_FOR_ALL}. Use jax.debug.print to see values"
    ),
    r"unhashable type: '\w*Tracer'": (
        f"it looks a value up in a dictionary or a set, and {ONCE_FOR_ALL}. Index a jnp.array of "
        "what is to be chosen; a Categorical of texts gives the place of the choice"
    ),
}
"""The same for errors that only their words, patterns of `re`, tell from others."""


class UserLine(NamedTuple):
    """A line of a user's file, named relative to the working directory, in a function.

    - `code`: the text of the line; empty if the file cannot be read.
    """

    file: str
    line: int
    function: str
    code: str

    def __str__(self) -> str:
        where = f"{self.file}, line {self.line}"
        return where if self.function.startswith("<") else f"{where}, in {self.function}"


def user_line(error: BaseException) -> UserLine | None:
    """Return the innermost line of user code in an error's traceback; None if there is none."""
    step = _user_step(error)
    return None if step is None else _line(step.tb_frame.f_code, step.tb_lineno)


def defined_at(function: Callable[..., object] | None) -> str:
    """Write where a function is defined, ` (sim.py, line 3)`; empty if unknown."""
    code = getattr(getattr(function, "__wrapped__", function), "__code__", None)
    if not isinstance(code, CodeType) or not is_user_file(code.co_filename):
        return ""
    return f" ({_shown_file(code.co_filename)}, line {code.co_firstlineno})"


def check_called_with(
    role: str, function: Callable[..., object] | None, arguments: Sequence[str]
) -> None:
    """Check that a user's function accepts the positional arguments with which it will be called.

    **Arguments:**
    - `role`: the role of the function, for the message: "dynamics".
    - `function`: the function; None if none was given.
    - `arguments`: names of the arguments.
    **Raises:** `ValueError`, with the arguments that it accepts and the place of its definition.
    """
    if function is None:
        return
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return  # Such as a function written in C, which says nothing of its arguments.
    try:
        signature.bind(*arguments)
    except TypeError:
        taken = ", ".join(signature.parameters)
        raise ValueError(
            f"{role} is called with ({', '.join(arguments)}); got a function of ({taken})"
            f"{defined_at(function)}"
        ) from None


def source_line(traceback: object) -> str | None:
    """Return the user's line at which JAX recorded an operation; None if unknown.

    **Arguments:**
    - `traceback`: the traceback of the operation in JAX, with the innermost frame first.
    """
    for frame in getattr(traceback, "frames", ()):
        if is_user_file(frame.file_name):
            return f"{_shown_file(frame.file_name)}, line {frame.line_num}"
    return None


def explain_user_error(
    error: BaseException, features: object = None, *, system: bool = True, native: bool = False
) -> str:
    """Explain an error in user code in one line: what failed, where, and the remedy.

    **Arguments:**
    - `error`: the error raised by the code.
    - `features`: the features passed to the code, to recognise a misspelt name.
    - `system`: whether the code belongs to a system, which could also run as a black box.
    - `native`: whether that system could run natively, with a controller in Python.
    """
    step = _user_step(error)
    if step is None:
        return _said(error)
    line = _line(step.tb_frame.f_code, step.tb_lineno)
    code = f" (`{storable(line.code, MAX_CODE)}`)" if line.code else ""
    kept = isinstance(error, jax.errors.UnexpectedTracerError)
    more = (
        (AS_NATIVE if native else AS_PYTHON)
        if system and not kept and _advice_on_tracing(error)
        else ""
    )
    return f"{line}{code}: {_sentence(error, step, features)}{more}"


def format_user_error(error: BaseException) -> str:
    """Format an error in one bounded line: its type, message, and the user's line.

    For example `RuntimeError: no road (sim.py, line 12, in simulate)`.
    """
    line = user_line(error)
    return storable(f"{_said(error)}{'' if line is None else f' ({line})'}")


def _sentence(error: BaseException, step: TracebackType, features: object) -> str:
    if advice := _advice_on_tracing(error):
        return advice
    if isinstance(error, TypeError) and "Waveform" in storable(error):
        return f"{_said(error)}: {IS_CALLED}"
    if isinstance(error, KeyError) and error.args:
        return _missing_key(error.args[0], step, features) or _said(error)
    if isinstance(error, AttributeError) and error.name:
        name, owner = error.name, error.obj
        if isinstance(owner, Mapping) and name in owner:
            return f"{name!r} is read by [{name!r}], not by .{name}"
        if hasattr(owner, "_fields"):
            fields: list[str] = [*getattr(owner, "_fields", ())]
            return f"there is no {name!r}{_known('It has', name, fields)}"
    return _said(error)


def _advice_on_tracing(error: BaseException) -> str:
    """Write what to do about an error caused by tracing; empty for others."""
    # NumPy raises an error of its own from that of JAX.
    for each in (error, error.__cause__):
        for kind, advice in TRACING:
            if isinstance(each, kind):
                return WRITES if "array element" in storable(error) else advice
    if not isinstance(error, TypeError | IndexError):
        return ""
    words = storable(error)
    found = (advice for part, advice in TRACING_BY_WORDS.items() if re.search(part, words))
    return next(found, "")


def _missing_key(key: object, step: TracebackType, features: object) -> str:
    """Write which mapping lacks a key, and the keys it has; empty if unknown."""
    text, mapping = _subscripted(step)
    if mapping is None:
        # Without the text of the line: features that the function holds are the likeliest.
        held = [v for v in step.tb_frame.f_locals.values() if isinstance(v, Mapping)]
        mapping = next((m for m in held if _same_names(m, features) and key not in m), None)
        if mapping is None:
            return ""
    names = [str(name) for name in mapping]
    if _same_names(mapping, features):
        return f"there is no feature {key!r}{_known('The features are', key, names)}"
    return f"`{text}` has no {key!r}{_known('It has', key, names)}"


def _known(begin: str, name: object, names: list[str]) -> str:
    more = f", ... ({len(names)} in all)" if len(names) > MAX_NAMES else ""
    listing = f"{begin} {', '.join(names[:MAX_NAMES])}{more}" if names else "It has none"
    return f"{nearest_names(name, names) or '.'} {listing}"


def _subscripted(step: TracebackType) -> tuple[str, Mapping[Any, Any] | None]:
    """Return the text of the mapping that a failing `mapping[key]` looked into, and the mapping."""
    frame = step.tb_frame
    text = _source_of_instruction(frame.f_code, step.tb_lasti)
    try:
        node = ast.parse(text.strip(), mode="eval").body if text else None
    except SyntaxError:
        return "", None
    if not isinstance(node, ast.Subscript):
        return "", None
    found = _value(node.value, frame)
    return ast.unparse(node.value), found if isinstance(found, Mapping) else None


def _value(node: ast.expr, frame: FrameType) -> object:
    """Return the value of a name, or of constant subscripts of one; None for anything else."""
    if isinstance(node, ast.Name):
        return {**frame.f_globals, **frame.f_locals}.get(node.id)
    if isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Constant):
        outer: Any = _value(node.value, frame)
        if isinstance(outer, Mapping | list | tuple):
            try:
                return outer[node.slice.value]  # pyright: ignore[reportArgumentType, reportCallIssue]
            except (LookupError, TypeError):
                return None
    return None


def _source_of_instruction(code: CodeType, offset: int) -> str:
    """Return the text of the expression that an instruction belongs to; empty if unknown."""
    spans = [*code.co_positions()]
    # An instruction takes two bytes.
    first, last, begin, end = spans[offset // 2] if offset // 2 < len(spans) else (None,) * 4
    if first is None or last is None or begin is None or end is None:
        return ""
    lines = [linecache.getline(code.co_filename, n, None) for n in range(first, last + 1)]
    if not all(lines):
        return ""
    # Columns count bytes of UTF-8.
    raw = [line.encode() for line in lines]
    raw[-1] = raw[-1][:end]
    raw[0] = raw[0][begin:]
    return b"".join(raw).decode(errors="replace")


def _same_names(one: Mapping[Any, Any], other: object) -> bool:
    return isinstance(other, Mapping) and one.keys() == other.keys()


def raised_in_callback(error: BaseException) -> str | None:
    """Return the error of a function that JAX called on the host, with its line; or None.

    JAX only has the traceback as the text of its own error.
    """
    if type(error).__name__ not in ("JaxRuntimeError", "XlaRuntimeError"):
        return None
    text = storable(error, MAX_TRACEBACK)
    head, _, traceback = text.partition("Traceback (most recent call last):")
    lines = traceback.strip().splitlines()
    if "allback" not in head or not lines:
        return None
    frames = re.findall(r'File "([^"]+)", line (\d+)', traceback)
    where = f" ({_shown_file(frames[-1][0])}, line {frames[-1][1]})" if frames else ""
    return f"{storable(lines[-1].strip(), MAX_MESSAGE)}{where}"


def _said(error: BaseException) -> str:
    """Return the type and message of an error in one line of bounded length."""
    if (raised := raised_in_callback(error)) is not None:
        return raised
    # JAX appends advice about its own tracebacks.
    said = storable(error, MAX_READ)
    words = " ".join(said.partition("\n------")[0].split())
    if len(words) > MAX_MESSAGE:
        words = f"{words[: MAX_MESSAGE - 3]}..."
    kind = storable(type(error).__name__, MAX_CODE)
    return f"{kind}: {words}" if words else kind


def _user_step(error: BaseException) -> TracebackType | None:
    """Return the innermost step of an error's traceback that lies in a user's file."""
    found, step = None, error.__traceback__
    while step is not None:
        if _is_of_user(step.tb_frame):
            found = step
        step = step.tb_next
    return found


def _line(code: CodeType, number: int) -> UserLine:
    text = linecache.getline(code.co_filename, number).strip()
    return UserLine(_shown_file(code.co_filename), number, code.co_name, text)


def _is_of_user(frame: FrameType) -> bool:
    file = frame.f_code.co_filename
    # Functions that dataclasses make belong to the module of the class.
    module = frame.f_globals.get("__file__") if file == "<string>" else None
    return is_user_file(file) and (module is None or is_user_file(module))


def _shown_file(file: str) -> str:
    if is_notebook_cell(file):
        return "a notebook cell"
    path, here = Path(file), Path(os.getcwd())
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)
