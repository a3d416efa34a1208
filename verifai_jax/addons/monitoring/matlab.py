"""MATLAB's files: version 5 by SciPy, and version 7.3, which is HDF5.

Fields of structures become names: `log.imu.gyro`. Data sets share the clock of the nearest
structure that has one, and of Simulink's structures with time the signals have their labels.
"""

from pathlib import Path
from typing import Any

import numpy as np

from verifai_jax.addons.monitoring.columns import LeftOut
from verifai_jax.addons.monitoring.containers import Table, read_hdf5, tables_of_groups
from verifai_jax.addons.monitoring.readers import Asked
from verifai_jax.core.messages.text import format_error, one_line
from verifai_jax.core.store.foreign_archives import check_values
from verifai_jax.core.store.foreign_files import MAX_BYTES, open_file

HDF5 = b"\x89HDF\r\n\x1a\n"
MAX_DEPTH = 16
"""Maximum depth of structures within structures."""


def read_mat(path: Path, asked: Asked) -> list[Table]:
    """Read the variables of a MATLAB file; a column or a row of numbers is a signal."""
    from scipy.io import loadmat, whosmat

    with open_file(path, MAX_BYTES) as file:
        head = file.read(520)
        if head.startswith(HDF5) or head[512:] == HDF5:
            return read_hdf5(path, asked)
        file.seek(0)
        known = whosmat(file)
        for name, shape, _ in known:
            check_values(int(np.prod([int(n) for n in shape], dtype=object)), f"{name} of {path}")
        found: dict[str, np.ndarray] = {}
        for name, _, kind in known:
            if kind in ("opaque", "function", "object", "unknown"):
                why = "an object of a class is not read; save it as a structure or as arrays"
                asked.notes[LeftOut(f"variable {name!r} is left out: {why}", name)] = 1
                continue
            file.seek(0)
            try:
                value = loadmat(file, variable_names=[name], struct_as_record=False)[name]
            except Exception as error:  # Bytes can be wrong in any way.
                why = one_line(format_error(error))
                asked.notes[LeftOut(f"variable {name!r} cannot be read: {why}", name)] = 1
                continue
            _collect(name, value, found, 0)
    return tables_of_groups(found, {}, asked)


def _collect(name: str, value: Any, found: dict[str, np.ndarray], depth: int) -> None:
    """Put the arrays of a value below their names, with `/` between the names."""
    if depth > MAX_DEPTH:
        raise ValueError(f"{name!r} is nested deeper than {MAX_DEPTH}")
    if hasattr(value, "_fieldnames"):
        fields = {each: getattr(value, each) for each in value._fieldnames}
        label = _label(fields.get("label"))
        if label and "values" in fields:
            # A signal of Simulink's `Structure With Time`, beside whose list the times stand.
            _collect(f"{name.rpartition('/')[0]}/{label}", fields["values"], found, depth + 1)
            return
        for each, part in fields.items():
            _collect(f"{name}/{each}", part, found, depth + 1)
        return
    array = np.asarray(value)
    if array.dtype == object:
        cells = array.reshape(-1).tolist()
        words = [_label(cell) for cell in cells]
        if len(cells) > 1 and all(word is not None for word in words):
            found[name] = np.array(words)
        elif len(cells) == 1 or any(hasattr(cell, "_fieldnames") for cell in cells):
            for index, cell in enumerate(cells):
                _collect(name if len(cells) == 1 else f"{name}/{index}", cell, found, depth + 1)
    elif array.dtype.kind in "biuf" and array.size > 1 and array.ndim == 2:
        found[name] = array.reshape(-1) if 1 in array.shape else array


def _label(value: Any) -> str | None:
    """Return the text of a variable; None for anything else."""
    array = np.asarray(value)
    return str(array.reshape(-1)[0]) if array.dtype.kind == "U" and array.size == 1 else None
