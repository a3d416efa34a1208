"""AT1 to AT6: what the automatic transmission of the ARCH competition must keep.

    verifai-jax falsify specs/arch/automatic_transmission.py:at6a --search cross_entropy
    verifai-jax falsify specs/arch/automatic_transmission.py:at1_instance1 --search gradient

Instance 2 (`at1`, ...): inputs constant for 5 s, over the 30 s that the model's file simulates
(35 s for AT5, which looks 32.7 s ahead). Instance 1 (`at1_instance1`, ...): lines between 7 control
points of the throttle and 3 of the brake over 50 s, as most tools have it.

`gear == i` is written `abs(gear - i) <= 0.5`, which has the same truth: 1/2 in the gear, -1/2 or
less in another. Tools write `gear == i` (FalStar) or `gear >= i & gear <= i` (FReaK), whose
robustness in the gear is 0, and with it that of AT5, broken or not. The interval [0.001, 0.1] of
AT5 begins with the first sample after the instant, 0.01 s later.
"""

import verifai_jax as vj
from envs.arch.automatic_transmission import automatic_transmission

THROTTLE = vj.Box(0.0, 100.0)
BRAKE = vj.Box(0.0, 325.0)
NOMINAL = {"throttle": 20.0, "brake": 0.0}


def _in_gear(i: int) -> str:
    return f"abs(gear - {i}) <= 0.5"


def _stays(i: int) -> str:
    return (
        f"always[0, 30] ((!({_in_gear(i)}) & eventually[0.01, 0.1] ({_in_gear(i)})) -> "
        f"eventually[0.01, 0.1] (always[0, 2.5] ({_in_gear(i)})))"
    )


def _slow(until: int, limit: int) -> str:
    return f"(always[0, 30] (rpm < 3000)) -> (always[0, {until}] (speed < {limit}))"


FORMULAS = {
    "at1": ("always[0, 20] speed < 120", "slower than 120 mph for 20 s"),
    "at2": ("always[0, 10] rpm < 4750", "engine slower than 4750 rpm for 10 s"),
    "at51": (_stays(1), "whoever shifts into gear 1 stays there for 2.5 s"),
    "at52": (_stays(2), "whoever shifts into gear 2 stays there for 2.5 s"),
    "at53": (_stays(3), "whoever shifts into gear 3 stays there for 2.5 s"),
    "at54": (_stays(4), "whoever shifts into gear 4 stays there for 2.5 s"),
    "at6a": (_slow(4, 35), "an engine below 3000 rpm means less than 35 mph for 4 s"),
    "at6b": (_slow(8, 50), "an engine below 3000 rpm means less than 50 mph for 8 s"),
    "at6c": (_slow(20, 65), "an engine below 3000 rpm means less than 65 mph for 20 s"),
    "at6abc": (
        f"({_slow(4, 35)}) & ({_slow(8, 50)}) & ({_slow(20, 65)})",
        "an engine below 3000 rpm means all three limits of AT6",
    ),
}
_full = automatic_transmission(duration=50.0)
_half_minute = automatic_transmission(duration=30.0)
_longer = automatic_transmission(duration=35.0)


def _instance1(name: str) -> vj.Problem:
    formula, description = FORMULAS[name]
    space = vj.FeatureSpace(
        {
            "throttle": vj.Signal(THROTTLE, knots=7, hold="linear"),
            "brake": vj.Signal(BRAKE, knots=3, hold="linear"),
        }
    )
    return vj.Problem(
        f"{name}_instance1", space, _full, formula, nominal=NOMINAL, description=description
    )


def _instance2(name: str) -> vj.Problem:
    formula, description = FORMULAS[name]
    system = _longer if name.startswith("at5") else _half_minute
    pieces = round(system.duration / 5)
    space = vj.FeatureSpace(
        {
            "throttle": vj.Signal(THROTTLE, knots=pieces, hold="constant"),
            "brake": vj.Signal(BRAKE, knots=pieces, hold="constant"),
        }
    )
    return vj.Problem(name, space, system, formula, nominal=NOMINAL, description=description)


at1, at1_instance1 = _instance2("at1"), _instance1("at1")
at2, at2_instance1 = _instance2("at2"), _instance1("at2")
at51, at51_instance1 = _instance2("at51"), _instance1("at51")
at52, at52_instance1 = _instance2("at52"), _instance1("at52")
at53, at53_instance1 = _instance2("at53"), _instance1("at53")
at54, at54_instance1 = _instance2("at54"), _instance1("at54")
at6a, at6a_instance1 = _instance2("at6a"), _instance1("at6a")
at6b, at6b_instance1 = _instance2("at6b"), _instance1("at6b")
at6c, at6c_instance1 = _instance2("at6c"), _instance1("at6c")
at6abc, at6abc_instance1 = _instance2("at6abc"), _instance1("at6abc")
