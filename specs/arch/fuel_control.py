"""AFC27, AFC29 and AFC33: how well the air-to-fuel ratio of an engine is kept.

    verifai-jax falsify specs/arch/fuel_control.py:afc29 --search cross_entropy

The throttle is constant for 5 s, ten pieces; the speed of the engine stays. AFC27: from 1 s to 5 s
after the throttle has been opened or closed, the ratio is off by less than 0.8 %. AFC29: from 11 s
on, always by less than 0.7 %; AFC33 the same with the throttle wide open, in power mode.

A throttle is opened when it is below 8.8 degrees and above 40 within 0.05 s; closed likewise.
"""

import verifai_jax as vj
from envs.arch.fuel_control import fuel_control

RISE = "(throttle < 8.8) & (eventually[0, 0.05] throttle > 40)"
FALL = "(throttle > 40) & (eventually[0, 0.05] throttle < 8.8)"
_system = fuel_control()


def _problem(
    name: str, formula: str, low: float, high: float, usual: float, description: str
) -> vj.Problem:
    throttle = vj.Box(low, high, closed="left")
    space = vj.FeatureSpace(
        {
            "throttle": vj.Signal(throttle, knots=10, hold="constant"),
            "rpm": vj.Box(900.0, 1100.0),
        }
    )
    nominal = {"throttle": usual, "rpm": 1000.0}
    return vj.Problem(name, space, _system, formula, nominal=nominal, description=description)


afc27 = _problem(
    "afc27",
    f"always[11, 45] ((({RISE}) | ({FALL})) -> (always[1, 5] abs(mu) < 0.008))",
    0.0,
    61.2,
    20.0,
    "the ratio is back within 0.8 % a second after the throttle has been opened or closed",
)
afc29 = _problem(
    "afc29",
    "always[11, 50] abs(mu) < 0.007",
    0.0,
    61.2,
    20.0,
    "the ratio is within 0.7 % from 11 s on",
)
afc33 = _problem(
    "afc33",
    "always[11, 50] abs(mu) < 0.007",
    61.2,
    81.2,
    70.0,
    "the ratio is within 0.7 % from 11 s on, in power mode",
)
