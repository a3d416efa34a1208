"""NN: a neural controller that holds a magnet in the air at a reference position.

    neural_network_controller()                         # 40 s; feature Ref

Feature, a function of time or a number: `Ref`, 1 to 3. Signals, every 0.01 s: `Pos` (position of
the magnet), `Ref`, and `current` (the controller's output from this sample on).

Source: the public Simulink model narmamaglev_v1.slx with the weights in its mask: a NARMA-L2
controller that runs every 0.01 s. The model's solver is ode45; here the plant is integrated by the
classical Runge-Kutta method with 0.001 s. No trajectory of the original was available to compare.
"""

from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from envs.arch.stepped import Features, Scalar, Stepped, real, repeated, value, whole
from verifai_jax.systems.ode.integrators import rk4

DT = 0.01
NOMINAL = {"Ref": 2.0}

CURRENT_LIMITS = (-1.0, 4.0)
MINP, MAXP = -0.9768288793296628, 3.9954019738068034
MINT, MAXT = 0.00127134724712792, 3.9954019738068034
IW1_1 = np.array(
    [
        [2.856916053916624, 3.8551379736179316, 2.4478436741338867, 0.8688998671315019],
        [0.8601974862411855, -0.7609974876165386, 0.1297838328359965, -0.03268194968370265],
        [-0.6126895156745158, -1.354653876780509, -1.0357145918607806, -2.245021356521297],
        [-0.613636393905946, 3.630279791812776, -2.9742392265006137, 3.7505205510025696],
        [8.215942541955298, -0.34781842703357196, -0.6399097822234708, 3.2203753164455033],
        [-0.5558555855523505, 1.7347260034225613, -0.4878206739919111, 0.1551929255086199],
        [0.14490936608588076, 0.09134499688722511, -1.999917792190961, -1.7398058021589538],
        [-0.011364174849476511, 0.17210174153872684, -0.06300334133173585, 0.0163566809393993],
        [1.9115353490253353, -1.69282907428, 0.2613911596451783, -0.0835215908808596],
    ]
)
IW3_2 = np.array(
    [
        [2.094012153469472, 4.139161749460294, 0.46017743638858905, 1.4212453617040688],
        [-0.8698291152927357, -0.9121639326327016, -1.7725276755524564, -1.8256681774546808],
        [-1.5212626080129232, -1.963839346858477, -0.1308320616684438, 0.6951444310146138],
        [1.106710074706867, 1.10772222997122, -1.6499992245985942, -0.10283142888325142],
        [1.7627456897433946, 0.12387727106338466, -0.7434587257456073, 1.3295242695796243],
        [1.3902623706994512, 1.2486843128494045, 0.6010035722034883, 1.8703374952532537],
        [-1.265262029400432, -0.8100397151897083, 0.35904126229892613, -2.3590512744589045],
        [-1.7962091138833456, 0.3300424895644986, 1.1996735804361836, -0.7584644175666946],
        [1.6085665816521635, -0.6596001199307706, 2.0409314507416925, 1.3008341987199021],
    ]
)
LW2_1 = np.array(
    [
        5.755548244449744e-05,
        2.194101728771453,
        -0.00044492281828180147,
        -0.0003923797112020545,
        1.8234323877817899e-06,
        0.042708432151687514,
        0.0002533004910055188,
        4.7927194580095165,
        0.41991364122019326,
    ]
)
LW4_3 = np.array(
    [
        1.179622915707438,
        1.4349048600431937,
        -0.8972572979998953,
        -2.338627041684287,
        -0.09669294243932744,
        -0.6343859921507877,
        -2.737919464469502,
        3.0145214892072625,
        2.1741978843496215,
    ]
)
B1 = np.array(
    [
        -2.0540485030510767,
        -0.28204565482768396,
        -1.4224984046874725,
        0.011980000365264734,
        -3.283305517615781,
        1.1020848049883287,
        2.2616940700361274,
        -0.14165422591960777,
        1.088976924112505,
    ]
)
B3 = np.array(
    [
        -0.9982247397611276,
        -1.125845792332043,
        1.0030562696131118,
        3.602065551304344,
        -0.02518596436748236,
        1.276393628529973,
        -2.274010065287341,
        -3.0720977283302817,
        1.7835104510380932,
    ]
)
IW5_3 = -0.8613021600806045
LW5_4 = 0.5996797859290577
LW6_5 = 0.0004116938262844689
LW6_2 = 0.9921675075327889
B2 = 0.9079050764793414
B4 = 0.8636776698074995


class State(NamedTuple):
    """Position and velocity of the magnet, and the controller's normalised memory.

    `position_before` is the position one control period ago, `currents` the outputs one and two
    periods ago.
    """

    position: Scalar
    velocity: Scalar
    position_before: Scalar
    currents: tuple[Scalar, Scalar]


def _normalised(x: Scalar, low: float, high: float) -> Scalar:
    return 2 * (x - low) / (high - low) - 1


def controlled(state: State, reference: Scalar) -> Scalar:
    """Return the current that the controller decides on."""
    inputs = (_normalised(state.position, MINT, MAXT), state.position_before, *state.currents)

    def layer(weights: np.ndarray, bias: np.ndarray, out: np.ndarray, out_bias: float) -> Scalar:
        # Written out: nine neurons of four inputs are too few for a matrix product.
        total: Any = out_bias
        for row, b, w in zip(weights, bias, out, strict=True):
            total = total + float(w) * jnp.tanh(
                sum(float(v) * x for v, x in zip(row, inputs, strict=True)) + float(b)
            )
        return total

    n1 = LW6_2 * layer(IW1_1, B1, LW2_1, B2)
    n2 = LW6_5 * LW5_4 * IW5_3 * layer(IW3_2, B3, LW4_3, B4)
    wanted = (_normalised(reference, MINT, MAXT) - n1) / n2
    return jnp.clip((wanted + 1) * (MAXP - MINP) / 2 + MINP, *CURRENT_LIMITS)


def slope(state: tuple[Scalar, Scalar], current: Scalar) -> tuple[Scalar, Scalar]:
    """Return the derivative of (position, velocity) under a current."""
    position, velocity = state
    force = 15 * current * current * jnp.sign(current) / (3 * position)
    return velocity, force - 9.8 - 12 * velocity / 3


def initial(features: Features) -> State:
    """Return the state at time 0: half a unit up, at rest, with delays of zero."""
    zero = jnp.zeros((), real())
    return State(jnp.asarray(0.5, real()), zero, zero, (zero, zero))


def _decided(k: Int[Array, ""], state: State, features: Features) -> Scalar:
    return controlled(state, value(features["Ref"], k.astype(real()) * DT))


def advance(k: Int[Array, ""], state: State, features: Features, substeps: Any = 10) -> State:
    """Take one control period."""
    current = _decided(k, state, features)

    def substep(_: Any, plant: Any) -> Any:
        return rk4(lambda _, s: slope(s, current), 0.0, plant, DT / substeps)

    position, velocity = repeated(substep, (state.position, state.velocity), substeps)
    return State(
        position,
        velocity,
        _normalised(state.position, MINT, MAXT),
        (_normalised(current, MINP, MAXP), state.currents[0]),
    )


def signals(k: Int[Array, ""], state: State, features: Features) -> dict[str, Float[Array, ""]]:
    """Return the signals of the requirements, and the control."""
    return {
        "Pos": state.position,
        "Ref": value(features["Ref"], k.astype(real()) * DT),
        "current": _decided(k, state, features),
    }


def neural_network_controller(duration: float = 40.0, *, substeps: Any = 10) -> Stepped:
    """Make the model a system.

    - `duration`: simulated seconds, a multiple of 0.01.
    - `substeps`: integration steps in a control period.
    """
    return Stepped(
        initial,
        partial(advance, substeps=substeps),
        signals,
        DT,
        whole(duration, DT, "duration"),
        NOMINAL,
        lambda factor: neural_network_controller(duration, substeps=substeps * factor),
        traced_factor=True,
    )
