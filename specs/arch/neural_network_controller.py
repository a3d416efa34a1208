"""NN: how well the neural controller of the magnet follows its reference.

    verifai-jax falsify specs/arch/neural_network_controller.py:nn --search cross_entropy

Whenever the position is farther from the reference than `0.005 + beta |Ref|`, it comes closer
within 2 s, for 1 s at least. Instance 2 (`nn`): the reference is constant for each third of the
40 s. Instance 1 (`nn_instance1`): it is constant for a twelfth (3.33 s; the competition wants at
least 3 s between steps). `nn_wide` and `nn_wide_instance1` have beta 0.04 instead of 0.03.
"""

import verifai_jax as vj
from envs.arch.neural_network_controller import neural_network_controller

NOMINAL = {"Ref": 2.0}
_system = neural_network_controller()


def _formula(beta: float) -> str:
    bound = f"0.005 + {beta} * abs(Ref)"
    return (
        f"always[1, 37] ((abs(Pos - Ref) > {bound}) -> "
        f"eventually[0, 2] (always[0, 1] (!({bound} <= abs(Pos - Ref)))))"
    )


def _problem(name: str, beta: float, knots: int) -> vj.Problem:
    return vj.Problem(
        name,
        vj.FeatureSpace({"Ref": vj.Signal(vj.Box(1.0, 3.0), knots=knots, hold="constant")}),
        _system,
        _formula(beta),
        nominal=NOMINAL,
        description=f"the magnet is back within 2 s, to {beta:.0%} of its reference",
    )


nn = _problem("nn", 0.03, 3)
nn_instance1 = _problem("nn_instance1", 0.03, 12)
nn_wide = _problem("nn_wide", 0.04, 3)
nn_wide_instance1 = _problem("nn_wide_instance1", 0.04, 12)
