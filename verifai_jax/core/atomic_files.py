"""Files that are there whole or not at all, whatever ends the process that writes them.

with replacing("report.html") as partial:
partial.write_text(page)                    # takes the place of report.html at the end
"""

import contextlib
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield the path of a file to write, which replaces the one at `path` once it is whole.

    Its ending is that of `path`, which tells some libraries the format. Folders that it needs are
    made. Where writing fails, the file that was at `path` stays.

    **Raises:** `OSError` that names `path`, for whatever the file system refuses.
    """
    path = Path(path)
    partial = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        partial.replace(path)
    except OSError as error:
        reason = error.strerror or str(error)
        raise type(error)(f"{path} cannot be written ({reason}); give another path") from error
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
