"""The failure tables of the hopper, the quadrotor of the docs and the cart-pole; see RESULTS.md.

python benchmarks/fmea.py hopper|quadrotor|cartpole [--seed 0]
"""

import argparse
import re
from pathlib import Path

import verifai_jax as vj
from specs.cartpole import balance
from specs.hopper import upright
from verifai_jax.addons import faults

PAGE = Path(__file__).parents[1] / "docs" / "own_equations.md"


def quadrotor():
    """Return the problem of the page, whose first block of code ends with a search."""
    code = re.search(r"```python\n(.*?)\nrun = ", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert code is not None
    names = {}
    exec(compile(code[1], str(PAGE), "exec"), names)
    return names["problem"]


def window(end):
    """Return the numbers of a fault of up to a second, at any time."""
    return {"onset": vj.Box(0, end), "duration": vj.Box(0, 1)}


CASES = {
    "hopper": lambda: (
        upright,
        [
            faults.LossOfAuthority("knee", loss=vj.Box(0, 1), **window(3)),
            faults.Delay("action", seconds=vj.Box(0, 0.1), **window(3)),
            faults.Dropout("rooty", **window(3), name="pitch_dropout"),
            faults.Bias("rooty", offset=vj.Box(-0.3, 0.3), **window(3), name="pitch_bias"),
            faults.Noise("qvel", std=vj.Box(0, 0.5), **window(3)),
        ],
    ),
    "quadrotor": lambda: (
        quadrotor(),
        [
            faults.Dropout("rate", **window(4), name="gyro_dropout"),
            faults.Bias("z", offset=vj.Box(-0.5, 0.5), **window(4), name="height_bias"),
            faults.Freeze("y", **window(4), name="position_freeze"),
            faults.LossOfAuthority("left", loss=vj.Box(0, 0.6), **window(4)),
            faults.Delay("action", seconds=vj.Box(0, 0.1), **window(4)),
        ],
    ),
    "cartpole": lambda: (
        balance,
        [
            faults.Dropout("theta_dot", **window(8)),
            faults.Bias("theta", offset=vj.Box(-0.1, 0.1), **window(8)),
            faults.Stuck("action", value=1, **window(8)),
            faults.PacketLoss("observation", loss=vj.Box(0, 1), **window(8)),
            faults.SignFlip("x_dot", **window(8)),
        ],
    ),
}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("case", choices=CASES)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    problem, made = CASES[args.case]()
    table = vj.fmea(problem, made, rate=1e-4, mission_time=8.0, seed=args.seed, progress=False)
    print(table)
    failing = [each for each in table if each.fails]
    print(f"{sum(each.confirmed for each in failing)} of {len(failing)} failures are confirmed")


if __name__ == "__main__":
    main()
