"""Execute the notebooks, and compare what they print with what is stored in them.

python notebooks/execute.py                                     # all
python notebooks/execute.py --at-once 2                         # two side by side, as CI does
python notebooks/execute.py 01_falsify_cartpole.ipynb           # one
python notebooks/execute.py --update 01_falsify_cartpole.ipynb  # store the new outputs
"""

import argparse
import copy
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

from outputs import differences  # noqa: E402 - beside this file, wherever it is called from


def execute(path: Path, update: bool) -> bool:
    """Execute one notebook from the root of the checkout, and check or store its outputs.

    **Arguments:**

    - `path`: the notebook.
    - `update`: store the outputs, instead of comparing them with those stored.

    **Returns:** True where every cell succeeded and, unless they are stored, all outputs agree.
    """
    stored = nbformat.read(path, as_version=4)
    notebook = copy.deepcopy(stored)
    started = time.perf_counter()
    client = NotebookClient(notebook, timeout=900, resources={"metadata": {"path": HERE.parent}})
    try:
        client.execute()
    except CellExecutionError as error:
        print(f"{path.name}: a cell FAILED\n{error}", file=sys.stderr)
        return False
    print(f"{path.name}: {time.perf_counter() - started:.0f} s", flush=True)
    notebook.metadata["verifai_jax"] = {"jax": version("jax")}
    if update:
        for cell in notebook.cells:
            # When a cell ran and on which kernel is noise in a diff.
            cell.metadata.pop("execution", None)
            if "outputs" in cell:  # Bars are drawn on slow machines alone.
                shown = [each for each in cell.outputs if not each.get("text", "").startswith("\r")]
                cell.outputs = shown
        nbformat.write(notebook, path)
        return True
    different = differences(stored, notebook)
    for difference in different:
        print(f"{path.name}, {difference}", file=sys.stderr)
    if different:
        print(
            f"{path.name}: {len(different)} outputs differ from the stored ones; where that is "
            f"right, python notebooks/execute.py --update {path.name}",
            file=sys.stderr,
        )
    return not different


def main() -> None:
    """Execute the notebooks named on the command line, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("notebooks", nargs="*", type=Path)
    parser.add_argument("--update", action="store_true", help="store the outputs in the files")
    parser.add_argument(
        "--at-once", type=int, default=1, metavar="N", help="notebooks that run side by side"
    )
    options = parser.parse_args()
    if options.at_once < 1:
        parser.error(f"--at-once must be a positive integer; got {options.at_once}")
    if options.update and options.at_once > 1:
        parser.error(
            "--update stores seconds too, which are those of one notebook: leave --at-once"
        )
    paths = [HERE / path.name for path in options.notebooks] or sorted(HERE.glob("*.ipynb"))
    with ThreadPoolExecutor(options.at_once) as pool:
        results = list(pool.map(lambda path: execute(path, options.update), paths))
    sys.exit(0 if all(results) else 1)


if __name__ == "__main__":
    main()
