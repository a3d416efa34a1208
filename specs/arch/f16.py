"""F16a: the plane does not hit the ground.

    verifai-jax falsify specs/arch/f16.py:f16a --search gradient

`f16a` begins at 2338 ft, as the competition has it since 2022: about 2 of 10 000 attitudes hit the
ground, by less than a foot, all of them with the steepest dive. `f16a_high` begins at 4040 ft, as
before, where only the MATLAB version of 2018 fails: a negative control.
"""

import math

import verifai_jax as vj
from envs.arch.f16 import f16

ATTITUDE = {
    "phi": vj.Box(math.pi / 4 - math.pi / 20, math.pi / 4 + math.pi / 30),
    "theta": vj.Box(-0.4 * math.pi, -0.4 * math.pi + math.pi / 20),
    "psi": vj.Box(-math.pi / 4 - math.pi / 8, -math.pi / 4 + math.pi / 8),
}
NOMINAL = {"phi": math.pi / 4, "theta": -0.375 * math.pi, "psi": -math.pi / 4}
_system = f16()

f16a = vj.Problem(
    "f16a",
    vj.FeatureSpace({**ATTITUDE, "altitude": vj.Constant(2338.0)}),
    _system,
    "always[0, 15] altitude > 0",
    nominal={**NOMINAL, "altitude": 2338.0},
    description="stays off the ground for 15 s, falling from 2338 ft",
)

f16a_high = vj.Problem(
    "f16a_high",
    vj.FeatureSpace({**ATTITUDE, "altitude": vj.Constant(4040.0)}),
    _system,
    "always[0, 15] altitude > 0",
    nominal={**NOMINAL, "altitude": 4040.0},
    description="stays off the ground for 15 s, falling from 4040 ft",
)
