"""Execute the notebooks and fail when a cell does; `--write` keeps the outputs.

python notebooks/execute.py                         # all, as CI does
python notebooks/execute.py --write 01_falsify_cartpole.ipynb
"""

import argparse
import sys
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

HERE = Path(__file__).parent


def execute(path: Path, write: bool) -> bool:
    """Run one notebook from the root of the checkout; returns whether every cell succeeded."""
    notebook = nbformat.read(path, as_version=4)
    started = time.perf_counter()
    client = NotebookClient(notebook, timeout=300, resources={"metadata": {"path": HERE.parent}})
    try:
        client.execute()
    except CellExecutionError as error:
        print(f"{path.name}: FAILED\n{error}", file=sys.stderr)
        return False
    print(f"{path.name}: {time.perf_counter() - started:.0f} s")
    if write:
        for cell in notebook.cells:
            # When a cell ran and on which kernel is noise in a diff.
            cell.metadata.pop("execution", None)
        nbformat.write(notebook, path)
    return True


def main() -> None:
    """Run the notebooks named on the command line, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("notebooks", nargs="*", type=Path)
    parser.add_argument("--write", action="store_true", help="keep the outputs in the file")
    options = parser.parse_args()
    paths = [HERE / path.name for path in options.notebooks] or sorted(HERE.glob("*.ipynb"))
    done = [execute(path, options.write) for path in paths]
    sys.exit(0 if all(done) else 1)


if __name__ == "__main__":
    main()
