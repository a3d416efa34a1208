"""SC: the pressure of a steam condenser after its setpoint has changed.

    verifai-jax falsify specs/arch/steam_condenser.py:sc_instance1 --search gradient

From 30 s to 35 s the pressure stays between 87 and 87.5 kPa. Instance 2 (`sc`): the flow of steam
is constant for 1.75 s, 20 pieces; most likely it cannot be broken, see docs/arch_comp.md.
Instance 1 (`sc_instance1`): 200 pieces of 0.175 s, of which some break it, by less than 0.003 kPa.
"""

import verifai_jax as vj
from envs.arch.steam_condenser import NOMINAL, steam_condenser

FORMULA = "always[30, 35] ((87 <= P) & (P <= 87.5))"
_system = steam_condenser()


def _problem(name: str, knots: int) -> vj.Problem:
    space = vj.FeatureSpace({"steam": vj.Signal(vj.Box(3.99, 4.01), knots=knots, hold="constant")})
    return vj.Problem(
        name,
        space,
        _system,
        FORMULA,
        nominal=NOMINAL,
        description="the pressure settles between 87 and 87.5 kPa",
    )


sc = _problem("sc", 20)
sc_instance1 = _problem("sc_instance1", 200)
