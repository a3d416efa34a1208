"""CC1 to CC5 and CCx: how far apart five cars that chase one another stay.

    verifai-jax falsify specs/arch/chasing_cars.py:cc3 --search cross_entropy
    verifai-jax falsify specs/arch/chasing_cars.py:cc1_instance1 --search gradient

Instance 2 (`cc1`, ...): throttle and brake of the first car constant for 5 s, 20 pieces of each.
Instance 1 (`cc1_instance1`, ...): lines between 11 control points of each, 10 s apart; the
competition leaves their number to the tools.

CC4 is the competition's formula with G[0,5]; some tools' code has G[0,20]. CCx (from 2022 on) is
the conjunction of four requirements on the gaps, of very different difficulty.
"""

import verifai_jax as vj
from envs.arch.chasing_cars import chasing_cars

NOMINAL = {"throttle": 0.5, "brake": 0.5}
FORMULAS = {
    "cc1": (
        "always[0, 100] (y5 - y4 <= 40)",
        "the last gap is never more than 40",
    ),
    "cc2": (
        "always[0, 70] (eventually[0, 30] (y5 - y4 >= 15))",
        "the last gap is at least 15 once in 30 s",
    ),
    "cc3": (
        "always[0, 80] ((always[0, 20] (y2 - y1 <= 20)) | (eventually[0, 20] (y5 - y4 >= 40)))",
        "within 20 s the first gap stays below 20 or the last one reaches 40",
    ),
    "cc4": (
        "always[0, 65] (eventually[0, 30] (always[0, 5] (y5 - y4 >= 8)))",
        "the last gap is at least 8 for 5 s, once in 30 s",
    ),
    "cc5": (
        "always[0, 72] (eventually[0, 8] "
        "((always[0, 5] (y2 - y1 >= 9)) -> (always[5, 20] (y5 - y4 >= 9))))",
        "soon a wide first gap is followed by a wide last one",
    ),
    "ccx": (
        " & ".join(f"(always[0, 50] (y{i + 1} - y{i} >= 7.5))" for i in range(1, 5)),
        "no gap is less than 7.5 for 50 s",
    ),
}
_system = chasing_cars()


def _problem(name: str, suffix: str, knots: int, hold: str) -> vj.Problem:
    formula, description = FORMULAS[name]
    space = vj.FeatureSpace(
        {
            "throttle": vj.Signal(vj.Box(0.0, 1.0), knots=knots, hold=hold),
            "brake": vj.Signal(vj.Box(0.0, 1.0), knots=knots, hold=hold),
        }
    )
    return vj.Problem(
        name + suffix, space, _system, formula, nominal=NOMINAL, description=description
    )


def _instance1(name: str) -> vj.Problem:
    return _problem(name, "_instance1", 11, "linear")


def _instance2(name: str) -> vj.Problem:
    return _problem(name, "", 20, "constant")


cc1, cc1_instance1 = _instance2("cc1"), _instance1("cc1")
cc2, cc2_instance1 = _instance2("cc2"), _instance1("cc2")
cc3, cc3_instance1 = _instance2("cc3"), _instance1("cc3")
cc4, cc4_instance1 = _instance2("cc4"), _instance1("cc4")
cc5, cc5_instance1 = _instance2("cc5"), _instance1("cc5")
ccx, ccx_instance1 = _instance2("ccx"), _instance1("ccx")
