"""PM: a pacemaker that paces at most 15 and at least 8 times in 10 s.

    verifai-jax falsify specs/arch/pacemaker.py:pm --budget 10000

A negative control. Two paces are 667 to 1200 ms apart, so that there are 8 to 15 in 10 s: it cannot
be falsified, and a search should claim nothing. Instance 2 (`pm`): the lower rate limit is constant
for 2 s. Instance 1 (`pm_instance1`): lines between 11 control points, 1 s apart; the competition
leaves their number to the tools.

The competition's PM since 2022, on the model `Model1_Scenario1_Correct`. What FalCAuN reported as
broken in 2023 is another one, PM1, whose formula is on samples.
"""

import verifai_jax as vj
from envs.arch.pacemaker import pacemaker

LIMIT = vj.Box(50.0, 90.0)
FORMULA = "(always[0, 10] (paces <= 15)) & (eventually[0, 10] (paces >= 8))"
NOMINAL = {"LRL": 60.0}
_system = pacemaker()

pm = vj.Problem(
    "pm",
    vj.FeatureSpace({"LRL": vj.Signal(LIMIT, knots=5, hold="constant")}),
    _system,
    FORMULA,
    nominal=NOMINAL,
    description="8 to 15 paces in 10 s, at limits that change every 2 s",
)

pm_instance1 = vj.Problem(
    "pm_instance1",
    vj.FeatureSpace({"LRL": vj.Signal(LIMIT, knots=11, hold="linear")}),
    _system,
    FORMULA,
    nominal=NOMINAL,
    description="8 to 15 paces in 10 s, at a limit that changes all the time",
)
