"""Files that are mutated at random, and what reading them may do: give a result, or one error."""

import json
import resource
import signal
import struct
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from verifai_jax.core.store.files import sealed

SECONDS, MEMORY = 20, 4 << 30
"""Limits of one reading: its time, and what it may allocate beyond what is allocated before."""
ODD: tuple[Any, ...] = (
    None, True, -1, 0, 1.5, 1e308, 10**12, 10**400, "", "x", "\0", "../x", [], {}, [[]], {"": None},
    float("nan"), "9" * 30,
)  # fmt: skip
"""Values that are put in the place of others."""


def flipped(data: bytes, rng: np.random.Generator) -> bytes:
    """Return bytes with one or several mutations."""
    for _ in range(rng.integers(1, 4)):
        at, size = int(rng.integers(len(data) + 1)), int(rng.integers(1, 20))
        match rng.integers(6):
            case 0:
                data = data[:at]
            case 1:
                data = data[:at] + rng.bytes(size) + data[at:]
            case 2:
                data = data[:at] + data[at + size :]
            case 3:
                data = data[:at] + bytes([rng.integers(256)]) + data[at + 1 :]
            case 4:
                other = int(rng.integers(len(data) + 1))
                data = data[:at] + data[other : other + size] + data[at:]
            case 5:
                number = struct.pack("<Q", int(rng.integers(1 << 62)) >> int(rng.integers(62)))
                width = int(rng.choice([1, 2, 4, 8]))
                data = data[:at] + number[:width] + data[at + width :]
    return data


def places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Yield containers of JSON within a value, with the keys of what is in them."""
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, inner in items:
        yield value, key
        if isinstance(inner, dict | list):
            yield from places(inner)


def altered(data: bytes, rng: np.random.Generator) -> bytes:
    """Return JSON with other values, sealed again if it was sealed."""
    value = json.loads(data)
    for _ in range(rng.integers(1, 3)):
        found = list(places(value))
        within, key = found[rng.integers(len(found))]
        if rng.integers(4):
            within[key] = ODD[rng.integers(len(ODD))]
        else:
            within.pop(key)
        if not value:
            break
    return json.dumps(sealed(value) if "checksum" in value else value).encode()


@contextmanager
def limited() -> Iterator[None]:
    """Limit the time and the memory of what is done within."""

    def stop(*_: object) -> None:
        raise TimeoutError(f"it took more than {SECONDS} s")

    with open("/proc/self/statm") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, before[1]))
    handler = signal.signal(signal.SIGALRM, stop)
    signal.alarm(SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, handler)
        resource.setrlimit(resource.RLIMIT_AS, before)


def wrong_answers(read: Callable[[], object]) -> str:
    """Read; return how it was not a result or an error of one line, or an empty text."""
    try:
        with limited():
            read()
    except (ValueError, OSError) as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        own = "verifai_jax" in last.filename
        marked = str(error).rstrip().endswith("^")  # A place in a formula.
        lines = "\n" in str(error) and not marked
        if isinstance(error, TimeoutError) or lines or not (own or str(error)):
            return f"{type(error).__name__}: {error} ({last.filename}:{last.lineno})"
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-3:]
        where = " < ".join(f"{each.filename[-40:]}:{each.lineno}" for each in last[::-1])
        return f"{type(error).__name__}: {str(error)[:200]} ({where})"
    return ""
