"""`verifai-jax doctor`: versions, devices, cores, compile cache and rendering of this machine."""

import contextlib
import importlib.metadata
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from typing import NamedTuple

from verifai_jax._version import __version__
from verifai_jax.cli.json_output import command, give_result, say
from verifai_jax.core.compute.cores import available_cores

PACKAGES = ("jax", "jaxlib", "numpy", "optax", "lark", "pandas", "pyarrow", "matplotlib", "rich")
"""Required packages whose versions are reported."""
EXTRAS = {"mujoco": "mujoco", "mujoco-mjx": "mujoco", "mujoco-warp": "warp"} | {
    package: package for package in ("brax", "gymnax", "gymnasium", "diffrax", "playground")
}
"""Optional packages, and the extra of verifai_jax that installs each."""


class Tested(NamedTuple):
    """Versions with which this version of the package has been tested, and the platform."""

    python: str
    jax: str
    numpy: str
    platform: str

    def __str__(self) -> str:
        """Write them in one line."""
        return f"Python {self.python}, jax {self.jax}, numpy {self.numpy} on {self.platform}"


TESTED = (
    Tested("3.11", "0.10.2", "2.4.6", "Linux x86_64"),
    Tested("3.13", "0.12.0.1", "2.5.5", "Linux x86_64"),
)
"""What has been tested: the versions of constraints.txt."""


BAD_PAIRS = {
    ("mujoco", "4.0.0", "4.0.1", "mujoco", None, None): (
        "with a sparse constraint Jacobian the Newton solver may give wrong accelerations "
        "(MuJoCo's issue 3767), so verdicts of native simulations may be wrong; MJX has a solver "
        "of its own. MuJoCo takes a sparse one from 60 degrees of freedom on. Write <option "
        "jacobian='dense'/> into the model, or install mujoco 4.0.1 or newer"
    ),
    ("brax", None, "0.15", "mujoco", "4.0", None): (
        "its swimmer does not work on any backend, so every simulation of it is an error and none "
        "a verdict; the other environments work"
    ),
    ("gymnax", None, "1.0", "jax", "0.5", None): (
        "pip fell back to an old gymnax, whose step returns other values, so verdicts are wrong; "
        "pip install 'gymnax>=1.0.1'"
    ),
    ("gymnax", "1.0", "1.1", "jax", "0.12", None): (
        "gymnax asks for jax below 0.12, so pip does not install the two together. Its "
        "environments pass our tests with jax 0.12.0 all the same, so verdicts stand; gymnax "
        "itself promises to work with pip install 'jax<0.12'"
    ),
    ("flax", None, "0.12.9", "jax", "0.12", None): (
        "flax.nnx cannot be imported, because it asks for jax.experimental.hijax.HiPrimitive, so "
        "vj.policy can take no module of nnx; flax.linen works. To use nnx, pip install 'jax<0.12'"
    ),
}
"""Versions of two packages that do not work together: a package, its least version and the first
that is fine again (None for no bound), and the same of the other one, which is the package itself
for a defect. Of each, what goes wrong, its effect on verdicts, and the remedy."""


@command()
def doctor() -> None:
    """Report versions and known bad pairs of them, devices, cores, cache and rendering."""
    text = report()
    say(text)
    give_result(packages=_installed(), python=platform.python_version(), cores=available_cores())
    give_result(tested=[each._asdict() for each in TESTED], report=text.splitlines())


def report() -> str:
    """Write versions, devices and settings, one a line, with advice where speed is lost."""
    import jax

    lines = [
        f"verifai_jax {__version__}",
        f"Python      {platform.python_version()} on {platform.system()} {platform.machine()}",
    ]
    installed = _installed()
    for package, version in installed.items():
        missing = "missing: pip install verifai_jax installs it"
        if package in EXTRAS:
            missing = f"not installed: pip install 'verifai_jax[{EXTRAS[package]}]'"
        lines.append(f"{package:<12}{version or missing}")
    lines += [f"  advice: {problem}" for problem in bad_pairs(installed)]
    lines += _tested(installed)
    devices = jax.devices()
    lines.append(f"devices     {len(devices)} x {devices[0].platform}")
    cores = available_cores()
    lines.append(f"cores       {cores} usable")
    if devices[0].platform == "cpu" and len(devices) < cores:
        lines.append(
            f"  advice: only {len(devices)} of {cores} cores are used. JAX started before "
            "verifai_jax was imported, or VERIFAI_JAX_CORES says so; import verifai_jax first"
        )
    lines.append(f"cache       {_cache_state()}")
    if installed["mujoco"]:
        lines.append(f"rendering   {_rendering()}")
    return "\n".join(lines)


def bad_pairs(installed: Mapping[str, str | None]) -> list[str]:
    """List known problems between installed versions, given by package name."""
    found = []
    for (package, *versions, other, minimum, below), problem in BAD_PAIRS.items():
        one, two = installed.get(package), installed.get(other)
        if _within(one, *versions) and _within(two, minimum, below):
            alongside = "" if other == package else f" with {other} {two}"
            found.append(f"{package} {one}{alongside}: {problem}")
    return found


def _tested(installed: Mapping[str, str | None]) -> list[str]:
    """Say which versions have been tested, and whether those of this process are among them."""
    python = ".".join(platform.python_version_tuple()[:2])
    jax, numpy = (installed[package] or "missing" for package in ("jax", "numpy"))
    here = Tested(python, jax, numpy, f"{platform.system()} {platform.machine()}")
    lines = [f"tested      {each}" for each in TESTED]
    if here not in TESTED:
        lines.append(
            f"  advice: {here} has not been tested as a whole; a verdict that matters is worth a "
            "replay with versions that have (constraints.txt of the source has all of them)"
        )
    return lines


def _installed() -> dict[str, str | None]:
    """Return the version of each package; None for one that is missing."""
    found: dict[str, str | None] = dict.fromkeys((*PACKAGES, *EXTRAS))
    for package in found:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package)
    return found


def _within(version: str | None, minimum: str | None, below: str | None) -> bool:
    if version is None:
        return False
    number = _number(version)
    return _number(minimum or "") <= number and (below is None or number < _number(below))


def _number(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version)[:3])


_RENDER = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>")
with mujoco.Renderer(model, 8, 8) as renderer:
    renderer.update_scene(mujoco.MjData(model))
    renderer.render()
"""


def _rendering() -> str:
    # In a process of its own: a graphics library that fails may take the process with it.
    wanted = os.environ.get("MUJOCO_GL", "egl")
    try:
        done = subprocess.run(
            [sys.executable, "-c", _RENDER], env={**os.environ, "MUJOCO_GL": wanted},
            capture_output=True, text=True, timeout=60,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return f"MUJOCO_GL={wanted} does not answer; MuJoCo scenes are not drawn"
    if done.returncode == 0:
        return f"MuJoCo scenes without a screen (MUJOCO_GL={wanted})"
    last = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
    return (
        f"no MuJoCo scenes with MUJOCO_GL={wanted} ({last[:100]}); install libEGL (Mesa), or try "
        "MUJOCO_GL=osmesa"
    )


def _cache_state() -> str:
    from verifai_jax.core.compute.devices import CACHE_ROOM, cache_folder

    folder = cache_folder()
    if folder is None:
        return "off (VERIFAI_JAX_CACHE); every process compiles anew"
    existing = next((p for p in (folder, *folder.parents) if p.exists()), folder)
    if not os.access(existing, os.W_OK):
        return (
            f"{folder} cannot be written, so every process compiles anew; "
            "set VERIFAI_JAX_CACHE to a folder that can"
        )
    if shutil.disk_usage(existing).free < CACHE_ROOM:
        return (
            f"the disk of {folder} is full, so every process compiles anew; make room, or set "
            "VERIFAI_JAX_CACHE to a folder on another disk"
        )
    files = [path for path in folder.glob("*") if path.is_file()]
    size = sum(path.stat().st_size for path in files) / 1e6
    return f"{folder} ({len(files)} files, {size:z.1f} MB); VERIFAI_JAX_CACHE=off switches it off"
