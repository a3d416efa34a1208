"""Write constraints.txt anew, for the oldest and the newest Python under test.

    python -m pip install uv
    python .ci/constraints.py               # after a change of pyproject.toml: other versions stay
    python .ci/constraints.py --newest      # then `.ci/run` on both Pythons, and only then a commit

Each version stands there because it was installed and tested. Extras that no test installs and
platforms that no job runs on have no lines.
"""

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PYTHONS = ("3.11", "3.13")
"""The oldest and the newest Python that the workflow tests; between them the newest's versions."""
EXTRAS = ("test", "lint", "docs", "scenic", "diffrax", "dask", "ray", "slurm", "widget")
"""Extras that the Makefile and the workflow install; gymnax comes with `test` where it may."""


def resolve(python: str, pinned: Path) -> dict[str, str]:
    """Return the version of each package that this Python gets, by name.

    **Arguments:**

    - `python`: its version.
    - `pinned`: a file of versions that stay where they can; it is overwritten.

    **Raises:** `subprocess.CalledProcessError` where no versions go together; uv says which.
    """
    uv = shutil.which("uv", path=str(Path(sys.executable).parent)) or shutil.which("uv")
    if uv is None:
        raise SystemExit("python -m pip install uv, which resolves for Pythons that are not here")
    command = [uv, "pip", "compile", "pyproject.toml", "--python-version", python, "--quiet"]
    command += ["--python-platform", "x86_64-manylinux_2_28", "--no-header", "--no-annotate"]
    command += ["--output-file", str(pinned)]
    command += ["--no-emit-package", "verifai-jax", "--no-emit-package", "setuptools"]
    command += [word for extra in EXTRAS for word in ("--extra", extra)]
    subprocess.run(command, cwd=ROOT, check=True)
    lines = [line.split(";")[0].strip() for line in pinned.read_text().splitlines()]
    pins = [line.partition("==") for line in lines if "==" in line]
    return {re.sub(r"\[.*\]", "", name): version for name, _, version in pins}


def merged(oldest: dict[str, str], newest: dict[str, str]) -> str:
    """Return the lines of both, with a marker where the Pythons get different versions."""
    bound = "3.12"
    lines = []
    for name in sorted({*oldest, *newest}):
        if oldest.get(name) == newest.get(name):
            lines.append(f"{name}=={oldest[name]}")
            continue
        if name in oldest:
            lines.append(f"{name}=={oldest[name]} ; python_version < '{bound}'")
        if name in newest:
            lines.append(f"{name}=={newest[name]} ; python_version >= '{bound}'")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write constraints.txt, and print the lines that go and come."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--newest", action="store_true", help="the newest version of everything")
    newest = parser.parse_args().newest
    file = ROOT / "constraints.txt"
    before = file.read_text()
    pins = []
    for python in PYTHONS:
        with tempfile.TemporaryDirectory() as folder:
            pinned = Path(folder) / "constraints.txt"
            pinned.write_text("" if newest else before)
            pins.append(resolve(python, pinned))
    after = merged(*pins)
    for sign, one, other in (("-", before, after), ("+", after, before)):
        for line in sorted({*one.splitlines()} - {*other.splitlines()}):
            print(sign, line)
    file.write_text(after)


if __name__ == "__main__":
    main()
