"""A size limit for a folder of files that can be made again: those not used for longest go first.

evict(folder, 2048 * 2**20)
"""

import contextlib
import os
import re
from pathlib import Path

_OURS = re.compile(r"-[0-9a-f]{32,64}(-cache|-atime|\.so|\.agrees)?")
"""Ends of the names of files that JAX and this package make: a hash, and what it is of."""
KEPT = 0.9
"""Share of the limit that is left, so that not each new file needs an eviction."""


def evict(folder: Path, limit: int) -> None:
    """Remove the oldest files of compiled programs if all of them exceed a number of bytes.

    Files with other names are a user's, and stay. Several processes may do it at the same time, and
    read the files: they take the same ones, and what is open or loaded can still be used.
    """
    found: list[tuple[float, int, Path]] = []
    for path in (*folder.glob("*-*"), *folder.glob("derived/*-*"), *folder.glob("native/*-*")):
        if not _OURS.search(path.name) or path.is_symlink():
            continue
        with contextlib.suppress(OSError):
            about = os.stat(path)
            found.append((max(about.st_atime, about.st_mtime), about.st_size, path))
    total = sum(size for _, size, _ in found)
    if total <= limit:
        return
    for _, size, path in sorted(found):
        if total <= KEPT * limit:
            return
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
        total -= size
