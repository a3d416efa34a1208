"""The folder into which a command writes: the given one, or the next free one."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path


@contextlib.contextmanager
def given_or_next(
    folder: Path | None, parent: str, name: str, goes_on: Callable[[Path], str] | None = None,
    record: str | Path = "run.json",
) -> Iterator[Path]:  # fmt: skip
    """Return the given folder, or else the next one, made by `next_folder`.

    **Arguments:**
    - `goes_on`: a function that returns the command to resume the folder, printed for the case of a
      kill.
    - `record`: the file that must exist before the folder can be resumed.
    """
    from verifai_jax.core.display.progress import goes_on_with

    with contextlib.ExitStack() as held:
        path = held.enter_context(next_folder(parent, name)) if folder is None else folder
        if goes_on is not None:
            held.enter_context(goes_on_with(goes_on(path), (path / record).is_file))
        yield path


@contextlib.contextmanager
def next_folder(parent: str, name: str) -> Iterator[Path]:
    """Make the first missing folder of parent/NAME-1, parent/NAME-2, ..., for this process alone.

    A command that ends without writing a file into it removes it.
    """
    from verifai_jax.core.messages.text import folder_name
    from verifai_jax.core.store.locks import writing

    name, number, first = folder_name(name), 1, not Path(parent).exists()
    while True:
        folder = Path(parent) / f"{name}-{number}"
        try:
            with writing(folder):
                folder.mkdir(parents=True)
            break
        except ValueError as error:
            # Another command may have made it since one looked; making it decides.
            if not isinstance(error.__cause__, FileExistsError) or not folder.parent.is_dir():
                raise
            number += 1
    try:
        yield folder
    finally:
        with contextlib.suppress(OSError):
            folder.rmdir()
            if first:
                folder.parent.rmdir()
