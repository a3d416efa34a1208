"""SB1 to SB5: requirements of ARCH-COMP 2025 on trained LSTMs, whose weights come from a path.

    problem = sb1("weights/phi1_m2_vr001_k5_2.mat")

    FALBENCHGEN=weights verifai-jax falsify specs/arch/lstm.py:sb1

The networks carry no licence, so that none is here: they are in `benchmark/lstm` of the repository
lyudeyun/FalBenchGen_ARCHCOMP25. Where the environment variable `FALBENCHGEN` names a folder with
these files, this file defines the five problems `sb1` to `sb5`; otherwise none. Each input is
constant for 6 s, four pieces of it.
"""

import os
from pathlib import Path

import verifai_jax as vj
from envs.arch.lstm import read_lstm

FILES = {
    "sb1": "phi1_m2_vr001_k5_2.mat",
    "sb2": "phi2_m1_vr01_k2_2.mat",
    "sb3": "phi3_m2_vr001_k3_2.mat",
    "sb4": "phi4_m2_vr001_k5_3.mat",
    "sb5": "phi5_m1_vr01_k5_2.mat",
}
"""The file of each problem, as the repository names it."""


def sb1(path: str | Path) -> vj.Problem:
    """Return SB1 on the network of a file: two inputs, one output."""
    return _problem("sb1", path, "always[0, 24] b < 20", "the output stays below 20")


def sb2(path: str | Path) -> vj.Problem:
    """Return SB2 on the network of a file: one input, one output."""
    formula = "always[0, 18] (b > 90 | eventually[0, 6] b < 50)"
    return _problem("sb2", path, formula, "what is not above 90 is soon below 50")


def sb3(path: str | Path) -> vj.Problem:
    """Return SB3 on the network of a file: two inputs, one output."""
    formula = "(eventually[6, 12] b > 10) -> (always[18, 24] b > -10)"
    return _problem("sb3", path, formula, "once above 10 in the middle, above -10 at the end")


def sb4(path: str | Path) -> vj.Problem:
    """Return SB4 on the network of a file: two inputs, two outputs."""
    formula = "always[0, 19] ((always[0, 5] b1 <= 20) | (eventually[0, 5] b2 >= 40))"
    return _problem("sb4", path, formula, "where the first exceeds 20, the second reaches 40")


def sb5(path: str | Path) -> vj.Problem:
    """Return SB5 on the network of a file: one input, two outputs."""
    formula = "always[0, 17] eventually[0, 2] (!(always[0, 1] b1 >= 9) | (always[1, 5] b2 >= 9))"
    return _problem("sb5", path, formula, "soon the first falls below 9 or the second stays above")


def from_folder(folder: str | Path) -> tuple[vj.Problem, ...]:
    """Return the five problems, on the files of a folder.

    **Raises:** `ValueError` where one of the files is missing or holds another network.
    """
    builders = (sb1, sb2, sb3, sb4, sb5)
    files = [Path(folder) / name for name in FILES.values()]
    return tuple(build(file) for build, file in zip(builders, files, strict=True))


def _problem(name: str, path: str | Path, formula: str, description: str) -> vj.Problem:
    system = read_lstm(path)
    piecewise = vj.Signal(vj.Box(0.0, 1.0), knots=4, hold="constant")
    return vj.Problem(
        name,
        vj.FeatureSpace(dict.fromkeys(system.features, piecewise)),
        system,
        formula,
        nominal=dict.fromkeys(system.features, 0.5),
        description=description,
    )


if os.environ.get("FALBENCHGEN"):
    SB1, SB2, SB3, SB4, SB5 = from_folder(os.environ["FALBENCHGEN"])
